# SPDX-License-Identifier: Apache-2.0
"""Data-driven proposals for the swarm: wrists drawn from the hand maps, arms that reach them (thesis, "Inference")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evidence.image.hands import HandMaps
from flowing_puppet_ros.image.thesis_loop.upper_body import PARTS, UpperBodyParameters
from flowing_puppet_ros.inference.swarm import Bounds

GRID_STEP_M = 0.04  # between the positions at which hands are searched for
MAX_WRIST_DISTANCE_M = 0.85  # from the neck
SIDES = ("right", "left")


@dataclass(frozen=True, slots=True, eq=False)
class WristProposals:
    """Positions `places` (K, 2) px where hands may be, and for each map their `cumulative` probabilities (K,)."""

    body: UpperBodyParameters
    bounds: Bounds
    legs: F64
    places: F64
    cumulative: tuple[F64, ...]

    @classmethod
    def of(cls, body: UpperBodyParameters, bounds: Bounds, legs: F64, maps: HandMaps, neck: F64, scale: float) -> Self:
        """Search for hands around a person with the `neck` at (2,) px; a map's probability is that of its log odds."""
        axis = np.arange(-MAX_WRIST_DISTANCE_M, MAX_WRIST_DISTANCE_M + GRID_STEP_M, GRID_STEP_M) * scale
        offsets = np.stack(np.meshgrid(axis, axis), axis=2).reshape(-1, 2)
        places = neck + offsets[np.hypot(offsets[:, 0], offsets[:, 1]) <= MAX_WRIST_DISTANCE_M * scale]
        sums = []
        for kind in maps.fields:
            odds, _ = maps.best_orientation(kind, places)
            sums.append(np.cumsum(1 / (1 + np.exp(-np.clip(odds, -30, 30)))))
        return cls(body, bounds, legs, places, tuple(sums))

    def __call__(self, vectors: F64, rng: np.random.Generator) -> F64:
        """Move one wrist of each of `vectors` (P, D) to a position drawn from one of the maps, chosen at random."""
        moved = vectors.copy()
        which = rng.integers(0, len(self.cumulative), len(vectors))
        side, bend = rng.integers(0, 2, len(vectors)), rng.integers(0, 2, len(vectors))
        drawn = rng.random(len(vectors))
        joints, scale = self.body.to_joints(vectors, self.legs)
        for k, name in enumerate(SIDES):
            rows = np.flatnonzero(side == k)
            if len(rows) == 0:
                continue
            chosen = [
                np.searchsorted(self.cumulative[which[r]], drawn[r] * self.cumulative[which[r]][-1]) for r in rows
            ]
            wrist = self.places[np.minimum(chosen, len(self.places) - 1)]
            moved[rows] = self._reach_for(
                moved[rows], joints[rows], scale[rows], name, wrist, np.where(bend[rows] == 1, 1.0, -1.0)
            )
        return moved

    def _reach_for(self, vectors: F64, joints: F64, scale: F64, side: str, wrist: F64, bend: F64) -> F64:
        """Move an arm of `vectors` (P, D) to reach `wrist` (P, 2) px, its elbow on side `bend` (P,) if in bounds."""
        names = self.body.model.joint_names
        sign = np.array([1.0 if self.body.view == "front" else -1.0, 1.0])
        shoulder, target = joints[:, names.index(f"{side}_shoulder")] * sign, wrist * sign
        upper, lower = PARTS.index(f"{side}_upper_arm"), PARTS.index(f"{side}_lower_arm")
        first, second = (vectors[:, len(PARTS) + k] * scale for k in (upper, lower))
        line = target - shoulder
        far = np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-6)
        # Bones that are too short for the wrist grow in proportion, as far as their bounds allow.
        longest = self.bounds.high[len(PARTS) + upper] * scale, self.bounds.high[len(PARTS) + lower] * scale
        growth = np.maximum(1.0, far / (first + second))
        first, second = np.minimum(first * growth, longest[0]), np.minimum(second * growth, longest[1])
        cosine = np.clip((first**2 + far**2 - second**2) / (2 * first * far), -1.0, 1.0)
        middle, opening = np.arctan2(line[:, 1], line[:, 0]), np.arccos(cosine)
        relative = self._unwrap(middle + bend * opening - vectors[:, 0], upper)
        allowed = (relative >= self.bounds.low[upper]) & (relative <= self.bounds.high[upper])
        angle = middle + np.where(allowed, bend, -bend) * opening
        elbow = shoulder + first[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        rest = target - elbow
        length = np.hypot(rest[:, 0], rest[:, 1])
        vectors[:, len(PARTS) + upper], vectors[:, len(PARTS) + lower] = first / scale, length / scale
        vectors[:, upper] = self._unwrap(angle - vectors[:, 0], upper)
        vectors[:, lower] = self._unwrap(np.arctan2(rest[:, 1], rest[:, 0]) - angle, lower)
        return vectors

    def _unwrap(self, angle: F64, part: int) -> F64:
        """Return angles (P,) modulo a full turn, around the middle of the part's bounds."""
        middle = 0.5 * (self.bounds.low[part] + self.bounds.high[part])
        return np.asarray((angle - middle + np.pi) % (2 * np.pi) - np.pi + middle)
