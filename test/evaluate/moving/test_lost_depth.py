# SPDX-License-Identifier: Apache-2.0
"""Drawn people of whom depth is missing, and their silhouettes: as much is lost, and masks are as rough, as is said."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.moving.drawn_silhouettes import draw_people
from flowing_puppet_ros.evaluate.moving.lost_depth import lose_depth
from flowing_puppet_ros.evaluate.rgbd.clothing import paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdPair, RgbdStudio, look_along, make_camera
from flowing_puppet_ros.model.sp import StitchedPuppet

pytest.importorskip("body_models")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames() -> list[RgbdFrame]:
    """What three cameras see of somebody who waves, in an empty room."""
    rng, camera = np.random.default_rng(8), make_camera((320, 240), 262.0)
    studio, found = RgbdStudio(BodySource(), RgbdPair(camera, camera)), []
    body = pose_motion(studio.source, "waving", rng, 2, 10.0, 0.3)[0]
    floor = paint_surroundings([make_box(np.array([0.0, 0.0, -0.05]), np.array([9.0, 9.0, 0.1]), np.eye(3))], rng)
    for angle in (0.2, 2.3, -2.0):
        eye = 3.0 * np.array([np.cos(angle), np.sin(angle), 0.0]) + [0.0, 0.0, 1.3]
        found.append(studio.look(rng, [body], floor, studio.cameras.place(look_along(-eye, 0.13), eye)))
    return found


def count(frame: RgbdFrame) -> int:
    return int(np.count_nonzero((frame.person == 0) & np.isfinite(frame.depth)))


def test_patches_take_three_fifths_of_each_person_from_each_camera(frames: list[RgbdFrame]) -> None:
    left = lose_depth(frames, "patches", np.random.default_rng(0), StitchedPuppet.load())
    for before, after in zip(frames, left, strict=True):
        assert 0.15 < count(after) / count(before) <= 0.4


def test_one_camera_keeps_all_and_the_others_nothing(frames: list[RgbdFrame]) -> None:
    left = lose_depth(frames, "one", np.random.default_rng(0), StitchedPuppet.load())
    assert [count(frame) for frame in left] == [count(frames[0]), 0, 0]


def test_clothes_take_the_upper_or_the_lower_body(frames: list[RgbdFrame]) -> None:
    (body,) = frames[0].bodies
    hips = float(body.joints[_hips(), 2].mean())
    found = set()
    for seed in range(6):
        after = lose_depth(frames, "clothes", np.random.default_rng(seed), StitchedPuppet.load())[0]
        lost = np.isfinite(frames[0].depth) & ~np.isfinite(after.depth)
        row, column = np.nonzero(lost)
        camera = after.cameras.depth
        rays = camera.cast_rays(np.stack([column, row], axis=1))
        along = after.true_depth[row, column] / (rays @ camera.rotation[2])
        above = float(((camera.centre + along[:, None] * rays)[:, 2] > hips).mean())
        assert above > 0.8 or above < 0.25
        found.add(above > 0.5)
    assert found == {True, False}


def _hips() -> list[int]:
    names = BodySource().joint_names
    return [names.index(f"{side}_hip") for side in ("left", "right")]


def test_silhouettes_are_nearly_the_truth_and_joints_are_near(frames: list[RgbdFrame]) -> None:
    (person,) = draw_people(frames, np.random.default_rng(1))
    assert person.id == "p0" and len(person.views) == 3
    for (_, mask), frame in zip(person.views.values(), frames, strict=True):
        height, width = frame.person.shape
        rows = np.arange(mask.shape[0]) * height // mask.shape[0]
        columns = np.arange(mask.shape[1]) * width // mask.shape[1]
        true = frame.person[np.ix_(rows, columns)] == 0
        overlap = np.count_nonzero(true & (mask > 0)) / np.count_nonzero(true | (mask > 0))
        assert 0.7 < overlap < 0.97
    places = np.array([person.joints[name][:3] for name in LIMB_JOINTS])
    assert np.nanmedian(np.linalg.norm(places - frames[0].joints[0], axis=1)) < 0.08
