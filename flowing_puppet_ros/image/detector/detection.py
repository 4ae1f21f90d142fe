# SPDX-License-Identifier: Apache-2.0
"""A detected person: joints, sticks, alternative poses and the score of any place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, F64, I64
from flowing_puppet_ros.image.detector.part_filters import CELLS_PER_SCALE, PARTS, FeatureWindow, PartFilters
from flowing_puppet_ros.image.detector.pictorial_structure import MaxMarginals, find_best_placement, pass_down
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints

JOINTS = tuple(name for name in PARTS if not name.endswith("arm"))
ARM = ("shoulder", "upper_arm", "elbow", "forearm", "wrist")
MIN_MODE_DISTANCE_CELLS = 3.0  # between the wrists of two modes of an arm
CERTAIN_MARGIN = 2.0  # score that any other place must cost for a joint to be certain
NEIGHBOUR_RADIUS_CELLS = 3.0  # within it a place counts as the same one
MIN_PROBABILITY = 1e-6  # of a person and of no person, so that log-odds stay finite
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """The best placement (P, 3) in a window, the upward beliefs, and `features` (scoring.FEATURES,) for its score."""

    window: FeatureWindow
    beliefs: MaxMarginals
    placement: I64
    features: F64

    @property
    def scale(self) -> float:
        """S of the window, px of the searched image."""
        return CELLS_PER_SCALE * self.window.cell

    @property
    def score(self) -> float:
        """Score of the pose in its window, in units of the margin."""
        layer, x, y = self.placement[0]
        return float(self.beliefs.up[layer, y, x])

    def mirror(self, width: int) -> PoseHypothesis:
        """Return the pose in the image, `width` px wide, in whose mirror image it was found; sides stay swapped."""
        return replace(self, window=replace(self.window, mirror=width))

    @property
    def points(self) -> F64:
        """Parts (P, 2) px of the searched image."""
        return self.window.to_points(self.placement[:, 1:].astype(np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class PersonCandidate:
    """A person that may be there: `neck` and `face` (2,) px of the given image, scale S in px, and log-odds.

    `score` is that of the pose found there. For an extrapolated candidate, `min_score` is the score that a pose must
    reach there to count as detected.
    """

    neck: F64
    face: F64
    scale: float
    log_odds: float
    score: float = 0.0
    min_score: float = -np.inf

    @property
    def probability(self) -> float:
        """Probability that it is a person."""
        return 1 / (1 + float(np.exp(-self.log_odds)))

    def neck_distance(self, other: PersonCandidate) -> float:
        """Return the distance of the necks in units of the larger S."""
        return float(np.hypot(*(self.neck - other.neck))) / max(self.scale, other.scale)

    def with_scale(self, scale: float) -> PersonCandidate:
        """Return the candidate with the same neck at another scale."""
        return replace(self, face=self.neck + (self.face - self.neck) * (scale / self.scale), scale=scale)

    def interpolate(self, other: PersonCandidate, share: float) -> PersonCandidate:
        """Return a candidate between two: this one at share 0, the other at share 1."""
        neck, face = ((1 - share) * a + share * b for a, b in ((self.neck, other.neck), (self.face, other.face)))
        return replace(self, neck=neck, face=face, scale=self.scale ** (1 - share) * other.scale**share)


@dataclass(frozen=True, eq=False)
class PersonDetection:
    """One person; all positions in px of the image given to the detector, left and right are the person's.

    `confidence` is the calibrated probability that this is a person with the right place and size.
    """

    filters: PartFilters
    pose: PoseHypothesis
    confidence: float
    factor: float
    """Size of the searched image in units of the given one."""

    @property
    def scale(self) -> float:
        """S: the shoulder width in px, for a person seen from the side what it would be from the front."""
        return self.pose.scale / self.factor

    @property
    def score(self) -> float:
        """Score of the pose, in units of the margin."""
        return self.pose.score

    @property
    def neck(self) -> F64:
        """Neck (2,) px."""
        neck: F64 = self._to_image(self.pose.placement[:1, 1:].astype(np.float64))[0]
        return neck

    def _part_index(self, name: str) -> int:
        """Return the index of a part; in a mirror image left and right are swapped."""
        side, _, rest = name.partition("_")
        if self.pose.window.mirror is not None and side in OTHER_SIDE:
            name = f"{OTHER_SIDE[side]}_{rest}"
        return PARTS.index(name)

    @property
    def candidate(self) -> PersonCandidate:
        """The person as a candidate, with the log-odds of its confidence."""
        neck, face = self._to_image(self.pose.placement[[0, PARTS.index("face")], 1:].astype(np.float64))
        odds = np.clip(self.confidence, MIN_PROBABILITY, 1 - MIN_PROBABILITY)
        return PersonCandidate(neck, face, self.scale, float(np.log(odds / (1 - odds))))

    @cached_property
    def keypoints(self) -> Keypoints:
        """The best pose: neck, face, belly, hips, shoulders, elbows, wrists; they may lie outside the image.

        A joint's confidence is the person's, reduced where another place scores nearly as well.
        """
        return self._make_keypoints(self._refine(self.pose.placement))

    @property
    def sticks(self) -> F64:
        """Sticks (6, 2, 2) px in the order of `stickmen.STICKS`."""
        return sticks_from_joints(self.keypoints.names, self.keypoints.xy)

    @property
    def joints_are_independent(self) -> bool:
        """The score of a joint is that of the best pose with the joint there: a wrong pose costs at all its joints."""
        return False

    def joint_score(self, joint: str, xy: F64) -> F64:
        """Return the score (K,) of the best pose with a joint at each of `xy` (K, 2) px, less that of the best pose.

        In units of the margin: one clearly misplaced part costs about 1. Outside the window the border's score.
        """
        score = self._score_maps[self._part_index(joint)]
        cells = self.pose.window.to_cells((np.asarray(xy, np.float64) + 0.5) * self.factor - 0.5)
        clipped = np.clip(np.nan_to_num(cells), 0, np.array(score.shape[::-1]) - 1).astype(np.float32)
        pixels = np.ascontiguousarray(clipped.reshape(-1, 1, 2))
        sampled = cv2.remap(score, pixels, None, cv2.INTER_LINEAR) if len(pixels) else pixels[..., 0]
        return np.asarray(sampled, np.float64).reshape(-1)

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        """Return up to `count` poses that differ in the arms, best first, with their scores less that of the best pose.

        An arm's alternatives are the peaks of its wrist's max-marginals, each with the best arm for it. The arms are
        combined as if they were independent.
        """
        arms = [self._find_arm_modes(side, count) for side in ("right", "left")]
        pairs = sorted(
            ((a + b, i, j) for i, (a, _) in enumerate(arms[0]) for j, (b, _) in enumerate(arms[1])), reverse=True
        )
        modes = []
        for score, i, j in pairs[:count]:
            placement = self.pose.placement.copy()
            for side, mode in (("right", arms[0][i][1]), ("left", arms[1][j][1])):
                rows = [self._part_index(f"{side}_{part}") for part in ARM]
                placement[rows] = mode[rows]
            modes.append((self._make_keypoints(self._refine(placement)), score))
        return modes

    def arm_hypotheses(self, side: str, count: int) -> F64:
        """Return elbow and wrist (K, 2, 2) px of up to `count` poses of one side's arm, best first."""
        rows = [self._part_index(f"{side}_{joint}") for joint in ("elbow", "wrist")]
        placements = np.array([placement for _, placement in self._find_arm_modes(side, count)])
        return self._to_image(self._refine(placements)[:, rows])

    @cached_property
    def _max_marginals(self) -> MaxMarginals:
        """Beliefs after the downward pass."""
        return pass_down(self.filters.tree, self.pose.beliefs)

    @cached_property
    def _score_maps(self) -> F32:
        """Max-marginals (P, H, W) of all types, less the best pose's score."""
        beliefs, first = self._max_marginals, self.filters.tree.first
        assert beliefs.down is not None
        total = beliefs.up + beliefs.down
        maps = np.stack([total[first[part] : first[part + 1]].max(axis=0) for part in range(len(PARTS))])
        return np.ascontiguousarray(maps - maps[0].max())

    def _find_arm_modes(self, side: str, count: int) -> list[tuple[float, I64]]:
        """Return the peaks of one wrist's map with the best placement (P, 3) for each, the best pose first."""
        tree, beliefs = self.filters.tree, self._max_marginals
        assert beliefs.down is not None
        wrist = self._part_index(f"{side}_wrist")
        remaining = self._score_maps[wrist].copy()
        y, x = np.indices(remaining.shape)
        modes = [(0.0, self.pose.placement)]
        column, row = self.pose.placement[wrist, 1:]
        while len(modes) < count:
            remaining[np.hypot(x - column, y - row) < MIN_MODE_DISTANCE_CELLS] = -np.inf
            row, column = np.unravel_index(int(remaining.argmax()), remaining.shape)
            score = float(remaining[row, column])
            if not np.isfinite(score):
                break
            layers = slice(tree.first[wrist], tree.first[wrist + 1])
            total = beliefs.up[layers, row, column] + beliefs.down[layers, row, column]
            layer = tree.first[wrist] + int(total.argmax())
            modes.append((score, find_best_placement(tree, beliefs, (wrist, layer, int(column), int(row)))))
        return modes

    def _refine(self, placement: I64) -> F64:
        """Return grid coordinates (..., P, 2) of placements (..., P, 3), moved to the peaks of parabolas."""
        up, down = self._max_marginals.up, self._max_marginals.down
        assert down is not None
        height, width = up.shape[1:]
        layer, x, y = np.moveaxis(placement, -1, 0)
        inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
        x_in, y_in = np.clip(x, 1, width - 2), np.clip(y, 1, height - 2)

        def near(right: int, below: int) -> F64:
            at = layer, y_in + below, x_in + right
            return np.asarray(up[at] + down[at], np.float64)

        middle = near(0, 0)
        peak = np.stack(
            [_parabola_peak(near(-1, 0), middle, near(1, 0)), _parabola_peak(near(0, -1), middle, near(0, 1))], axis=-1
        )
        return np.asarray(placement[..., 1:] + np.where(inside[..., None], peak, 0.0), np.float64)

    def _to_image(self, cells: F64) -> F64:
        """Convert grid coordinates (..., 2) to px of the given image."""
        return (self.pose.window.to_points(cells) + 0.5) / self.factor - 0.5

    def _make_keypoints(self, cells: F64) -> Keypoints:
        points = self._to_image(cells)
        chosen = [self._part_index(name) for name in JOINTS]
        confidence = [self.confidence * self._certainty(part, cells[part]) for part in chosen]
        return Keypoints(JOINTS, points[chosen], np.array(confidence))

    def _certainty(self, part: int, cell: F64) -> float:
        """Return how certain a part is (0.5 to 1), by how much worse the best pose with this part elsewhere is."""
        score = self._score_maps[part]
        y, x = np.indices(score.shape)
        outside = np.hypot(x - cell[0], y - cell[1]) > NEIGHBOUR_RADIUS_CELLS
        margin = -float(score[outside].max())
        return float(np.clip(0.5 + 0.5 * margin / CERTAIN_MARGIN, 0.5, 1.0))


def _parabola_peak(low: F64, middle: F64, high: F64) -> F64:
    """Return the offsets of the peaks of parabolas through three values from the middle ones, at most half a step."""
    curvature = low - 2 * middle + high
    has_peak = curvature < 0
    return np.where(has_peak, np.clip(0.5 * (low - high) / np.where(has_peak, curvature, -1.0), -0.5, 0.5), 0.0)
