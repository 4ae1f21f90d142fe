# SPDX-License-Identifier: Apache-2.0
"""Learn the whole detector: filters and trees on most videos, the calibration of scores on the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.detector.scoring import FEATURES, PoseScorer
from flowing_puppet_ros.learn.detector.boosted_trees import learn_boosted_trees
from flowing_puppet_ros.learn.detector.data import Example
from flowing_puppet_ros.learn.detector.part_filters import learn_part_filters
from flowing_puppet_ros.learn.detector.root_filters import learn_root_filters
from flowing_puppet_ros.learn.detector.scoring import learn_pose_scorer
from flowing_puppet_ros.settings import Settings, setting

MAX_CANDIDATES = 12  # per image, of which poses are found
CALIBRATION_PEOPLE = 220  # approximate number of held-out people that the scorer is learned from


@dataclass(frozen=True, slots=True)
class LearnDetectorSettings(Settings):
    """How much to learn from, and for how long."""

    every: int = setting(3, "use every n-th annotated frame of a video", low=1, high=10_000)
    steps: int = setting(1000, "steps of the part filters, 8 people each", low=1, high=1_000_000)
    trees: int = setting(400, "boosted trees that rescore candidates", low=1, high=10_000)
    held_out: float = setting(0.15, "share of the videos held out for calibration", low=0.05, high=0.5)
    seed: int = setting(0, "seed: same seed and input, same filters", low=0, high=1_000_000)


@dataclass(frozen=True, slots=True)
class LearnedDetector:
    """The detector, and how well it finds people.

    Attributes:
        detector: the detector.
        people: number of people it was learned from.
        held_out: number of people in the held-out videos.
        found: share of them whom the most confident pose finds.
    """

    detector: PartDetector
    people: int
    held_out: int
    found: float


def learn_detector(
    examples: Sequence[Example], settings: LearnDetectorSettings, report: Callable[[str], None]
) -> LearnedDetector:
    """Learn from the examples; InputError if they come from fewer than two videos or images."""
    rng = np.random.default_rng(settings.seed)
    sources = sorted({example.source for example in examples})
    if len(sources) < 2:
        raise InputError("all annotated people are in one video; calibration needs people of another one")
    held = set(rng.permutation(sources)[: max(1, round(settings.held_out * len(sources)))].tolist())
    kept = [example for example in examples if example.source not in held]
    others = [example for example in examples if example.source in held]
    report(f"learning on {len(kept)} people, calibrating on {len(others)} of other videos")
    root = learn_root_filters(kept, settings.seed, report)
    forest = learn_boosted_trees(kept, root, settings.trees, settings.seed + 1, report)
    parts = learn_part_filters(kept, settings.steps, settings.seed + 2, report)
    skin = PartLikelihood.load().skin
    detector = PartDetector(root, forest, parts, skin, PoseScorer(np.zeros(FEATURES), np.zeros(4), np.zeros(2)))
    ranking, found = calibrate(detector, others)
    return LearnedDetector(replace(detector, scorer=ranking), len(kept), len(others), found)


def calibrate(detector: PartDetector, examples: Sequence[Example]) -> tuple[PoseScorer, float]:
    """Learn the scorer from about CALIBRATION_PEOPLE examples; also return the share whom the best poses find."""
    found = []
    for example in examples[:: math.ceil(len(examples) / CALIBRATION_PEOPLE)]:
        smallest = max(8.0, max(example.image.shape[:2]) / 20)
        found.append((example, detector.find_poses(example.image, smallest, MAX_CANDIDATES)))
    return learn_pose_scorer(found)
