# SPDX-License-Identifier: Apache-2.0
"""The shipped detector: what it says about one picture hangs together, and no input breaks it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import painted_people as painted  # type: ignore[import-not-found]
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.region import RegionMap
from flowing_puppet_ros.image.detector.detection import JOINTS, PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.detector.part_filters import (
    COLUMNS,
    DIMENSIONS,
    NECK_COLUMN,
    NECK_ROW,
    OUTSIDE_INDEX,
    PARTS,
    ROWS,
    extract_window,
)
from flowing_puppet_ros.image.detector.proposals import propose
from flowing_puppet_ros.image.detector.root_filters import (
    RootFilters,
    correlate,
    make_level,
    make_pyramid,
    non_max_suppression,
    window_iou,
)
from flowing_puppet_ros.image.detector.skin_features import skin_features
from flowing_puppet_ros.image.formats.keypoints import joints_from_keypoints
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

ANYBODY = DetectorSettings(min_confidence=0.0)


@pytest.fixture(scope="module")
def detector() -> PartDetector:
    return PartDetector.load()


@pytest.fixture(scope="module")
def person(detector: PartDetector) -> PersonDetection:
    image, _, _ = painted.picture(np.random.default_rng(3), 40.0)
    return detector.detect(image, ANYBODY)[0]


def test_joints_sticks_and_scale_are_of_one_person(person: PersonDetection) -> None:
    assert person.keypoints.names == JOINTS and np.isfinite(person.keypoints.xy).all()
    assert 0 <= person.confidence <= 1
    assert (person.keypoints.confidence <= person.confidence).all() and (person.keypoints.confidence >= 0).all()
    assert person.sticks.shape == (6, 2, 2)
    elbow = person.keypoints.xy[JOINTS.index("left_elbow")]
    np.testing.assert_allclose(person.sticks[1, 1], elbow)
    joints, _ = joints_from_keypoints(DeformableStructures.load(), person.keypoints)
    assert np.isfinite(joints[:9]).all()


def test_scores_are_highest_at_the_joints(person: PersonDetection) -> None:
    rng = np.random.default_rng(0)
    for joint, place in zip(JOINTS, person.keypoints.xy, strict=True):
        around = place + rng.uniform(-1.5, 1.5, (200, 2)) * person.scale
        scores = person.joint_score(joint, around)
        at = person.joint_score(joint, place[None])[0]
        assert scores.max() <= 1e-3
        assert at > -1.0 and at >= np.quantile(scores, 0.95)


def test_scores_far_away_and_of_no_place_are_finite(person: PersonDetection) -> None:
    places = np.array([[1e7, -1e7], [np.nan, 0.0]])
    assert np.isfinite(person.joint_score("left_wrist", places)).all()
    assert person.joint_score("left_wrist", np.zeros((0, 2))).shape == (0,)


def test_modes_differ_in_the_arms_alone(person: PersonDetection) -> None:
    modes = person.modes(12)
    assert len(modes) == 12
    scores = [score for _, score in modes]
    assert scores == sorted(scores, reverse=True) and scores[0] == 0
    np.testing.assert_array_equal(modes[0][0].xy, person.keypoints.xy)
    wrists = [JOINTS.index(f"{side}_wrist") for side in ("right", "left")]
    trunk = [JOINTS.index(name) for name in ("neck", "face", "belly", "right_hip", "left_hip")]
    for i, (one, _) in enumerate(modes):
        np.testing.assert_array_equal(one.xy[trunk], person.keypoints.xy[trunk])
        for other, _ in modes[:i]:
            assert np.linalg.norm(one.xy[wrists] - other.xy[wrists], axis=1).max() > 0.2 * person.scale


def test_a_mode_scores_what_its_wrist_does(person: PersonDetection) -> None:
    found = [score for _, score in person.modes(2)]
    wrists = [
        person.joint_score(f"{side}_wrist", person.modes(2)[1][0].xy[[JOINTS.index(f"{side}_wrist")]])[0]
        for side in ("right", "left")
    ]
    assert min(wrists) == pytest.approx(found[1], abs=0.5)


@pytest.mark.slow
def test_same_picture_same_people(detector: PartDetector) -> None:
    image, _, _ = painted.picture(np.random.default_rng(4))
    one, two = (detector.detect(image.copy(), ANYBODY) for _ in range(2))
    assert [p.keypoints.xy.tobytes() for p in one] == [p.keypoints.xy.tobytes() for p in two]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_in_the_mirror_image_the_same_person_is_found_with_the_sides_swapped(detector: PartDetector, seed: int) -> None:
    image, _, _ = painted.picture(np.random.default_rng(seed), 40.0)
    person, mirrored = (detector.detect(np.ascontiguousarray(pixels), ANYBODY)[0] for pixels in (image, image[:, ::-1]))
    swapped = [name.replace("left", "*").replace("right", "left").replace("*", "right") for name in JOINTS]
    joints = mirrored.keypoints.xy[[JOINTS.index(name) for name in swapped]]
    joints[:, 0] = image.shape[1] - 1 - joints[:, 0]
    np.testing.assert_allclose(joints, person.keypoints.xy, atol=0.5)
    assert person.pose.window.mirror != mirrored.pose.window.mirror
    for side, other in (("left", "right"), ("right", "left")):
        arms, turned = person.arm_hypotheses(side, 3), mirrored.arm_hypotheses(other, 3)
        turned[..., 0] = image.shape[1] - 1 - turned[..., 0]
        np.testing.assert_allclose(turned, arms, atol=0.5)
        wrists = arms[:, 1]
        score = mirrored.joint_score(f"{other}_wrist", wrists * (-1, 1) + (image.shape[1] - 1, 0))
        np.testing.assert_allclose(score, person.joint_score(f"{side}_wrist", wrists), atol=0.05)


@pytest.mark.slow
def test_people_are_reported_once_and_surest_first(detector: PartDetector) -> None:
    people = detector.detect(painted.picture(np.random.default_rng(5))[0], ANYBODY)
    assert [p.confidence for p in people] == sorted((p.confidence for p in people), reverse=True)
    for i, one in enumerate(people):
        assert all(np.linalg.norm(one.neck - two.neck) >= 0.5 * max(one.scale, two.scale) for two in people[:i])
    few = detector.detect(painted.picture(np.random.default_rng(5))[0], DetectorSettings(max_people=1))
    assert len(few) <= 1


def test_a_pose_is_found_again_where_it_was_found(detector: PartDetector, person: PersonDetection) -> None:
    image, _, _ = painted.picture(np.random.default_rng(3), 40.0)
    places = detector.propose(image, ANYBODY)
    assert len(places) > 1
    nearest = min(places, key=lambda place: float(np.linalg.norm(place.neck - person.neck)))
    (again,) = detector.detect_at(image, [nearest], ANYBODY)
    assert np.linalg.norm(again.neck - person.neck) < 0.5 * person.scale
    assert again.scale == pytest.approx(nearest.scale)
    assert again.confidence == pytest.approx(1 / (1 + np.exp(-nearest.log_odds)))


def test_nobody_is_seen_at_a_place_whose_pose_scores_too_little(detector: PartDetector) -> None:
    image, _, _ = painted.picture(np.random.default_rng(3), 40.0)
    place = detector.propose(image, ANYBODY)[0]
    score = detector.detect_at(image, [place], ANYBODY)[0].pose.score
    supposed = [replace(place, min_score=score - 0.1), replace(place, min_score=score + 0.1)]
    assert len(detector.detect_at(image, supposed, ANYBODY)) == 1


def test_places_of_a_large_image_are_in_its_pixels(detector: PartDetector) -> None:
    image = painted.picture(np.random.default_rng(3), 40.0)[0]
    large = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    place = max(detector.propose(large, ANYBODY), key=lambda one: one.log_odds)
    assert (place.neck < np.array(large.shape[1::-1]) * 1.1).all()
    (found,) = detector.detect_at(large, [place], ANYBODY)
    assert np.linalg.norm(found.neck - place.neck) < 0.8 * place.scale


@pytest.mark.parametrize("shape", [(1, 1), (20, 300, 3)])
def test_too_small_an_image_has_no_places(detector: PartDetector, shape: tuple[int, ...]) -> None:
    image = np.zeros(shape, np.uint8)
    assert detector.propose(image) == []
    assert detector.detect_at(image, [PersonCandidate(np.zeros(2), np.array([0.0, -20.0]), 40.0, 0.0)]) == []


def test_skin_is_measured_on_face_around_it_and_on_the_chest() -> None:
    values = np.zeros((100, 100))
    values[15:26, 45:56] = 2.0  # the face
    values[60:, :] = 1.0
    measures = skin_features(RegionMap.of(values), np.array([50.0, 45.0]), np.array([50.0, 20.0]), 25.0)
    assert measures[0] == pytest.approx(2.0) and 1.0 < measures[1] < 2.0 and 0.1 < measures[2] < 0.9
    assert (skin_features(RegionMap.of(values), np.full(2, 900.0), np.full(2, 900.0), 25.0) == 0.0).all()


@pytest.mark.parametrize("lost", [("right_shoulder", "left_shoulder"), ("neck", "face")])
def test_two_joints_in_one_place_do_not_make_a_person_small(
    detector: PartDetector, person: PersonDetection, lost: tuple[str, str]
) -> None:
    placement = person.pose.placement.copy()
    placement[PARTS.index(lost[0]), 1:] = placement[PARTS.index(lost[1]), 1:]
    collapsed = replace(person.pose, placement=placement)
    whole, changed = (detector.scorer.correct_scale(pose, 40.0) for pose in (person.pose, collapsed))
    assert 0.85 * whole < changed < whole


@pytest.mark.slow
def test_ten_people_are_no_more_work_than_asked(detector: PartDetector) -> None:
    rng = np.random.default_rng(6)
    image = painted.ground(rng, (900, 300))
    for index in range(10):
        joints = painted.joints_at((50.0 + 88 * index, 90.0 + 20 * (index % 3)), 36.0, rng)
        painted.paint(image, joints, 36.0, rng)
    people = detector.detect(image, DetectorSettings(max_people=5, min_confidence=0.0))
    assert len(people) == 5


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 1), (1, 400, 3), (7, 9), (24, 24, 3), (400, 9), (240, 320)])
@pytest.mark.parametrize("kind", ["black", "noise"])
def test_images_of_any_size_without_a_person(detector: PartDetector, shape: tuple[int, ...], kind: str) -> None:
    rng = np.random.default_rng(0)
    image = np.zeros(shape, np.uint8) if kind == "black" else rng.integers(0, 256, shape, dtype=np.uint8)
    for found in detector.detect(image):
        assert found.confidence < 0.6
        assert np.isfinite(found.keypoints.xy).all()


def test_a_hundred_megapixels_are_shrunk(detector: PartDetector) -> None:
    image = np.zeros((10_000, 10_000), np.uint8)
    image[4000:6000, 4000:6000] = 200
    for found in detector.detect(image, DetectorSettings(max_side=200, max_candidates=1)):
        assert found.scale > 100


@pytest.mark.parametrize(
    "image",
    [np.zeros((0, 4, 3), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((9, 9)), np.zeros(9, np.uint8), None],
)
def test_what_is_no_image_is_one_sentence(detector: PartDetector, image: np.ndarray) -> None:
    with pytest.raises(InputError, match="an image must be"):
        detector.detect(image)


@pytest.mark.slow
def test_half_a_person_at_the_border_stays_finite(detector: PartDetector) -> None:
    image, joints, _ = painted.picture(np.random.default_rng(8), 45.0)
    cut = np.ascontiguousarray(image[:, int(joints[0, 0]) :])
    for found in detector.detect(cut, ANYBODY):
        assert np.isfinite(found.keypoints.xy).all() and found.scale > 0


def test_arrays_come_back_as_they_went(detector: PartDetector) -> None:
    arrays = detector.to_arrays()
    again = PartDetector.from_arrays(arrays).to_arrays()
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)
    with pytest.raises(InputError, match="no detector model"):
        PartDetector.load("nobody")


def test_responses_are_correlations() -> None:
    rng = np.random.default_rng(1)
    features = rng.normal(size=(7, 8, 4)).astype(np.float32)
    filters = rng.normal(size=(3, 3, 2, 4)).astype(np.float32)
    got = correlate(features, filters)
    assert got.shape == (5, 7, 3)
    for row, column, k in np.ndindex(got.shape):
        assert got[row, column, k] == pytest.approx(
            (features[row : row + 3, column : column + 2] * filters[k]).sum(), abs=1e-4
        )
    assert correlate(features[:2], filters).shape == (0, 7, 3)


def test_levels_cover_the_scales() -> None:
    scales = [at.scale for at in make_pyramid(np.zeros((60, 80, 3), np.uint8), 12.0)]
    assert scales[0] == pytest.approx(12.0) and 60 < scales[-1] <= 80
    np.testing.assert_allclose(np.diff(np.log2(scales)), 0.25)


@settings(max_examples=20, deadline=None)
@given(x=st.integers(-5, 5), y=st.integers(-5, 5))
def test_windows_move_with_the_person(x: int, y: int) -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (160, 160, 3), dtype=np.uint8)
    moved = np.roll(image, (y, x), axis=(0, 1))
    one = extract_window(image, (80.5, 80.5), (80.5, 70.5), 20.0)
    two = extract_window(moved, (80.5 + x, 80.5 + y), (80.5 + x, 70.5 + y), 20.0)
    inner = slice(12, 30)
    np.testing.assert_allclose(one.features[inner, inner, :31], two.features[inner, inner, :31], atol=1e-5)
    np.testing.assert_allclose(two.to_points(np.array([NECK_COLUMN, NECK_ROW])), [80.5 + x, 80.5 + y])
    np.testing.assert_allclose(two.to_cells(two.to_points(np.array([3.0, 4.0]))), [3.0, 4.0])


def test_windows_beyond_the_image_are_marked() -> None:
    image = np.full((40, 40), 90, np.uint8)
    window = extract_window(image, (20.0, 20.0), (20.0, 15.0), 40.0)
    assert window.features.shape == (ROWS, COLUMNS, DIMENSIONS + 4)
    inside = window.features[..., OUTSIDE_INDEX] == 0
    assert 81 <= inside.sum() <= 100
    assert not extract_window(image, (900.0, 900.0), (900.0, 890.0), 40.0).features[..., :OUTSIDE_INDEX].any()


def test_overlap_of_windows_and_suppression(detector: PartDetector) -> None:
    image = painted.picture(np.random.default_rng(9))[0]
    found = propose(image, detector.root, 20.0)
    assert window_iou(found[0], found[0]) == pytest.approx(1.0)
    kept = non_max_suppression(found, 5)
    assert len(kept) == 5 and kept[0].score == max(one.score for one in found)


def test_a_filter_finds_the_window_it_was_cut_from() -> None:
    image = painted.picture(np.random.default_rng(10))[0]
    at = make_level(image, 42.0)
    row, column = 9, 11
    window = at.features[row : row + 11, column : column + 12]
    root = RootFilters(window[None] - window.mean(), np.zeros(1, np.float32), np.zeros((1, 2, 2), np.float32))
    scores = correlate(at.features, root.filters)[..., 0]
    assert scores.argmax() == row * scores.shape[1] + column
