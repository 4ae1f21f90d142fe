# SPDX-License-Identifier: Apache-2.0
"""Errors of tracks against the ground truth: joints within thresholds, jitter, and calibration of confidences.

A true joint counts if it lies inside the image. A true person is compared with the nearest puppet of the frame; without
one, all their joints are missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.bag.recording import Joints, find_nearest
from flowing_puppet_ros.evaluate.joints import name_points
from flowing_puppet_ros.evaluate.video.truth import PeopleByFrame

MEASURED_JOINTS = ("elbow", "wrist")
THRESHOLDS_PX = (10.0, 20.0)  # of correct joints
CALIBRATION_DISTANCE_PX = 20.0
"""Joints within this distance are correct when confidences are assessed."""
CONFIDENCE_BINS = 10
RESAMPLINGS = 1000  # of the clips, for the bootstrap interval


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPerson:
    """One person of a track in one frame: known `joints` by name, and the `confidence` of each."""

    joints: Joints
    confidence: Mapping[str, float]

    @classmethod
    def of(cls, names: Sequence[str], joints: Array, confidence: Array) -> TrackedPerson:
        """Make a person from joints (J, 2) px, NaN where unknown, and their confidence (J,)."""
        return cls(name_points(names, joints), dict(zip(names, confidence.tolist(), strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class ClipErrors:
    """Errors of one clip, by kind of joint.

    Attributes:
        distance: {kind: (n,)} px, infinite for missed joints.
        jitter: {kind: (m,)} px, second difference in time of the error vectors.
        confidence: {kind: (n,)} of each joint, NaN for missed joints.
    """

    distance: Mapping[str, Array]
    jitter: Mapping[str, Array]
    confidence: Mapping[str, Array]


def measure_clip(
    track: Mapping[int, Sequence[TrackedPerson]],
    truth: PeopleByFrame,
    size: tuple[int, int],
    kinds: Sequence[str] = MEASURED_JOINTS,
) -> ClipErrors:
    """Compare a track by frame with the true people of a clip whose images are of `size` (width, height)."""
    distance: dict[str, list[float]] = {kind: [] for kind in kinds}
    confidence: dict[str, list[float]] = {kind: [] for kind in kinds}
    off: dict[tuple[str, int], dict[int, Array]] = {}
    for index, people in sorted(truth.items()):
        found = track.get(index, [])
        for number, person in enumerate(people):
            known = {name: np.array(point[:2]) for name, point in person.select_usable().items()}
            chosen = find_nearest(known, [one.joints for one in found])
            for kind in kinds:
                for name in (f"right_{kind}", f"left_{kind}"):
                    if name not in known or not is_inside(known[name], size):
                        continue
                    mine = None if chosen is None else found[chosen].joints.get(name)
                    miss = np.full(2, np.inf) if mine is None else mine - known[name]
                    distance[kind].append(float(np.hypot(*miss)))
                    confidence[kind].append(
                        np.nan if mine is None or chosen is None else found[chosen].confidence[name]
                    )
                    if mine is not None:
                        off.setdefault((name, number), {})[index] = miss
    return ClipErrors(
        {kind: np.array(values) for kind, values in distance.items()},
        {kind: _measure_jitter(off, kind) for kind in kinds},
        {kind: np.array(values) for kind, values in confidence.items()},
    )


def is_inside(point: Array, size: tuple[int, int]) -> bool:
    """Return whether a point (2,) px is in an image of `size` (width, height)."""
    return bool((point >= -0.5).all() and (point <= np.array(size) - 0.5).all())


def _measure_jitter(off: Mapping[tuple[str, int], Mapping[int, Array]], kind: str) -> Array:
    """Return the lengths (m,) px of the second difference in time of the errors of one kind of joint."""
    values = [
        float(np.hypot(*(misses[k - 1] - 2 * misses[k] + misses[k + 1])))
        for (name, _), misses in off.items()
        if name.endswith(kind)
        for k in misses
        if k - 1 in misses and k + 1 in misses
    ]
    return np.array(values)


def summarise(clips: Mapping[str, ClipErrors]) -> dict[str, float]:
    """Return the percentage of joints within THRESHOLDS_PX, and median distance and jitter in px, over all clips."""
    figures: dict[str, float] = {}
    for kind in MEASURED_JOINTS:
        distance = np.concatenate([clip.distance[kind] for clip in clips.values()])
        shake = np.concatenate([clip.jitter[kind] for clip in clips.values()])
        for threshold in THRESHOLDS_PX:
            figures[f"{kind}s_{threshold:g}_px"] = _percent(distance <= threshold)
        figures[f"{kind}s_median_px"] = round(float(np.median(distance)), 2) if len(distance) else np.nan
        figures[f"{kind}s_shake_px"] = round(float(np.median(shake)), 2) if len(shake) else np.nan
    return figures


def measure_gain(
    clips: Mapping[str, ClipErrors], base: Mapping[str, ClipErrors], kind: str, threshold: float, seed: int = 0
) -> tuple[float, float, float]:
    """Return the gain over `base` in percentage points within a threshold, and its 95 % interval over clips."""
    names = [name for name in clips if name in base and len(clips[name].distance[kind])]
    if not names:
        return (np.nan, np.nan, np.nan)
    counts = np.array([len(clips[name].distance[kind]) for name in names])
    more = np.array([np.sum(clips[n].distance[kind] <= threshold) - np.sum(base[n].distance[kind] <= threshold)
                     for n in names])  # fmt: skip
    drawn = np.random.default_rng(seed).integers(0, len(names), (RESAMPLINGS, len(names)))
    spread = 100 * more[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(spread, [2.5, 97.5])
    return round(100 * float(more.sum() / counts.sum()), 1), round(float(low), 1), round(float(high), 1)


def measure_calibration(clips: Mapping[str, ClipErrors]) -> list[dict[str, float]]:
    """Return mean confidence, share of correct joints and count by tenth of the confidence."""
    confidence = np.concatenate([clip.confidence[kind] for clip in clips.values() for kind in MEASURED_JOINTS])
    right = (
        np.concatenate([clip.distance[kind] for clip in clips.values() for kind in MEASURED_JOINTS])
        <= CALIBRATION_DISTANCE_PX
    )
    known = np.isfinite(confidence)
    confidence, right = confidence[known], right[known]
    bins = np.minimum((confidence * CONFIDENCE_BINS).astype(int), CONFIDENCE_BINS - 1)
    return [
        {
            "confidence": round(float(confidence[bins == k].mean()), 3),
            "right": round(float(right[bins == k].mean()), 3),
            "joints": float(np.count_nonzero(bins == k)),
        }
        for k in range(CONFIDENCE_BINS)
        if (bins == k).any()
    ]


def calibration_error(rows: Sequence[Mapping[str, float]]) -> float:
    """Return the mean distance between confidence and share of correct joints, over the joints; NaN without any."""
    count = sum(row["joints"] for row in rows)
    apart = sum(row["joints"] * abs(row["confidence"] - row["right"]) for row in rows)
    return round(apart / count, 3) if count else float("nan")


def _percent(hits: Array) -> float:
    return round(100 * float(hits.mean()), 1) if len(hits) else float("nan")
