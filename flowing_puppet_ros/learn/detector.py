# SPDX-License-Identifier: Apache-2.0
"""Learn the whole detector: filters and trees on most videos, the calibration of their scores on the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector import PartDetector
from flowing_puppet_ros.image.detector_parts import PARTS
from flowing_puppet_ros.learn.calibration import logistic
from flowing_puppet_ros.learn.detector_data import Example
from flowing_puppet_ros.learn.detector_forest import learn_forest
from flowing_puppet_ros.learn.detector_parts import learn_parts
from flowing_puppet_ros.learn.detector_root import learn_root
from flowing_puppet_ros.settings import Settings, setting

type Array = np.ndarray[Any, Any]

MEASURES = 9
FOUND_NECK, FOUND_SCALE = 0.5, 1.25  # units of S and ratio: a pose this close to the person has found them
PLACES = 12


@dataclass(frozen=True, slots=True)
class LearnDetectorSettings(Settings):
    """How much to look at, and for how long."""

    every: int = setting(3, "take every so many annotated frames of a video", low=1, high=10_000)
    steps: int = setting(1000, "steps of the part filters, 8 people each", low=1, high=1_000_000)
    trees: int = setting(400, "boosted trees of the second look", low=1, high=10_000)
    held_out: float = setting(0.15, "share of the videos that the calibration is learned on", low=0.05, high=0.5)
    seed: int = setting(0, "same seed and input, same filters", low=0, high=1_000_000)


@dataclass(frozen=True, slots=True)
class Learned:
    """The detector, and on the held-out videos: people, and the share in whose image the surest pose found them."""

    detector: PartDetector
    people: int
    held_out: int
    found: float


def learn(examples: Sequence[Example], settings: LearnDetectorSettings, report: Callable[[str], None]) -> Learned:
    """Learn from the examples; InputError when they come from fewer than two videos or images."""
    rng = np.random.default_rng(settings.seed)
    sources = sorted({example.source for example in examples})
    if len(sources) < 2:
        raise InputError("all annotated people are in one video; the calibration needs people of another one")
    held = set(rng.permutation(sources)[: max(1, round(settings.held_out * len(sources)))].tolist())
    kept = [example for example in examples if example.source not in held]
    others = [example for example in examples if example.source in held]
    report(f"learning on {len(kept)} people, calibrating on {len(others)} of other videos")
    root = learn_root(kept, settings.seed, report)
    forest = learn_forest(kept, root, settings.trees, settings.seed + 1, report)
    parts = learn_parts(kept, settings.steps, settings.seed + 2, report)
    weight, bias, found = calibrate(PartDetector(root, forest, parts, np.zeros(MEASURES), 0.0), others)
    return Learned(PartDetector(root, forest, parts, weight, bias), len(kept), len(others), found)


def calibrate(detector: PartDetector, examples: Sequence[Example]) -> tuple[Array, float, float]:
    """Weights (9,) and bias of the log-odds, and the share of people whom the surest pose then finds."""
    measures, right, image = [], [], []
    for index, example in enumerate(examples):
        smallest = max(8.0, max(example.image.shape[:2]) / 20)
        for pose in detector.look(example.image, smallest, PLACES):
            neck = pose.window.points_of(pose.placement[PARTS.index("neck"), 1:].astype(np.float64))
            ratio = 10 * pose.window.cell / example.scale
            near = np.linalg.norm(neck - example.joint("neck")) < FOUND_NECK * example.scale
            measures.append(pose.measures)
            right.append(bool(near) and 1 / FOUND_SCALE < ratio < FOUND_SCALE)
            image.append(index)
    if not any(right) or all(right):
        raise InputError(
            f"of {len(right)} places in the held-out images {sum(right)} show an annotated person; annotate more images"
        )
    values, truth, of_image = np.array(measures), np.array(right), np.array(image)
    weight, bias = logistic(values, truth)
    odds = values @ weight + bias
    best = [truth[of_image == i][odds[of_image == i].argmax()] for i in np.unique(of_image)]
    return weight, bias, float(np.sum(best)) / len(examples)
