# SPDX-License-Identifier: Apache-2.0
"""Errors of joints against a reference: 2D tracks against keypoints, 3D bodies against triangulated joints.

Distances are in the unit of the points (pixels or metres), and NaN if a joint is unknown on either side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import normalise_name
from flowing_puppet_ros.model.tree import mirrored_name

PCK_SHARE, PCKH_SHARE = 0.2, 0.5
"""Distances of correct joints, as shares of the lengths of torso and head."""
ARM_JOINTS = ("shoulder", "elbow", "wrist")
LEG_JOINTS = ("hip", "knee", "ankle")
LIMB_JOINTS = tuple(f"{side}_{joint}" for joint in ARM_JOINTS + LEG_JOINTS for side in ("right", "left"))


@dataclass(frozen=True, slots=True, eq=False)
class JointErrors:
    """Distances `distance` (T, J) of J named joints in T frames; NaN unless both sides are known."""

    names: tuple[str, ...]
    distance: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """The known distances (n,)."""
        return self.distance[np.isfinite(self.distance)]

    @property
    def mean(self) -> float:
        """Mean over all known joints; NaN without any."""
        return float(self.known.mean()) if self.known.size else float("nan")

    def percentile(self, percent: float) -> float:
        """Return the distance that `percent` of the known joints do not exceed (50: the median); NaN without any."""
        return float(np.percentile(self.known, percent)) if self.known.size else float("nan")

    def fraction_within(self, threshold: float) -> float:
        """Return the share of the known joints within `threshold`; NaN without any."""
        return float(np.mean(self.known <= threshold)) if self.known.size else float("nan")

    def per_joint(self) -> dict[str, JointErrors]:
        """Return the errors of each joint by itself."""
        return {name: JointErrors((name,), self.distance[:, [j]]) for j, name in enumerate(self.names)}

    def per_frame(self) -> np.ndarray:
        """Return the mean (T,) over the known joints of each frame; NaN in frames without any."""
        known = np.isfinite(self.distance)
        total = np.where(known, self.distance, 0).sum(axis=1)
        return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)

    def summarise(self, thresholds: Sequence[float] = ()) -> dict[str, float]:
        """Return counts, mean, median, 90th percentile, maximum and the shares within `thresholds`, JSON-ready."""
        figures = {"joints": float(self.known.size), "frames": float(np.isfinite(self.distance).any(axis=1).sum())}
        figures |= {"mean": self.mean, "median": self.percentile(50), "p90": self.percentile(90)}
        figures["max"] = self.percentile(100)
        return figures | {f"within {value:g}": self.fraction_within(value) for value in thresholds}


def name_points(names: Sequence[str], points: np.ndarray) -> dict[str, np.ndarray]:
    """Return the known ones of `points` (K, D) by our joint names; `names` (K) are in any detector's spelling.

    InputError if the numbers of names and points differ.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or len(names) != len(points):
        raise InputError(f"{len(names)} joint names need as many points, these have shape {points.shape}")
    pairs = ((normalise_name(name), point) for name, point in zip(names, points, strict=True))
    return {name: point for name, point in pairs if name is not None and _finite(point)}


def measure_joint_errors(
    frames: Mapping[int, Mapping[str, np.ndarray]],
    reference: Mapping[int, Mapping[str, np.ndarray]],
    names: Sequence[str] = LIMB_JOINTS,
) -> JointErrors:
    """Compare joints {stamp: {name: (D,) point}} with a reference of the same form at the stamps of `frames`.

    A stamp missing in the reference gives a row of NaN, so that rows correspond to `frames`.
    """
    rows = np.full((len(frames), len(names)), np.nan)
    for row, (stamp, joints) in enumerate(frames.items()):
        other = reference.get(stamp, {})
        for column, name in enumerate(names):
            if name in joints and name in other:
                rows[row, column] = np.linalg.norm(np.asarray(joints[name], float) - np.asarray(other[name], float))
    return JointErrors(tuple(names), rows)


def is_swapped(
    joints: Mapping[str, np.ndarray], reference: Mapping[str, np.ndarray], limb: Sequence[str]
) -> bool | None:
    """Return whether a pair of limbs is nearer to the reference with left and right swapped.

    `limb` is ARM_JOINTS, LEG_JOINTS, or both for the whole body. None if no joint of the limb is known on both sides.
    """
    own = other = 0.0
    count = 0
    for joint in limb:
        sides = (f"left_{joint}", f"right_{joint}")
        if not all(_finite(points.get(side)) for points in (joints, reference) for side in sides):
            continue
        count += 1
        for side in sides:
            own += float(np.linalg.norm(joints[side] - reference[side]))
            other += float(np.linalg.norm(joints[side] - reference[mirrored_name(side)]))
    return other < own if count else None


def count_swapped(
    frames: Mapping[int, Mapping[str, np.ndarray]],
    reference: Mapping[int, Mapping[str, np.ndarray]],
    limb: Sequence[str],
) -> tuple[int, int]:
    """Count (swapped, comparable) frames of one pair of limbs, see `is_swapped`."""
    answers = [is_swapped(joints, reference[stamp], limb) for stamp, joints in frames.items() if stamp in reference]
    comparable = [answer for answer in answers if answer is not None]
    return sum(comparable), len(comparable)


def jitter(frames: Mapping[int, Mapping[str, np.ndarray]], step: int | None = None) -> np.ndarray:
    """Return lengths (n,) of the second differences of joints {stamp: {name: point}} over three successive frames.

    With `step`, only frames that far apart are successive.
    """
    stamps = sorted(frames)
    lengths = []
    for before, now, after in zip(stamps, stamps[1:], stamps[2:], strict=False):
        if step is None or now - before == after - now == step:
            for name in frames[now].keys() & frames[before].keys() & frames[after].keys():
                bend = frames[before][name] - 2 * frames[now][name] + frames[after][name]
                lengths.append(float(np.linalg.norm(bend)))
    return np.sort(np.array(lengths))


def count_id_switches(ids: Sequence[Sequence[str]]) -> int:
    """Count how often a person's id changes; `ids` are those of the people in each frame, in order.

    A switch is an id that disappears while a new one appears, relative to the last frame with people.
    """
    switches = 0
    last: set[str] = set()
    for names in ids:
        now = set(names)
        switches += min(len(last - now), len(now - last))
        last = now or last
    return switches


def measure_pck(distance: np.ndarray, torso: np.ndarray, head: np.ndarray) -> dict[str, float]:
    """Return PCK@0.2 and PCKh@0.5 in percent, each if the truth has the length that it needs.

    Args:
        distance: (P, J) px of P true people's joints; NaN if the truth is unknown, infinite if missed.
        torso: (P,) px, true lengths; NaN if unknown.
        head: (P,) px, likewise.
    """
    figures = {}
    for name, share, length in (("PCK@0.2, %", PCK_SHARE, torso), ("PCKh@0.5, %", PCKH_SHARE, head)):
        known = ~np.isnan(distance) & (length > 0)[:, None]
        if known.any():
            figures[name] = 100 * float((distance <= share * length[:, None])[known].mean())
    return figures


def _finite(point: np.ndarray | None) -> bool:
    return point is not None and bool(np.isfinite(point).all())
