# SPDX-License-Identifier: Apache-2.0
"""Joints smoothed along the flow: against a direct minimisation, and on drawn people who move."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.smoothing import SmoothingSettings, flow_at_joints, smooth_joints
from flowing_puppet_ros.image.video.offline_smoother import OfflineSmoother
from test.helpers.drawn_people import NAMES, CapsuleModel, detection, draw, pose, tracker

SETTINGS = SmoothingSettings()
WRIST = NAMES.index("left_wrist")


def huber(distance: np.ndarray, width: float) -> np.ndarray:
    return np.where(distance < width, distance**2 / 2, width * (distance - width / 2))


def objective(
    x: np.ndarray, places: np.ndarray, confidence: np.ndarray, motion: np.ndarray, trust: np.ndarray
) -> float:
    """The sum of the module's docstring for one joint, at 100 px/m."""
    joints = x.reshape(-1, 2)
    data = confidence * huber(np.linalg.norm(joints - places, axis=1), 100 * SETTINGS.detection_width)
    ties = trust * huber(np.linalg.norm(np.diff(joints, axis=0) - motion, axis=1), 100 * SETTINGS.flow_width)
    return float(data.sum() + SETTINGS.flow_weight * ties.sum())


@pytest.mark.parametrize("seed", range(4))
def test_it_comes_close_to_the_minimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places, motion = rng.normal(0, 4, (8, 1, 2)), rng.normal(0, 2, (7, 1, 2))
    confidence, trust = rng.uniform(0.2, 1, (8, 1)), rng.uniform(0, 1, (7, 1))
    joints = smooth_joints(places, confidence, motion, trust, places, 100.0, SETTINGS)
    args = places[:, 0], confidence[:, 0], motion[:, 0], trust[:, 0]
    best = minimize(objective, joints.ravel(), args=args).fun
    assert objective(joints, *args) < 1.05 * best
    assert objective(joints, *args) < 0.9 * objective(places, *args)


def test_places_that_move_with_the_flow_stay() -> None:
    motion = np.full((9, 2, 2), (3.0, -1.0))
    places = np.concatenate([np.zeros((1, 2, 2)), motion.cumsum(axis=0)])
    joints = smooth_joints(places, np.ones((10, 2)), motion, np.ones((9, 2)), places, 100.0, SETTINGS)
    np.testing.assert_allclose(joints, places, atol=1e-9)


def test_a_gap_is_bridged_by_the_flow_from_both_sides() -> None:
    motion = np.zeros((9, 1, 2))
    motion[:, 0, 0] = [1, 1, 5, 5, -3, 2, 2, 1, 1]
    truth = np.concatenate([np.zeros((1, 1, 2)), motion.cumsum(axis=0)])
    places = truth.copy()
    places[3:7] = np.nan
    joints = smooth_joints(places, np.ones((10, 1)), motion, np.ones((9, 1)), np.zeros_like(truth), 100.0, SETTINGS)
    np.testing.assert_allclose(joints, truth, atol=1e-3)


def test_an_outlier_is_outvoted_by_its_neighbours_and_the_flow() -> None:
    places = np.zeros((9, 1, 2))
    places[4] = 60.0
    joints = smooth_joints(places, np.ones((9, 1)), np.zeros((8, 1, 2)), np.ones((8, 1)), places, 100.0, SETTINGS)
    assert np.abs(joints).max() < 3


def test_where_nothing_is_known_the_start_stays() -> None:
    start = np.random.default_rng(0).normal(0, 50, (5, 2, 2))
    unknown = np.full((5, 2, 2), np.nan)
    nothing = np.zeros((4, 2, 2)), np.zeros((4, 2))
    np.testing.assert_allclose(
        smooth_joints(unknown, np.zeros((5, 2)), *nothing, start, 100.0, SETTINGS), start, atol=1e-9
    )


@given(st.floats(-5, 5), st.floats(-5, 5), st.sampled_from([(64, 48), (32, 24), (16, 24)]))
def test_motion_of_a_uniform_flow_is_that_flow_in_image_pixels(x: float, y: float, work: tuple[int, int]) -> None:
    grid = ImageScale((64, 48), work)
    shift = np.array([x, y])
    field = np.broadcast_to((shift * grid.factor).astype(np.float32), (work[1], work[0], 2)).copy()
    before = np.array([[20.0, 20.0], [40.5, 10.25], [np.nan, 3.0], [-9.0, 5.0]])
    motion, trust = flow_at_joints((field, -field), grid, before, before + shift)
    np.testing.assert_allclose(motion[:2], [shift, shift], atol=1e-5)
    np.testing.assert_allclose(trust, [1, 1, 0, 0], atol=1e-9)
    np.testing.assert_array_equal(motion[2:], 0)


def test_flows_that_do_not_return_are_trusted_less() -> None:
    forth, back = np.full((2, 40, 40, 2), 4.0, np.float32)
    _, trust = flow_at_joints(
        (forth, back), ImageScale((40, 40), (40, 40)), np.full((1, 2), 9.0), np.full((1, 2), 13.0)
    )
    assert trust[0] < 0.05


def noisy(truth: np.ndarray, rng: np.random.Generator) -> Keypoints:
    return detection(truth + rng.normal(0, 2.5, truth.shape))


def test_a_drawn_persons_noisy_joints_come_closer_and_calmer() -> None:
    rng = np.random.default_rng(3)
    truth = np.array([pose(t) for t in range(12)])
    follower, clip = tracker(), OfflineSmoother(CapsuleModel(), SETTINGS)  # type: ignore[arg-type]
    given = [noisy(joints, rng) for joints in truth]
    for t, joints in enumerate(truth):
        clip.add(follower.step(draw(joints), t, [given[t]]))
    people = list(clip.people())
    assert [[puppet.id for puppet in image] for image in people] == [["a1"]] * 12
    arms = [NAMES.index(f"{side}_{name}") for side in ("left", "right") for name in ("elbow", "wrist")]
    after = np.array([image[0].joints for image in people])[:, arms]
    before = np.array([keypoints.xy for keypoints in given])[:, arms]

    def off(joints: np.ndarray) -> float:
        return float(np.linalg.norm(joints - truth[:, arms], axis=2).mean())

    def shake(joints: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(joints - truth[:, arms], 2, axis=0), axis=2).mean())

    assert off(after) < 0.75 * off(before)
    assert shake(after) < 0.5 * shake(before)
    for image in people:
        np.testing.assert_allclose(image[0].contours[0], image[0].shape.contours[0])


def test_people_come_and_go() -> None:
    follower, clip = tracker(max_missed_detections=1), OfflineSmoother(CapsuleModel(), SETTINGS)  # type: ignore[arg-type]
    one, other = pose(0, (90, 118)), pose(0, (230, 118))
    seen = [[], [one], [one, other], [one, other], [other], [other], []]
    for t, people in enumerate(seen):
        clip.add(follower.step(draw(one, other), t, [detection(joints) for joints in people]))
    found = [[puppet.id for puppet in image] for image in clip.people()]
    assert found[0] == []
    assert found[1] == ["a1"]
    assert found[2] == found[3] == ["a1", "a2"]
    assert "a1" not in found[5]
    assert len(found) == len(seen)


def test_joints_that_nobody_saw_are_where_the_body_model_puts_them() -> None:
    follower, clip = tracker(), OfflineSmoother(CapsuleModel(), SETTINGS)  # type: ignore[arg-type]
    live = []
    for t in range(4):
        keypoints = detection(pose(t))
        xy = keypoints.xy.copy()
        xy[WRIST] = np.nan
        result = follower.step(draw(pose(t)), t, [replace(keypoints, xy=xy)])
        live.append(result.puppets[0].joints[WRIST])
        clip.add(result)
    np.testing.assert_allclose([image[0].joints[WRIST] for image in clip.people()], live)
