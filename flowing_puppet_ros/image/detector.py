# SPDX-License-Identifier: Apache-2.0
"""The detector of people in one image: a tree of HOG part filters that stands in for FMP and PS of the thesis.

Rigid head-and-shoulders filters say where people may stand and how large they are; in each of the best places the
part filters, mixtures by the orientation of the limbs, find the pose exactly by dynamic programming; a logistic
regression on both scores says how probable it is that somebody was found. The joints follow the puppet's convention
(shoulders near the armpits), so that sticks or keypoints need no mapping to become a Deformable Structures puppet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector_forest import Forest
from flowing_puppet_ros.image.detector_parts import PARTS, PartFilters, window_at
from flowing_puppet_ros.image.detector_person import FoundPose, PersonDetection
from flowing_puppet_ros.image.detector_root import Candidate, RootFilters, resize
from flowing_puppet_ros.image.detector_search import choose, propose
from flowing_puppet_ros.image.detector_tree import PartTree, best_placement, upward
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.settings import Settings, setting

type Doubles = NDArray[np.float64]

WEIGHTS = "upper"
LEAST_SIDE = 8  # px; nothing is found in a smaller image
TELLING = [PARTS.index(name) for name in ("neck", "face", "right_shoulder", "left_shoulder")]
SAME_PLACE = 0.5  # units of S between necks of which only the better is kept


@dataclass(frozen=True, slots=True)
class DetectorSettings(Settings):
    """Whom to look for, and how hard."""

    smallest: float = setting(
        0.0, "smallest shoulder width to look for; 0 is a twentieth of the longer side", unit="px", low=0.0, high=1e5
    )
    largest_side: int = setting(720, "images are shrunk to this longer side", unit="px", low=64, high=4096)
    places: int = setting(12, "places where a pose is sought", low=1, high=80)
    most_people: int = setting(8, "people to report", low=1, high=80)
    least_confidence: float = setting(0.1, "probability below which nobody is reported", low=0.0, high=1.0)


DEFAULTS = DetectorSettings()


@dataclass(frozen=True, slots=True, eq=False)
class PartDetector:
    """Learned filters and trees and the calibration of their scores.

    `weight` (9,) and `bias` give the log-odds of a person from the measures of a pose.
    """

    root: RootFilters
    forest: Forest
    parts: PartFilters
    weight: Doubles
    bias: float

    @classmethod
    def load(cls, name: str = WEIGHTS) -> Self:
        """The shipped detector; InputError when there is none of that name."""
        return cls.from_arrays(weights.load("detector", name))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """A detector of the arrays that `to_arrays` gives."""
        single = {name: np.ascontiguousarray(value, np.float32) for name, value in arrays.items()}
        root = RootFilters(single["root_filters"], single["root_bias"], single["root_offsets"])
        forest = Forest(arrays["tree_features"], arrays["tree_thresholds"], single["tree_leaves"])
        parents, first = (np.asarray(arrays[name], np.int64) for name in ("parents", "first"))
        tree = PartTree(parents, first, single["anchor"], single["spring"], single["type_bias"])
        weight = np.asarray(arrays["weight"], np.float64)
        return cls(root, forest, PartFilters(single["part_filters"], tree), weight, float(arrays["bias"]))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays for an .npz file; filters in half precision."""
        tree = self.parts.tree
        return {
            "root_filters": self.root.filters.astype(np.float16),
            "root_bias": self.root.bias,
            "root_offsets": self.root.offsets,
            "tree_features": self.forest.feature,
            "tree_thresholds": self.forest.threshold,
            "tree_leaves": self.forest.leaves,
            "part_filters": self.parts.filters.astype(np.float16),
            "parents": tree.parents,
            "first": tree.first,
            "anchor": tree.anchor,
            "spring": tree.spring,
            "type_bias": tree.bias,
            "weight": self.weight,
            "bias": np.array(self.bias),
        }

    def detect(self, image: NDArray[np.uint8], settings: DetectorSettings = DEFAULTS) -> list[PersonDetection]:
        """The people in an image (H, W, 3) RGB or (H, W) grey, uint8, the surest first; InputError for other arrays."""
        pixels = checked(image)
        longest = max(pixels.shape[:2])
        if min(pixels.shape[:2]) < LEAST_SIDE:
            return []
        factor = min(1.0, settings.largest_side / longest)
        small = resize(pixels, factor) if factor < 1 else pixels
        if min(small.shape[:2]) < LEAST_SIDE:
            return []
        smallest = max(settings.smallest * factor, max(small.shape[:2]) / 20 if settings.smallest == 0 else 8.0)
        # Several BLAS threads would sum in another order, and people who run many nodes have no cores to spare.
        with threadpool_limits(1):
            poses = self.look(small, smallest, settings.places)
        ranked = sorted(poses, key=lambda pose: -self.log_odds(pose))
        people: list[PersonDetection] = []
        for pose in ranked:
            person = PersonDetection(self.parts, pose, 1 / (1 + float(np.exp(-self.log_odds(pose)))), factor)
            if person.confidence < settings.least_confidence or len(people) == settings.most_people:
                break
            if not any(_same(person, other) for other in people):
                people.append(person)
        return people

    def look(self, image: NDArray[np.uint8], smallest: float, places: int) -> list[FoundPose]:
        """The best pose in each of the most promising places, in no order of quality."""
        chosen = choose(propose(image, self.root, smallest), self.forest, places)
        return [self.pose_at(image, candidate, look) for candidate, look in chosen]

    def pose_at(self, image: NDArray[np.uint8], candidate: Candidate, look: float) -> FoundPose:
        """The best pose around a candidate to which the trees gave the score `look`."""
        window = window_at(image, candidate.neck, candidate.face, candidate.scale)
        unary = self.parts.unary(window)
        beliefs = upward(self.parts.tree, unary)
        placement = best_placement(self.parts.tree, beliefs)
        layer, x, y = placement.T
        relative = np.log(candidate.scale / max(image.shape[:2]))
        total = float(beliefs.up[tuple(placement[0, [0, 2, 1]])])
        measures = [candidate.score, look, relative, total, window.outside, *unary[layer, y, x][TELLING]]
        return FoundPose(window, beliefs, placement, np.array(measures, np.float64))

    def log_odds(self, pose: FoundPose) -> float:
        """Log-odds that a pose is that of a person."""
        return float(self.weight @ pose.measures) + self.bias


def checked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image itself; InputError when it is none of the two kinds."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.size == 0:
        raise InputError("an image to look for people in is a uint8 array of one pixel at least")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise InputError(f"an image to look for people in is (H, W) or (H, W, 3), this one is {image.shape}")
    return image


def _same(a: PersonDetection, b: PersonDetection) -> bool:
    """Whether two detections are of one person."""
    distance = float(np.linalg.norm(a.neck - b.neck))
    return distance < SAME_PLACE * max(a.scale, b.scale)
