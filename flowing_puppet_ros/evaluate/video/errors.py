# SPDX-License-Identifier: Apache-2.0
"""Figures of tracks against the truth: joints within distances, shake, and whether confidences mean what they say.

A true joint counts where it lies inside its image. A true person is compared with the puppet of the frame that is
nearest to them; where there is none, all their joints are missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.bag.recording import Joints, nearest
from flowing_puppet_ros.evaluate.joints import named_points
from flowing_puppet_ros.evaluate.video.truth import People

MEASURED = ("elbow", "wrist")
THRESHOLDS = (10.0, 20.0)
CALIBRATED = 20.0
"""Distance in px within which a joint is right when confidences are judged."""
CONFIDENCE_BINS = 10
RESAMPLINGS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPerson:
    """What a track says of one person in one frame: known `joints` by name, and the `confidence` of each."""

    joints: Joints
    confidence: Mapping[str, float]

    @classmethod
    def of(cls, names: Sequence[str], joints: Array, confidence: Array) -> TrackedPerson:
        """Take joints (J,2), NaN where unknown, and their confidence (J,)."""
        return cls(named_points(names, joints), dict(zip(names, confidence.tolist(), strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class ClipErrors:
    """Errors of one clip, by kind of joint.

    `distance[kind]` (n,) px, infinite where missed; `shake[kind]` (m,) px, the second difference in time of what is
    off; `told[kind]` (n,) confidence of each joint, NaN where missed.
    """

    distance: Mapping[str, Array]
    shake: Mapping[str, Array]
    told: Mapping[str, Array]


def clip_errors(
    track: Mapping[int, Sequence[TrackedPerson]], truth: People, size: tuple[int, int], kinds: Sequence[str] = MEASURED
) -> ClipErrors:
    """Compare a track by frame with the true people of a clip whose images are of `size` (width, height)."""
    distance: dict[str, list[float]] = {kind: [] for kind in kinds}
    told: dict[str, list[float]] = {kind: [] for kind in kinds}
    off: dict[tuple[str, int], dict[int, Array]] = {}
    for index, people in sorted(truth.items()):
        found = track.get(index, [])
        for number, person in enumerate(people):
            known = {name: np.array(point[:2]) for name, point in person.usable().items()}
            chosen = nearest(known, [one.joints for one in found])
            for kind in kinds:
                for name in (f"right_{kind}", f"left_{kind}"):
                    if name not in known or not _inside(known[name], size):
                        continue
                    mine = None if chosen is None else found[chosen].joints.get(name)
                    miss = np.full(2, np.inf) if mine is None else mine - known[name]
                    distance[kind].append(float(np.hypot(*miss)))
                    told[kind].append(np.nan if mine is None or chosen is None else found[chosen].confidence[name])
                    if mine is not None:
                        off.setdefault((name, number), {})[index] = miss
    return ClipErrors(
        {kind: np.array(values) for kind, values in distance.items()},
        {kind: _shake(off, kind) for kind in kinds},
        {kind: np.array(values) for kind, values in told.items()},
    )


def _inside(point: Array, size: tuple[int, int]) -> bool:
    return bool((point >= -0.5).all() and (point <= np.array(size) - 0.5).all())


def _shake(off: Mapping[tuple[str, int], Mapping[int, Array]], kind: str) -> Array:
    """Length (m,) of the second difference in time of the misses of one kind of joint."""
    values = [
        float(np.hypot(*(misses[k - 1] - 2 * misses[k] + misses[k + 1])))
        for (name, _), misses in off.items()
        if name.endswith(kind)
        for k in misses
        if k - 1 in misses and k + 1 in misses
    ]
    return np.array(values)


def summary(clips: Mapping[str, ClipErrors]) -> dict[str, float]:
    """Percent of joints within the THRESHOLDS, median distances and median shake in px, over all clips together."""
    figures: dict[str, float] = {}
    for kind in MEASURED:
        distance = np.concatenate([clip.distance[kind] for clip in clips.values()])
        shake = np.concatenate([clip.shake[kind] for clip in clips.values()])
        for threshold in THRESHOLDS:
            figures[f"{kind}s_{threshold:g}_px"] = _percent(distance <= threshold)
        figures[f"{kind}s_median_px"] = round(float(np.median(distance)), 2) if len(distance) else np.nan
        figures[f"{kind}s_shake_px"] = round(float(np.median(shake)), 2) if len(shake) else np.nan
    return figures


def gain(
    clips: Mapping[str, ClipErrors], base: Mapping[str, ClipErrors], kind: str, threshold: float, seed: int = 0
) -> tuple[float, float, float]:
    """Points by which more joints are within a threshold than in `base`, and its 95 % interval over clips."""
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


def calibration(clips: Mapping[str, ClipErrors]) -> list[dict[str, float]]:
    """How often joints of a confidence are right: mean confidence, share and count by tenth."""
    told = np.concatenate([clip.told[kind] for clip in clips.values() for kind in MEASURED])
    right = np.concatenate([clip.distance[kind] for clip in clips.values() for kind in MEASURED]) <= CALIBRATED
    known = np.isfinite(told)
    told, right = told[known], right[known]
    bins = np.minimum((told * CONFIDENCE_BINS).astype(int), CONFIDENCE_BINS - 1)
    return [
        {
            "confidence": round(float(told[bins == k].mean()), 3),
            "right": round(float(right[bins == k].mean()), 3),
            "joints": float(np.count_nonzero(bins == k)),
        }
        for k in range(CONFIDENCE_BINS)
        if (bins == k).any()
    ]


def calibration_error(rows: Sequence[Mapping[str, float]]) -> float:
    """Mean distance between confidence and share of right joints, over the joints; NaN without any."""
    count = sum(row["joints"] for row in rows)
    apart = sum(row["joints"] * abs(row["confidence"] - row["right"]) for row in rows)
    return round(apart / count, 3) if count else float("nan")


def _percent(hits: Array) -> float:
    return round(100 * float(hits.mean()), 1) if len(hits) else float("nan")
