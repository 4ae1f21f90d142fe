# SPDX-License-Identifier: Apache-2.0
"""Percentage of correctly estimated body parts (PCP), and of joints (PCK), and COCO's OKS AP, over many images.

A part is correct if its ends are within half the true stick's length of the true ends: each of them (strict;
Pishchulin et al., "Articulated people detection and pose estimation", CVPR 2012), or both on average (loose, like the
Buffy Stickmen software; Ferrari, Marin-Jimenez and Zisserman, CVPR 2008). Sticks are (6, 2, 2) px in the order of
`image.formats.stickmen.STICKS`; a stick with a NaN is unknown. Joints are shoulders, elbows and wrists.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.joints import ARM_JOINTS, measure_pck
from flowing_puppet_ros.evaluate.people import Unmatched, rate_people
from flowing_puppet_ros.evaluate.precision import ScoredImage, measure_precision
from flowing_puppet_ros.image.formats.stickmen import STICKS

MAX_END_SHARE = 0.5  # distance of a correct part's ends, as a share of the true stick's length
MAX_MATCH_SHARE = 0.75
"""Maximum mean distance of the ends of torso and head of a found person, as a share of the true torso's length."""

GROUPS = {
    "torso": ("torso",),
    "head": ("head",),
    "upper arms": ("left_upper_arm", "right_upper_arm"),
    "lower arms": ("left_lower_arm", "right_lower_arm"),
    "total": STICKS,
}
ARM_JOINT_NAMES = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ARM_JOINTS)
_TORSO, _HEAD = STICKS.index("torso"), STICKS.index("head")
_LOWER_ARMS = [STICKS.index("left_lower_arm"), STICKS.index("right_lower_arm")]


@dataclass(frozen=True, slots=True, eq=False)
class PosedSticks:
    """One estimated person: `sticks` (6, 2, 2) px, `solutions` (n, 6, 2, 2) px including the best one, and a score."""

    sticks: Array
    solutions: Array
    score: float = 1.0


def joints_of_sticks(sticks: Array) -> dict[str, Array]:
    """Return the known joints (2,) px of sticks (6, 2, 2): those of the arms, and the ends of torso and head."""
    (top, bottom), (neck, crown) = sticks[_TORSO], sticks[_HEAD]
    joints = {"neck": top, "pelvis": bottom, "upper_neck": neck, "head_top": crown}
    for side in ("left", "right"):
        joints[f"{side}_shoulder"] = sticks[STICKS.index(f"{side}_upper_arm"), 0]
        joints[f"{side}_elbow"], joints[f"{side}_wrist"] = sticks[STICKS.index(f"{side}_lower_arm")]
    return {name: joint for name, joint in joints.items() if np.isfinite(joint).all()}


def end_distances(sticks: Array, truth: Array) -> Array:
    """Return distances (6, 2) px of the ends of sticks (6, 2, 2) from the true ends, each in the better order."""
    straight = np.linalg.norm(sticks - truth, axis=2)
    swapped = np.linalg.norm(sticks[:, ::-1] - truth, axis=2)
    return np.where((swapped.sum(axis=1) < straight.sum(axis=1))[:, None], swapped, straight)


def check_parts(sticks: Array, truth: Array) -> tuple[Array, Array]:
    """Return whether each stick (6,) is correct, strictly and loosely; an unknown estimate is wrong."""
    allowed = MAX_END_SHARE * np.linalg.norm(truth[:, 1] - truth[:, 0], axis=1)
    apart = np.where(np.isfinite(sticks).all(axis=(1, 2))[:, None], end_distances(sticks, truth), np.inf)
    return (apart <= allowed[:, None]).all(axis=1), apart.mean(axis=1) <= allowed


def match_people(people: Sequence[PosedSticks], truths: Sequence[Array]) -> list[PosedSticks | None]:
    """Match each true person with the estimate whose torso and head fit best; None if no estimate is near."""
    cost = np.full((len(truths), len(people)), np.inf)
    for row, truth in enumerate(truths):
        length = np.linalg.norm(truth[_TORSO, 1] - truth[_TORSO, 0])
        if not np.isfinite(length):
            length = 3.0 * np.linalg.norm(truth[_HEAD, 1] - truth[_HEAD, 0])
        for column, person in enumerate(people):
            apart = end_distances(person.sticks, truth)[[_TORSO, _HEAD]]
            if np.isfinite(apart).any():
                cost[row, column] = np.nanmean(apart) / length
    matched: list[PosedSticks | None] = [None] * len(truths)
    while cost.size and cost.min() <= MAX_MATCH_SHARE:
        row, column = divmod(int(cost.argmin()), cost.shape[1])
        matched[row] = people[column]
        cost[row], cost[:, column] = np.inf, np.inf
    return matched


@dataclass(slots=True)
class Tally:
    """Counts over all true people; every known part of a missed person counts as wrong."""

    pixels: float = 20.0
    unmatched: Unmatched = "wrong"
    people: int = 0
    found: int = 0
    known: Array = field(default_factory=lambda: np.zeros(len(STICKS)))
    strict: Array = field(default_factory=lambda: np.zeros(len(STICKS)))
    loose: Array = field(default_factory=lambda: np.zeros(len(STICKS)))
    ends: Array = field(default_factory=lambda: np.zeros(2))
    near: Array = field(default_factory=lambda: np.zeros(2))
    near_of_several: Array = field(default_factory=lambda: np.zeros(2))
    misses: list[Array] = field(default_factory=list)
    """Distance px of each arm joint of a true person, then the lengths px of torso and head."""
    images: list[ScoredImage] = field(default_factory=list)

    def add(self, people: Sequence[PosedSticks], truths: Sequence[Array]) -> None:
        """Count one image."""
        found, true = [joints_of_sticks(person.sticks) for person in people], [joints_of_sticks(one) for one in truths]
        score = np.array([person.score for person in people])
        self.images.append(rate_people(found, score, true, ARM_JOINT_NAMES, self.unmatched))
        for truth, person in zip(truths, match_people(people, truths), strict=True):
            self.people += 1
            self.misses.append(_measure_arms(None if person is None else person.sticks, truth))
            known = np.isfinite(truth).all(axis=(1, 2))
            self.known += known
            ends = np.isfinite(truth[_LOWER_ARMS]).all(axis=2)
            self.ends += ends.sum(axis=0)
            if person is None:
                continue
            self.found += 1
            strict, loose = check_parts(person.sticks, truth)
            self.strict += strict & known
            self.loose += loose & known
            self.near += self._count_near(person.sticks[None], truth, ends)
            self.near_of_several += self._count_near(person.solutions, truth, ends)

    def _count_near(self, several: Array, truth: Array, ends: Array) -> Array:
        """Count elbows and wrists (2,) within `pixels` in at least one of several poses (n, 6, 2, 2)."""
        apart = np.linalg.norm(several[:, _LOWER_ARMS] - truth[_LOWER_ARMS], axis=3)
        near = (np.nan_to_num(apart, nan=np.inf) <= self.pixels).any(axis=0)
        return np.asarray((near & ends).sum(axis=0))

    def summarise(self) -> dict[str, float]:
        """Return percentages by name, JSON-ready; parts that are never known are left out."""
        figures = {"people": float(self.people), "found": _percent(self.found, self.people)}
        for name, counts in (("strict", self.strict), ("loose", self.loose)):
            for group, parts in GROUPS.items():
                rows = [STICKS.index(part) for part in parts]
                if self.known[rows].sum():
                    figures[f"{name} {group}"] = _percent(counts[rows].sum(), self.known[rows].sum())
        for row, joint in enumerate(("elbows", "wrists")):
            if self.ends[row]:
                figures[f"{joint} within {self.pixels:g} px"] = _percent(self.near[row], self.ends[row])
                figures[f"{joint} of the best solution"] = _percent(self.near_of_several[row], self.ends[row])
        misses = np.reshape(self.misses, (-1, len(ARM_JOINT_NAMES) + 2))
        shared = measure_pck(misses[:, :-2], misses[:, -2], misses[:, -1]) | measure_precision(self.images)
        return figures | {name: round(value, 2) for name, value in shared.items()}


def _measure_arms(sticks: Array | None, truth: Array) -> Array:
    """Return the distances px of the joints of the arms, infinite if missed, and the true lengths of torso and head."""
    found, true = {} if sticks is None else joints_of_sticks(sticks), joints_of_sticks(truth)
    missed = {name: np.linalg.norm(found[name] - true[name]) if name in found else np.inf for name in true}
    lengths = np.linalg.norm(truth[[_TORSO, _HEAD], 1] - truth[[_TORSO, _HEAD], 0], axis=1)
    return np.array([*(missed.get(name, np.nan) for name in ARM_JOINT_NAMES), *lengths])


def _percent(count: float, total: float) -> float:
    return round(100.0 * float(count) / float(total), 2) if total else float("nan")
