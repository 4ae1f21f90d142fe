# SPDX-License-Identifier: Apache-2.0
"""A person whom the detector found: joints, sticks, other poses that are nearly as good, and scores of any place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, F64, I64
from flowing_puppet_ros.image.detector.part_filters import CELLS_PER_SCALE, PARTS, FeatureWindow, PartFilters
from flowing_puppet_ros.image.detector.pictorial_structure import MaxMarginals, best_placement, pass_down
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints

JOINTS = tuple(name for name in PARTS if not name.endswith("arm"))
ARM = ("shoulder", "upper_arm", "elbow", "forearm", "wrist")
APART = 3.0  # cells between the wrists of two modes of an arm
CERTAIN_MARGIN = 2.0  # a joint is certain when any other place (beyond NEAR cells) costs more
NEAR = 3.0
LEAST_ODDS = 1e-6
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """The best placement (P, 3) in a window, the upward beliefs, and the MEASURES of how sure it is."""

    window: FeatureWindow
    beliefs: MaxMarginals
    placement: I64
    features: F64

    @property
    def scale(self) -> float:
        """S of the window, px of the image that was looked at."""
        return CELLS_PER_SCALE * self.window.cell

    @property
    def score(self) -> float:
        """Score of the pose in its window, in units of the margin."""
        layer, x, y = self.placement[0]
        return float(self.beliefs.up[layer, y, x])

    def mirror(self, width: int) -> PoseHypothesis:
        """The pose in an image of `width` px in whose mirror image it was found; its parts' sides stay swapped."""
        return replace(self, window=replace(self.window, mirror=width))

    @property
    def points(self) -> F64:
        """The parts (P, 2) px of the image that was looked at."""
        return self.window.points_of(self.placement[:, 1:].astype(np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class PersonCandidate:
    """Where a person may stand: `neck` and `face` (2,) px of the given image, scale S in px, log-odds that one does.

    `score` is the pose's that was found there. Of a place that is only supposed, `least` is the score that a pose must
    have there for anybody to be seen.
    """

    neck: F64
    face: F64
    scale: float
    log_odds: float
    score: float = 0.0
    min_score: float = -np.inf

    @property
    def probability(self) -> float:
        """Probability that somebody stands there."""
        return 1 / (1 + float(np.exp(-self.log_odds)))

    def neck_distance(self, other: PersonCandidate) -> float:
        """Distance of the necks in units of the larger S."""
        return float(np.hypot(*(self.neck - other.neck))) / max(self.scale, other.scale)

    def with_scale(self, scale: float) -> PersonCandidate:
        """The same neck at another scale."""
        return replace(self, face=self.neck + (self.face - self.neck) * (scale / self.scale), scale=scale)

    def interpolate(self, other: PersonCandidate, share: float) -> PersonCandidate:
        """A place between two: 0 this one, 1 the other."""
        neck, face = ((1 - share) * a + share * b for a, b in ((self.neck, other.neck), (self.face, other.face)))
        return replace(self, neck=neck, face=face, scale=self.scale ** (1 - share) * other.scale**share)


@dataclass(frozen=True, eq=False)
class PersonDetection:
    """One person; all positions in px of the image that was given to the detector, left and right the person's.

    `confidence` is the calibrated probability that somebody was found in the right place and size.
    """

    filters: PartFilters
    pose: PoseHypothesis
    confidence: float
    factor: float
    """Size of the image that was looked at, in units of the given one."""

    @property
    def scale(self) -> float:
        """S: the shoulder width in px, of somebody seen from the side what it would be from the front."""
        return self.pose.scale / self.factor

    @property
    def score(self) -> float:
        """Score of the pose in its place, in units of the margin."""
        return self.pose.score

    @property
    def neck(self) -> F64:
        """Where the neck is, (2,)."""
        neck: F64 = self._points(self.pose.placement[:1, 1:].astype(np.float64))[0]
        return neck

    def _part(self, name: str) -> int:
        """The part of that name; in a mirror image left and right are swapped."""
        side, _, rest = name.partition("_")
        if self.pose.window.mirror is not None and side in OTHER_SIDE:
            name = f"{OTHER_SIDE[side]}_{rest}"
        return PARTS.index(name)

    @property
    def place(self) -> PersonCandidate:
        """Where the person stands, and how surely."""
        neck, face = self._points(self.pose.placement[[0, PARTS.index("face")], 1:].astype(np.float64))
        odds = np.clip(self.confidence, LEAST_ODDS, 1 - LEAST_ODDS)
        return PersonCandidate(neck, face, self.scale, float(np.log(odds / (1 - odds))))

    @cached_property
    def keypoints(self) -> Keypoints:
        """The best pose: neck, face, belly, hips, shoulders, elbows, wrists; they may lie outside of the image.

        A joint's confidence is the person's, less where another place would do nearly as well.
        """
        return self._keypoints(self._refined(self.pose.placement))

    @property
    def sticks(self) -> F64:
        """Sticks (6, 2, 2) in the order of `sticks.STICKS`."""
        return sticks_from_joints(self.keypoints.names, self.keypoints.xy)

    def joint_score(self, joint: str, xy: F64) -> F64:
        """Score (K,) of the best pose that has a joint at each of the places xy (K, 2), less that of the best pose.

        In units of the margin: one part clearly misplaced costs about 1. Outside of the window the border's score.
        """
        score = self._maps[self._part(joint)]
        cells = self.pose.window.cells_of((np.asarray(xy, np.float64) + 0.5) * self.factor - 0.5)
        limited = np.clip(np.nan_to_num(cells), 0, np.array(score.shape[::-1]) - 1).astype(np.float32)
        at = np.ascontiguousarray(limited.reshape(-1, 1, 2))
        looked_up = cv2.remap(score, at, None, cv2.INTER_LINEAR) if len(at) else at[..., 0]
        return np.asarray(looked_up, np.float64).reshape(-1)

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """Up to `count` poses that differ in the arms, best first, with their scores less that of the best pose.

        An arm's alternatives are the peaks of its wrist's max-marginals, each with the best arm for it; the arms are
        combined as if they did not depend on each other.
        """
        arms = [self._arm_modes(side, count) for side in ("right", "left")]
        pairs = sorted(
            ((a + b, i, j) for i, (a, _) in enumerate(arms[0]) for j, (b, _) in enumerate(arms[1])), reverse=True
        )
        found = []
        for score, i, j in pairs[:count]:
            placement = self.pose.placement.copy()
            for side, mode in (("right", arms[0][i][1]), ("left", arms[1][j][1])):
                rows = [self._part(f"{side}_{part}") for part in ARM]
                placement[rows] = mode[rows]
            found.append((self._keypoints(self._refined(placement)), score))
        return found

    def arms(self, side: str, count: int) -> F64:
        """Elbow and wrist (K, 2, 2) px of up to `count` poses of the arm of a side, best first."""
        rows = [self._part(f"{side}_{joint}") for joint in ("elbow", "wrist")]
        placements = np.array([placement for _, placement in self._arm_modes(side, count)])
        return self._points(self._refined(placements)[:, rows])

    @cached_property
    def _both_ways(self) -> MaxMarginals:
        """Beliefs with the downward pass."""
        return pass_down(self.filters.tree, self.pose.beliefs)

    @cached_property
    def _maps(self) -> F32:
        """Max-marginals (P, H, W) of all types, less the best pose's score."""
        beliefs, first = self._both_ways, self.filters.tree.first
        assert beliefs.down is not None
        total = beliefs.up + beliefs.down
        maps = np.stack([total[first[part] : first[part + 1]].max(axis=0) for part in range(len(PARTS))])
        return np.ascontiguousarray(maps - maps[0].max())

    def _arm_modes(self, side: str, count: int) -> list[tuple[float, I64]]:
        """Peaks of one wrist's map with the best placement (P, 3) for each; the first is that of the best pose."""
        tree, beliefs = self.filters.tree, self._both_ways
        assert beliefs.down is not None
        wrist = self._part(f"{side}_wrist")
        left = self._maps[wrist].copy()
        y, x = np.indices(left.shape)
        modes = [(0.0, self.pose.placement)]
        column, row = self.pose.placement[wrist, 1:]
        while len(modes) < count:
            left[np.hypot(x - column, y - row) < APART] = -np.inf
            row, column = np.unravel_index(int(left.argmax()), left.shape)
            score = float(left[row, column])
            if not np.isfinite(score):
                break
            layers = slice(tree.first[wrist], tree.first[wrist + 1])
            total = beliefs.up[layers, row, column] + beliefs.down[layers, row, column]
            layer = tree.first[wrist] + int(total.argmax())
            modes.append((score, best_placement(tree, beliefs, (wrist, layer, int(column), int(row)))))
        return modes

    def _refined(self, placement: I64) -> F64:
        """Grid coordinates (..., P, 2) of placements (..., P, 3), moved to the tops of parabolas through the scores."""
        up, down = self._both_ways.up, self._both_ways.down
        assert down is not None
        height, width = up.shape[1:]
        layer, x, y = np.moveaxis(placement, -1, 0)
        inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
        x_in, y_in = np.clip(x, 1, width - 2), np.clip(y, 1, height - 2)

        def near(right: int, below: int) -> F64:
            at = layer, y_in + below, x_in + right
            return np.asarray(up[at] + down[at], np.float64)

        middle = near(0, 0)
        peak = np.stack([_peak(near(-1, 0), middle, near(1, 0)), _peak(near(0, -1), middle, near(0, 1))], axis=-1)
        return np.asarray(placement[..., 1:] + np.where(inside[..., None], peak, 0.0), np.float64)

    def _points(self, cells: F64) -> F64:
        """Grid coordinates (..., 2) in px of the given image."""
        return (self.pose.window.points_of(cells) + 0.5) / self.factor - 0.5

    def _keypoints(self, cells: F64) -> Keypoints:
        points = self._points(cells)
        chosen = [self._part(name) for name in JOINTS]
        confidence = [self.confidence * self._certainty(part, cells[part]) for part in chosen]
        return Keypoints(JOINTS, points[chosen], np.array(confidence))

    def _certainty(self, part: int, at: F64) -> float:
        """How much worse (0 to 1) the best pose with this part elsewhere is; a half where it is better."""
        score = self._maps[part]
        y, x = np.indices(score.shape)
        far = np.hypot(x - at[0], y - at[1]) > NEAR
        margin = -float(score[far].max())
        return float(np.clip(0.5 + 0.5 * margin / CERTAIN_MARGIN, 0.5, 1.0))


def _peak(low: F64, middle: F64, high: F64) -> F64:
    """Tops of the parabolas through three values, from the middle ones, at most half a step away."""
    bend = low - 2 * middle + high
    bent = bend < 0
    return np.where(bent, np.clip(0.5 * (low - high) / np.where(bent, bend, -1.0), -0.5, 0.5), 0.0)
