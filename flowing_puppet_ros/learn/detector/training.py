# SPDX-License-Identifier: Apache-2.0
"""Learn the whole detector: filters and trees on most videos, the calibration of their scores on the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.detector.scoring import FEATURES, PoseScorer
from flowing_puppet_ros.learn.detector.boosted_trees import learn_forest
from flowing_puppet_ros.learn.detector.data import Example
from flowing_puppet_ros.learn.detector.part_filters import learn_parts
from flowing_puppet_ros.learn.detector.root_filters import learn_root
from flowing_puppet_ros.learn.detector.scoring import learn_ranking
from flowing_puppet_ros.settings import Settings, setting

PLACES = 12
RANKED = 220  # held-out people, about, that the ranking is learned on


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
    skin = PartLikelihood.load().skin
    detector = PartDetector(root, forest, parts, skin, PoseScorer(np.zeros(FEATURES), np.zeros(4), np.zeros(2)))
    ranking, found = rank(detector, others)
    return Learned(replace(detector, ranking=ranking), len(kept), len(others), found)


def rank(detector: PartDetector, examples: Sequence[Example]) -> tuple[PoseScorer, float]:
    """Learn the ranking on about RANKED of the examples; also the share of them whom the best poses find."""
    poses = []
    for example in examples[:: math.ceil(len(examples) / RANKED)]:
        smallest = max(8.0, max(example.image.shape[:2]) / 20)
        poses.append((example, detector.find_poses(example.image, smallest, PLACES)))
    return learn_ranking(poses)
