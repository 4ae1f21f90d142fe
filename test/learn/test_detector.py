# SPDX-License-Identifier: Apache-2.0
"""A small detector learned on painted people finds others, and the pieces that it is learned with."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import painted_people as painted  # type: ignore[import-not-found]
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector import DetectorSettings, PartDetector
from flowing_puppet_ros.image.detector_parts import PARTS
from flowing_puppet_ros.image.detector_rank import MEASURES, RELATIVE_SCALE
from flowing_puppet_ros.learn import detector_command
from flowing_puppet_ros.learn.annotations import AnnotatedFrame, AnnotatedPerson
from flowing_puppet_ros.learn.boosting import boost
from flowing_puppet_ros.learn.calibration import logistic
from flowing_puppet_ros.learn.detector import LearnDetectorSettings, learn
from flowing_puppet_ros.learn.detector_data import JOINTS, Example, close_to, examples_of
from flowing_puppet_ros.learn.detector_far import far_away, free_part
from flowing_puppet_ros.learn.detector_ranking import Looked, Outline, learn_ranking
from flowing_puppet_ros.learn.squared_hinge import train


def examples(count: int, seed: int) -> list[Example]:
    rng = np.random.default_rng(seed)
    frames = []
    for index in range(count):
        image, joints, _ = painted.picture(rng)
        people = (AnnotatedPerson(painted.keypoints(joints), "neutral", "front"),)
        frames.append(AnnotatedFrame(f"{index}.png", 0, image, people))
    return examples_of(frames)


@pytest.fixture(scope="module")
def small() -> PartDetector:
    return learn(examples(50, 0), LearnDetectorSettings(steps=40, trees=40), lambda _: None).detector


def test_finds_other_painted_people(small: PartDetector) -> None:
    rng = np.random.default_rng(7)
    found, errors = 0, []
    for _ in range(20):
        image, joints, scale = painted.picture(rng)
        people = small.detect(image, DetectorSettings(least_confidence=0.0))
        best = people[0]
        near = np.linalg.norm(best.neck - joints[painted.NAMES.index("neck")]) < 0.4 * scale
        if near and 0.75 < best.scale / scale < 1.3:
            found += 1
            order = [best.keypoints.names.index(name) for name in painted.NAMES]
            errors.append(np.linalg.norm(best.keypoints.xy[order] - joints, axis=1) / scale)
    assert found >= 16
    median = dict(zip(painted.NAMES, np.median(errors, axis=0), strict=True))
    assert median["right_shoulder"] < 0.2 and median["left_shoulder"] < 0.2
    assert median["right_elbow"] < 0.35 and median["left_elbow"] < 0.35


def test_learning_twice_gives_the_same_bytes() -> None:
    settings = LearnDetectorSettings(steps=2, trees=2)
    one, two = (learn(examples(12, 1), settings, lambda _: None).detector.to_arrays() for _ in range(2))
    assert all(one[name].tobytes() == two[name].tobytes() for name in one)


def test_people_of_one_video_are_not_enough() -> None:
    same = [replace(example, source="one") for example in examples(3, 2)]
    with pytest.raises(InputError, match="another"):
        learn(same, LearnDetectorSettings(), lambda _: None)


def test_examples_follow_mirror_and_size() -> None:
    (example,) = examples(1, 3)
    mirrored = example.mirrored()
    width = example.image.shape[1]
    right, left = JOINTS.index("right_elbow"), JOINTS.index("left_elbow")
    assert mirrored.joints[right] == pytest.approx([width - 1 - example.joints[left][0], example.joints[left][1]])
    np.testing.assert_array_equal(mirrored.image[:, ::-1], example.image)
    half = example.resized(0.5)
    np.testing.assert_allclose(half.joints, (example.joints + 0.5) / 2 - 0.5)
    assert half.scale == example.scale / 2


def test_close_windows_and_those_of_others_are_no_negatives() -> None:
    (example,) = examples(1, 4)
    center = 0.6 * example.joint("neck") + 0.4 * example.joint("face")
    assert close_to(example, tuple(center), example.scale)
    assert not close_to(example, tuple(center), 2 * example.scale)
    assert not close_to(example, tuple(center + example.scale), example.scale)


def test_people_far_away_are_the_same_people_in_another_image() -> None:
    near, *others = examples(6, 10)
    rng = np.random.default_rng(11)
    far = far_away(near, others, rng)
    assert far is not None and far.image.shape == near.image.shape
    factor = far.scale / near.scale
    assert 18.0 / near.scale - 0.01 <= factor < 0.81
    shrunk = near.resized(factor)
    moved = far.joints - shrunk.joints
    np.testing.assert_allclose(moved, np.broadcast_to(np.round(moved[0]), moved.shape), atol=1e-9)
    x, y = np.round(moved[0]).astype(int)
    height, width = shrunk.image.shape[:2]
    np.testing.assert_array_equal(far.image[y : y + height, x : x + width], shrunk.image)
    rest = np.ones(far.image.shape[:2], bool)
    rest[y : y + height, x : x + width] = False
    assert far.image[rest].std() > 0.0
    assert far_away(replace(near, scale=20.0), others, rng) is None


def test_what_is_free_shows_no_person() -> None:
    (example,) = examples(1, 12)
    marked = example.image.copy()
    x, y = np.round(0.6 * example.joint("neck") + 0.4 * example.joint("face")).astype(int)
    reach = round(example.scale)
    marked[max(0, y - reach) :, max(0, x - reach) : x + reach] = (255, 0, 255)
    free = free_part(example.with_image(marked))
    assert free is not None and not (free == (255, 0, 255)).all(axis=2).any()
    assert free_part(replace(example, scale=1000.0)) is None


def looked(rng: np.random.Generator, count: int, least: float, most: float) -> list[Looked]:
    """Right poses have the larger measure 1; their scale is off by a fifth of how far the person is from 50 px."""
    everyone = []
    for scale in np.exp(rng.uniform(np.log(least), np.log(most), count)):
        poses = []
        for right in (True, False):
            measures = rng.normal(size=MEASURES)
            measures[1] += 4.0 * right
            seen = scale * (50.0 / scale) ** 0.2
            measures[RELATIVE_SCALE] = np.log(seen / 320.0)
            points = rng.normal([160.0, 100.0], scale / 3, (len(PARTS), 2)) + (0.0 if right else 9.0 * scale)
            points[0] = np.array([160.0, 100.0]) + (0.0 if right else 9.0 * scale)
            poses.append(Outline(points, float(seen), measures))
        everyone.append(Looked(np.array([160.0, 100.0]), float(scale), [poses[k] for k in rng.permutation(2)]))
    return everyone


def test_ranking_tells_right_poses_and_their_scale_from_people_near_and_far() -> None:
    rng = np.random.default_rng(13)
    ranking, found = learn_ranking(looked(rng, 300, 40.0, 90.0), looked(rng, 300, 15.0, 40.0))
    assert found > 0.95
    errors, sure = [], []
    for one in looked(rng, 100, 15.0, 90.0):
        scores = np.sort(ranking.scores(one.poses))
        best = one.poses[int(ranking.scores(one.poses).argmax())]
        errors.append(np.log(ranking.corrected_scale(best, best.scale) / one.scale))
        sure.append([ranking.probability(score) for score in scores])
    assert np.mean(np.abs(errors) < 0.05) > 0.9
    assert np.mean(sure, axis=0) == pytest.approx([0.0, 1.0], abs=0.15)
    with pytest.raises(InputError, match="nobody was found"):
        learn_ranking([Looked(np.zeros(2), 40.0, [])], [])


def test_command_learns_from_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(5)
    images = {}
    for index in range(16):
        image, joints, _ = painted.picture(rng)
        cv2.imwrite(str(tmp_path / f"{index}.png"), image[..., ::-1])
        images[f"{index}.png"] = [{"joints": [[*map(float, joint), 1] for joint in joints]}]
    annotations = tmp_path / "annotations.json"
    annotations.write_text(json.dumps({"joint_names": painted.NAMES, "images": images}))
    parser = argparse.ArgumentParser()
    detector_command.add_arguments(parser)
    flags = [str(annotations), "--out", str(tmp_path / "out"), "--steps", "2", "--trees", "2", "--name", "small"]
    assert detector_command.run(parser.parse_args(flags)) == 0
    written = Path(capsys.readouterr().out.strip())
    with np.load(written) as arrays:
        assert PartDetector.from_arrays(arrays).parts.filters.shape[1:] == (5, 5, 36)
    card = written.with_suffix(".md").read_text()
    assert "14 people" in card and str(tmp_path) not in card


@pytest.mark.parametrize("dimensions", [5, 300])
def test_squared_hinge_reaches_its_minimum(dimensions: int) -> None:
    rng = np.random.default_rng(6)
    x = rng.normal(size=(200, dimensions)).astype(np.float32)
    positive = x[:, :4] @ [1, -2, 0, 0.5] + rng.normal(0, 0.7, 200) > 0.3
    weight, ridge = rng.uniform(0.5, 2, 200), 3.0
    solution = train(x, positive, weight, ridge).astype(float)
    sign = np.where(positive, 1.0, -1.0)
    slack = np.maximum(0, 1 - sign * (x @ solution[:-1] + solution[-1]))
    gradient = ridge * solution[:-1] - x.T @ (weight * sign * slack)
    assert np.abs(gradient).max() < 0.05
    assert abs((weight * sign * slack).sum()) < 0.05


def test_trees_learn_what_no_line_can() -> None:
    rng = np.random.default_rng(8)
    codes = rng.integers(0, 32, (2000, 3)).astype(np.uint8)
    positive = (np.abs(codes[:, 0] - 15.5) < 9) & (codes[:, 2] > 8)
    forest = boost(codes[:1000], positive[:1000], np.ones(1000), rng, trees=150)
    right = (forest.scores(codes[1000:]) > 0) == positive[1000:]
    assert right.mean() > 0.95


def test_logistic_regression_is_calibrated() -> None:
    rng = np.random.default_rng(9)
    x = rng.normal(size=(4000, 2)) * [1, 50] + [3, -20]
    truth = 1 / (1 + np.exp(-(x @ [1.0, 0.02] - 2.0)))
    right = rng.random(4000) < truth
    weight, bias = logistic(x, right)
    predicted = 1 / (1 + np.exp(-(x @ weight + bias)))
    assert predicted.mean() == pytest.approx(right.mean(), abs=1e-4)
    assert np.abs(predicted - truth).max() < 0.08
