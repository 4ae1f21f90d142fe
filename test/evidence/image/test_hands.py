# SPDX-License-Identifier: Apache-2.0
"""Hand evidence: boxes rotate with the forearm, shipped filters recognise drawn hands, bad positions are neutral."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.hands import HandDetectors, HandField, HandMaps, hand_score, mirror
from flowing_puppet_ros.evidence.image.likelihood import ImageEvidence, PartLikelihood
from flowing_puppet_ros.learn.likelihood.samples import PosedPerson
from flowing_puppet_ros.learn.thesis_loop.hands import HandSettings, learn_hands
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

SCALE = 180.0
WRIST = np.array([[150.0, 120.0]])
SKIN, GROUND = (215, 160, 125), (60, 90, 70)


def arm(angle: float, size: int = 300) -> np.ndarray:
    """A bare forearm with a hand, its wrist in the middle of a square image."""
    image = np.full((size, size, 3), GROUND, np.uint8)
    middle, along = np.full(2, (size - 1) / 2), np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(round(v * 16) for v in middle + reach * SCALE * along) for reach in (-0.24, 0.0, 0.09)]
    cv2.line(image, ends[0], ends[1], SKIN, 13, cv2.LINE_AA, 4)
    cv2.circle(image, ends[2], round(0.05 * SCALE * 16), SKIN, -1, cv2.LINE_AA, 4)
    return image


def evidence(image: np.ndarray) -> ImageEvidence:
    return PartLikelihood.load().prepare(image)


def test_a_box_that_turns_with_the_image_reads_the_same() -> None:
    middle = np.array([[149.5, 149.5]])
    flat = HandField.of_image(evidence(arm(0.0)), SCALE).describe(middle, np.zeros(1), 7.0)[0]
    for quarter in (1, 2, 3):
        turned = np.ascontiguousarray(np.rot90(arm(0.0), -quarter))
        field = HandField.of_image(evidence(turned), SCALE)
        again = field.describe(middle, np.array([quarter * np.pi / 2]), 7.0)[0]
        np.testing.assert_allclose(again, flat, atol=0.05)
    mirrored = HandField.of_image(evidence(np.ascontiguousarray(arm(0.0)[::-1])), SCALE)
    np.testing.assert_allclose(mirror(mirrored.describe(middle, np.zeros(1), 7.0))[0], flat, atol=0.05)


def test_the_shipped_filters_know_where_a_drawn_hand_is() -> None:
    maps = HandMaps.of(HandDetectors.load(), evidence(arm(0.7)), [], SCALE)
    along = 40.0 * np.array([[np.cos(0.7), np.sin(0.7)]])
    middle = np.full((1, 2), 149.5)
    y, x = np.mgrid[30:270:8, 30:270:8]
    places = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    places = places[np.linalg.norm(places - 149.5, axis=1) > 0.15 * SCALE]
    right, others = hand_score(maps, middle, middle - along, SCALE), hand_score(maps, places, places - along, SCALE)
    assert (others < right).mean() > 0.95
    odds, turns = maps.best_orientation("image", middle)
    assert odds[0] >= maps.log_odds("image", middle, turns)[0] - 1e-6


def test_motion_shows_in_the_flow_field_alone() -> None:
    flow = np.zeros((300, 300, 2), np.float32)
    still = HandField.of_flow([flow], SCALE).describe(WRIST, np.zeros(1), 7.0)
    assert not still.any()
    cv2.circle(flow, (160, 120), 12, (6.0, 0.0), -1)
    flow[:, :, 0] += 3.0
    moved = HandField.of_flow([flow, flow], SCALE)
    cells = moved.describe(WRIST, np.zeros(1), 7.0).reshape(7, 5, -1)
    assert cells[3, 2, -1] > 0.4, "the hand moves beside a background that moves as well"
    assert cells[0, 0, -1] < 0.05
    flow[100:110] = np.nan
    assert np.isfinite(HandField.of_flow([flow], SCALE).describe(WRIST, np.zeros(1), 7.0)).all()


def test_bad_positions_are_neutral_and_foreshortened_forearms_may_point_anywhere() -> None:
    image = arm(0.0)
    maps = HandMaps.of(HandDetectors.load(), evidence(image), [np.zeros((300, 300, 2), np.float32)], SCALE)
    wrist = np.array([[np.nan, 1.0], [149.5, 149.5], [1e9, -1e9], [149.5, 149.5]])
    elbow = np.array([[0.0, 0.0], [149.5, 149.5], [0.0, 0.0], [110.0, 149.5]])
    score = hand_score(maps, wrist, elbow, SCALE)
    assert score[0] == 0.0
    assert np.isfinite(score).all()
    assert score[1] >= score[3]
    assert len(hand_score(maps, np.zeros((0, 2)), np.zeros((0, 2)), SCALE)) == 0


def test_arrays_come_back(tmp_path: Path) -> None:
    known = HandDetectors.load()
    np.savez(tmp_path / "h.npz", **known.to_arrays())  # type: ignore[arg-type]
    again = HandDetectors.from_arrays(dict(np.load(tmp_path / "h.npz")))
    assert again.filters["flow"].odds == known.filters["flow"].odds
    with pytest.raises(InputError, match="no hands model called 'none'"):
        HandDetectors.load("none")


@pytest.mark.slow
def test_learning_finds_what_drawn_hands_have_in_common() -> None:
    """Filters learned on drawn arms of some directions recognise arms of others."""
    model = DeformableStructures.load()
    puppet = model.puppet_from_joints(model.mean_joints() * SCALE + [80.0, 30.0], SCALE)
    wrist, elbow = (model.joint_names.index(f"left_{name}") for name in ("wrist", "elbow"))
    people = []
    for k in range(84):
        angle = 2.4 * k
        joints = puppet.joints.copy()
        joints[wrist] = 79.5
        joints[elbow] = 79.5 - 0.24 * SCALE * np.array([np.cos(angle), np.sin(angle)])
        image = arm(angle, 160)
        shape = model.puppet_from_joints(joints, SCALE)
        seen = np.isin(np.arange(len(joints)), (wrist, elbow)).astype(float)
        people.append(PosedPerson(f"v{k}.avi", image, shape, seen, image))
    learned, boxes = learn_hands(model, lambda: people, HandSettings(wrong=4), lambda _: None)
    assert boxes.right.sum() == 84
    maps = HandMaps.of(learned, evidence(arm(0.5, 160)), [], SCALE)
    elbows = np.array([[79.5 - 40 * np.cos(0.5), 79.5 - 40 * np.sin(0.5)], [70.0, 20.0]])
    score = hand_score(maps, np.array([[79.5, 79.5], [40.0, 40.0]]), elbows, SCALE)
    assert score[0] > score[1] + 2.0
    with pytest.raises(InputError, match="too few wrists"):
        learn_hands(model, lambda: people[:3], HandSettings(wrong=4), lambda _: None)
