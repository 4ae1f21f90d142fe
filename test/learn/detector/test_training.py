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
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.annotations import AnnotatedFrame, AnnotatedPerson
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.learn.detector import command
from flowing_puppet_ros.learn.detector.boosting import boost
from flowing_puppet_ros.learn.detector.data import JOINTS, Example, is_close, make_examples
from flowing_puppet_ros.learn.detector.scoring import fit_logistic
from flowing_puppet_ros.learn.detector.squared_hinge import train
from flowing_puppet_ros.learn.detector.training import LearnDetectorSettings, learn_detector


def examples(count: int, seed: int) -> list[Example]:
    rng = np.random.default_rng(seed)
    frames = []
    for index in range(count):
        image, joints, _ = painted.picture(rng)
        people = (AnnotatedPerson(painted.keypoints(joints), "neutral", "front"),)
        frames.append(AnnotatedFrame(f"{index}.png", 0, image, people))
    return make_examples(frames)


@pytest.fixture(scope="module")
def small() -> PartDetector:
    return learn_detector(examples(40, 0), LearnDetectorSettings(steps=40, trees=40), lambda _: None).detector


@pytest.mark.slow
def test_finds_other_painted_people(small: PartDetector) -> None:
    rng = np.random.default_rng(7)
    found, errors = 0, []
    for _ in range(20):
        image, joints, scale = painted.picture(rng)
        (best,) = small.detect(image, DetectorSettings(min_confidence=0.0, max_people=1, mirrored=False))
        near = np.linalg.norm(best.neck - joints[painted.NAMES.index("neck")]) < 0.4 * scale
        if near and 0.75 < best.scale / scale < 1.3:
            found += 1
            order = [best.keypoints.names.index(name) for name in painted.NAMES]
            errors.append(np.linalg.norm(best.keypoints.xy[order] - joints, axis=1) / scale)
    assert found >= 18
    median = dict(zip(painted.NAMES, np.median(errors, axis=0), strict=True))
    assert median["right_shoulder"] < 0.1 and median["left_shoulder"] < 0.1
    assert median["right_elbow"] < 0.2 and median["left_elbow"] < 0.2


@pytest.mark.slow
def test_learning_twice_gives_the_same_bytes() -> None:
    settings = LearnDetectorSettings(steps=2, trees=2)
    one, two = (learn_detector(examples(8, 1), settings, lambda _: None).detector.to_arrays() for _ in range(2))
    assert all(one[name].tobytes() == two[name].tobytes() for name in one)


def test_people_of_one_video_are_not_enough() -> None:
    same = [replace(example, source="one") for example in examples(3, 2)]
    with pytest.raises(InputError, match="another"):
        learn_detector(same, LearnDetectorSettings(), lambda _: None)


def test_examples_follow_mirror_and_size() -> None:
    (example,) = examples(1, 3)
    mirrored = example.mirror()
    width = example.image.shape[1]
    right, left = JOINTS.index("right_elbow"), JOINTS.index("left_elbow")
    assert mirrored.joints[right] == pytest.approx([width - 1 - example.joints[left][0], example.joints[left][1]])
    np.testing.assert_array_equal(mirrored.image[:, ::-1], example.image)
    half = example.resize(0.5)
    np.testing.assert_allclose(half.joints, (example.joints + 0.5) / 2 - 0.5)
    assert half.scale == example.scale / 2


def test_close_windows_and_those_of_others_are_no_negatives() -> None:
    (example,) = examples(1, 4)
    center = 0.6 * example.joint("neck") + 0.4 * example.joint("face")
    assert is_close(example, tuple(center), example.scale)
    assert not is_close(example, tuple(center), 2 * example.scale)
    assert not is_close(example, tuple(center + example.scale), example.scale)


@pytest.mark.slow
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
    command.add_arguments(parser)
    flags = [str(annotations), "--out", str(tmp_path / "out"), "--steps", "2", "--trees", "2", "--name", "small"]
    assert command.run(parser.parse_args(flags)) == 0
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
    right = (forest.score(codes[1000:]) > 0) == positive[1000:]
    assert right.mean() > 0.95


def test_logistic_regression_is_calibrated() -> None:
    rng = np.random.default_rng(9)
    x = rng.normal(size=(4000, 2)) * [1, 50] + [3, -20]
    truth = 1 / (1 + np.exp(-(x @ [1.0, 0.02] - 2.0)))
    right = rng.random(4000) < truth
    weight, bias = fit_logistic(x, right)
    predicted = 1 / (1 + np.exp(-(x @ weight + bias)))
    assert predicted.mean() == pytest.approx(right.mean(), abs=1e-4)
    assert np.abs(predicted - truth).max() < 0.08
