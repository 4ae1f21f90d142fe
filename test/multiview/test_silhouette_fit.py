# SPDX-License-Identifier: Apache-2.0
"""Fits to the silhouettes of a man made of balls, whose outlines and joints owe nothing to the learned body model."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.silhouette_fit import SilhouetteFitter, SilhouetteFitterSettings

Ring = Callable[..., list[Camera]]
Views = list[tuple[Camera, np.ndarray]]
Joints = dict[str, tuple[float, float, float, float]]

LIMBS = (
    ("shoulder", "elbow", 0.055, 0.045),
    ("elbow", "wrist", 0.045, 0.032),
    ("wrist", "hand", 0.035, 0.03),
    ("hip", "knee", 0.085, 0.058),
    ("knee", "ankle", 0.055, 0.042),
    ("ankle", "toe", 0.045, 0.035),
)
TRUNK = (
    ("left_shoulder", "right_shoulder", 0.07, 0.07),
    ("neck", "face", 0.06, 0.09),
    ("face", "head_top", 0.09, 0.06),
    ("left_hip", "right_hip", 0.1, 0.1),
    ("left_rib", "left_hip", 0.11, 0.1),
    ("right_rib", "right_hip", 0.11, 0.1),
)
COMPARED = [f"{side}_{name}" for side in ("left", "right") for name in ("elbow", "wrist", "knee", "ankle")]


def man(yaw: float = 0.7) -> dict[str, np.ndarray]:
    """Joints in metres around the origin, z up; one arm is lifted sideways, one elbow bent forward."""
    joints = {"pelvis": (0, 0, 0), "neck": (0, 0, 0.5), "face": (0.04, 0, 0.64), "head_top": (0.01, 0, 0.74)}
    for side, sign, lift, bend in (("left", 1, 0.9, 0.2), ("right", -1, 0.3, 1.1)):
        upper = np.array([0, sign * np.sin(lift), -np.cos(lift)])
        lower = np.cos(bend) * upper + np.sin(bend) * np.array([1.0, 0, 0])
        shoulder = np.array([0, 0.17 * sign, 0.42])
        places = {
            "shoulder": shoulder,
            "elbow": shoulder + 0.28 * upper,
            "wrist": shoulder + 0.28 * upper + 0.25 * lower,
            "hand": shoulder + 0.28 * upper + 0.35 * lower,
            "rib": (0, 0.07 * sign, 0.38),
            "hip": (0, 0.09 * sign, -0.04),
            "knee": (0.06 * (1 + sign), 0.12 * sign, -0.43),
            "ankle": (0.03, 0.14 * sign, -0.82),
            "toe": (0.17, 0.16 * sign, -0.86),
        }
        joints |= {f"{side}_{name}": place for name, place in places.items()}
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return {name: turn @ np.array(place, float) for name, place in joints.items()}


def mask_of(camera: Camera, joints: dict[str, np.ndarray]) -> np.ndarray:
    """The man as `camera` sees him: discs of balls along his limbs."""
    sides = [(f"{side}_{a}", f"{side}_{b}", ra, rb) for side in ("left", "right") for a, b, ra, rb in LIMBS]
    mask = np.zeros(camera.size[::-1], np.uint8)
    for first, second, start, end in (*sides, *TRUNK):
        for share in np.linspace(0, 1, 25):
            pixel, depth = camera.project(joints[first] + share * (joints[second] - joints[first]))
            radius = camera.focal * (start + share * (end - start)) / float(depth)
            cv2.circle(mask, tuple(int(v) for v in np.rint(pixel * 16)), round(radius * 16), 255, -1, shift=4)
    return mask


def seen_by(cameras: list[Camera]) -> Views:
    return [(camera, mask_of(camera, man())) for camera in cameras]


def start(noise: float = 0.03, swapped: bool = False) -> Joints:
    """Joints as triangulation gives them: some, and some centimetres off."""
    rng = np.random.default_rng(4)
    names = [name for name in man() if not name.endswith(("rib", "toe", "hand"))]
    places = {name: man()[name] + rng.normal(size=3) * noise for name in names}
    if swapped:
        other = {name: name.replace("left", "*").replace("right", "left").replace("*", "right") for name in names}
        places = {other[name]: place for name, place in places.items()}
    return {name: (float(p[0]), float(p[1]), float(p[2]), 0.7) for name, p in places.items()}


@pytest.fixture(scope="module")
def fitter() -> SilhouetteFitter:
    return SilhouetteFitter(StitchedPuppet.load("neutral"))


def errors(fitter: SilhouetteFitter, fit: BodyFit) -> np.ndarray:
    names = fitter.model.joint_names
    return np.array([np.linalg.norm(fit.joints[names.index(name)] - man()[name]) for name in COMPARED])


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "bound"), [(2, 0.06), (3, 0.035), (4, 0.035)])
def test_a_man_is_found_by_two_cameras_and_better_by_more(
    fitter: SilhouetteFitter, ring: Ring, cameras: int, bound: float
) -> None:
    # Two opposite cameras would show the same outline twice.
    fit = fitter.fit(seen_by(ring(3 if cameras == 2 else cameras)[:cameras]), start())
    assert errors(fitter, fit).mean() < bound
    assert fit.reliable and fit.confidence > 0.8
    assert (fit.part_confidence > 0.7).all()
    assert fit.two_way_distance < 0.02 and fit.energy < 0.02


@pytest.mark.slow
def test_the_same_input_gives_the_same_bits(fitter: SilhouetteFitter, ring: Ring) -> None:
    first, second = (fitter.fit(seen_by(ring(3)), start()) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)


def test_confused_sides_are_found_out(fitter: SilhouetteFitter, ring: Ring) -> None:
    # Both bodies overlap well with a man whose front is much like his back: both are tried because neither is enough.
    demanding = SilhouetteFitter(fitter.model, SilhouetteFitterSettings(min_iou=0.95))
    fit = demanding.fit(seen_by(ring(4)), start(swapped=True))
    assert errors(fitter, fit).mean() < 0.06
    assert not fit.reliable


def test_a_camera_that_shows_something_else_is_left_out(fitter: SilhouetteFitter, ring: Ring) -> None:
    views = seen_by(ring(4))
    wrong = np.zeros_like(views[2][1])
    wrong[20:60, 10:200] = 255
    fit = fitter.fit([*views[:2], (views[2][0], wrong), views[3]], start())
    assert errors(fitter, fit).mean() < 0.04
    assert fit.reliable


def test_an_empty_mask_is_no_view(fitter: SilhouetteFitter, ring: Ring) -> None:
    views = seen_by(ring(4))
    blind = (views[1][0], np.zeros_like(views[1][1]))
    without = fitter.fit([views[0], *views[2:]], start())
    np.testing.assert_array_equal(fitter.fit([views[0], blind, *views[2:]], start()).vertices, without.vertices)
    with pytest.raises(InputError, match="1 of 2 silhouettes show a person's outline, and a fit needs 2"):
        fitter.fit([views[0], blind], start())


def test_joints_that_place_no_body_leave_the_start_to_the_body_before(fitter: SilhouetteFitter, ring: Ring) -> None:
    views = seen_by(ring(4))
    with pytest.raises(InputError, match="a start needs 4"):
        fitter.fit(views, {})
    before = fitter.fit(views, start())
    assert errors(fitter, fitter.fit(views, {}, before.state)).mean() < 0.045


def test_a_body_that_is_not_there_is_not_reliable(fitter: SilhouetteFitter, ring: Ring) -> None:
    aside = {name: (x + 0.5, y, z, c) for name, (x, y, z, c) in start().items()}
    strict = SilhouetteFitter(fitter.model, SilhouetteFitterSettings(gauss_newton_steps=1))
    fit = strict.fit(seen_by(ring(3)), aside)
    assert not fit.reliable and fit.confidence < 0.6
