# SPDX-License-Identifier: Apache-2.0
"""Stick figures become puppets: judged on Anny bodies themselves, which the regression has never seen."""

from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints
from flowing_puppet_ros.image.formats.keypoints import SHOULDER_SPREAD, TRUNK_DROP, joints_from_keypoints
from flowing_puppet_ros.image.formats.stick_regression import TORSO, UPPER_ARMS, StickRegression
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints, write_sticks
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.learn.anny.poses import PoseSampler
from flowing_puppet_ros.learn.ds.samples import CameraView, RandomCamera
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MODEL = DeformableStructures.load()
REGRESSION = StickRegression(MODEL)
SCALE = 140.0


@pytest.fixture(scope="module")
def joints(body: AnnyBody) -> np.ndarray:
    """Joints (20, J, 2) px of posed bodies before random cameras."""
    rng = np.random.default_rng(11)
    vertices, bones = body.pose(body.make_rest_body(body.mean_phenotype()), PoseSampler(body, None).sample(rng, 20))
    marks = body.locate_landmarks(vertices, bones)
    seen = []
    for k in range(20):
        camera = RandomCamera.draw(rng, CameraView())
        seen.append([camera.project(marks[name][k]) for name in MODEL.joint_names])
    return np.array(seen) * SCALE + np.array([160.0, 120.0])


def test_joints_and_scale_of_bodies_come_back_from_their_sticks(joints: np.ndarray) -> None:
    scales, off = [], []
    for one in joints:
        found, scale = REGRESSION(sticks_from_joints(MODEL.joint_names, one), is_marked=False)
        scales.append(scale / SCALE)
        off.append(np.linalg.norm(found - one, axis=1) / SCALE)
    by_joint = dict(zip(MODEL.joint_names, np.median(off, axis=0), strict=True))
    for name in ("right_wrist", "left_elbow", "neck", "face", "right_shoulder"):
        assert by_joint[name] < 0.03, name
    for name in ("belly", "right_hip", "left_hip"):
        assert by_joint[name] < 0.05, f"no stick ends at the {name}"
    assert abs(np.median(scales) - 1.0) < 0.08
    assert np.percentile(np.abs(np.log(scales)), 80) < 0.2


def test_marked_sticks_are_mapped_to_the_puppets_shoulders(joints: np.ndarray) -> None:
    own = sticks_from_joints(MODEL.joint_names, joints[0])
    marked = own.copy()
    trunk = (own[TORSO, 1] - own[TORSO, 0]) * TRUNK_DROP
    marked[TORSO] -= trunk
    left, right = (own[k, 0] for k in UPPER_ARMS)
    inwards = SHOULDER_SPREAD / (1 + 2 * SHOULDER_SPREAD) * (left - right)
    marked[UPPER_ARMS[0], 0] = left - trunk - inwards
    marked[UPPER_ARMS[1], 0] = right - trunk + inwards
    found, _ = REGRESSION(marked)
    direct, _ = REGRESSION(own, is_marked=False)
    np.testing.assert_allclose(found, direct, atol=0.01 * SCALE)


def test_people_seen_from_behind_and_with_unknown_ends(joints: np.ndarray) -> None:
    sticks = sticks_from_joints(MODEL.joint_names, joints[1])
    mirrored = joints[1] * (-1.0, 1.0) + (320.0, 0.0)
    back, _ = REGRESSION(sticks_from_joints(MODEL.joint_names, mirrored), is_marked=False)
    front, _ = REGRESSION(sticks, is_marked=False)
    np.testing.assert_allclose(back * (-1.0, 1.0) + (320.0, 0.0), front, atol=1e-6)
    sticks[3, 1] = np.nan
    found, _ = REGRESSION(sticks, is_marked=False)
    assert np.isfinite(found).all()
    with pytest.raises(InputError, match="scale"):
        REGRESSION(np.full((6, 2, 2), np.nan))
    with pytest.raises(InputError, match="shape"):
        REGRESSION(np.zeros((5, 2, 2)))


def test_files_of_sticks_start_people(joints: np.ndarray, tmp_path: Path) -> None:
    sticks = sticks_from_joints(MODEL.joint_names, joints[2])
    write_sticks(tmp_path / "s.txt", {4: [sticks]})
    ((person,),) = read_keypoints(tmp_path / "s.txt").values()
    found, confidence = joints_from_keypoints(MODEL, person)
    np.testing.assert_allclose(found, REGRESSION(sticks)[0], atol=0.1)
    assert (confidence == 1.0).all()
