# SPDX-License-Identifier: Apache-2.0
"""The detector of people in one image: a tree of HOG part filters that stands in for FMP and PS of the thesis.

Rigid head-and-shoulders filters say where people may stand and how large they are; in each of the best places the
part filters, mixtures by the orientation of the limbs, find the pose exactly by dynamic programming; a logistic
regression on both scores says how probable it is that somebody was found. The joints follow the puppet's convention
(shoulders near the armpits), so that sticks or keypoints need no mapping to become a Deformable Structures puppet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.colour import ColourImage, SkinColour
from flowing_puppet_ros.evidence.image.region import RegionMap
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection, PoseHypothesis
from flowing_puppet_ros.image.detector.part_filters import PARTS, FeatureWindow, PartFilters, window_at
from flowing_puppet_ros.image.detector.pictorial_structure import FilterTree, best_placement, pass_up
from flowing_puppet_ros.image.detector.proposals import propose, rescore
from flowing_puppet_ros.image.detector.root_filters import RootCandidate, RootFilters, resize
from flowing_puppet_ros.image.detector.scoring import (
    SAME_PLACE,
    PoseScorer,
    agree_on_scale,
    neck_distance,
    suppress_duplicates,
)
from flowing_puppet_ros.image.detector.skin_features import skin_features
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.settings import Settings, setting

WEIGHTS = "upper"
LEAST_SIDE = 24  # px; nothing is found in a smaller image


@dataclass(frozen=True, slots=True)
class DetectorSettings(Settings):
    """Whom to look for, and how hard."""

    smallest: float = setting(
        0.0, "smallest shoulder width to look for; 0 is a twentieth of the longer side", unit="px", low=0.0, high=1e5
    )
    largest_side: int = setting(720, "images are shrunk to this longer side", unit="px", low=64, high=4096)
    places: int = setting(12, "places where a pose is sought", low=1, high=80)
    most_people: int = setting(8, "people to report", low=1, high=80)
    mirrored: bool = setting(True, "look at the mirror image too: more is found, and it takes twice as long")
    least_confidence: float = setting(0.03, "probability below which nobody is reported", low=0.0, high=1.0)


DEFAULTS = DetectorSettings()


@dataclass(frozen=True, slots=True, eq=False)
class PartDetector:
    """Learned filters and trees, and how to rank the poses that they find."""

    root: RootFilters
    forest: BoostedTrees
    parts: PartFilters
    skin: SkinColour
    ranking: PoseScorer

    @classmethod
    def load(cls, name: str = WEIGHTS) -> Self:
        """The shipped detector; InputError when there is none of that name."""
        return cls.from_arrays(weights.load("detector", name))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Self:
        """A detector of the arrays that `to_arrays` gives."""
        single = {name: np.ascontiguousarray(value, np.float32) for name, value in arrays.items()}
        root = RootFilters(single["root_filters"], single["root_bias"], single["root_offsets"])
        forest = BoostedTrees(arrays["tree_features"], arrays["tree_thresholds"], single["tree_leaves"])
        parents, first = (np.asarray(arrays[name], np.int64) for name in ("parents", "first"))
        tree = FilterTree(parents, first, single["anchor"], single["spring"], single["type_bias"])
        rank = PoseScorer(
            *(np.asarray(arrays[name], np.float64) for name in ("rank_weight", "rank_scale", "rank_odds"))
        )
        skin = SkinColour(np.asarray(arrays["skin"], np.float64))
        return cls(root, forest, PartFilters(single["part_filters"], tree), skin, rank)

    def to_arrays(self) -> dict[str, Array]:
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
            "skin": self.skin.log_ratio.astype(np.float32),
            "rank_weight": self.ranking.weight,
            "rank_scale": self.ranking.scale,
            "rank_odds": self.ranking.odds,
        }

    def detect(self, image: U8, settings: DetectorSettings = DEFAULTS) -> list[PersonDetection]:
        """The people in an image (H, W, 3) RGB or (H, W) grey, uint8, the surest first; InputError for other arrays."""
        small, factor = _shrunk(image, settings)
        if small is None:
            return []
        # Several BLAS threads would sum in another order, and people who run many nodes have no cores to spare.
        with one_blas_thread():
            return self._people(small, _smallest(small, factor, settings), factor, settings)

    def propose(self, image: U8, settings: DetectorSettings = DEFAULTS) -> list[PersonCandidate]:
        """All places of an image in which a pose was sought, in no order, several for one person among them."""
        small, factor = _shrunk(image, settings)
        if small is None:
            return []
        with one_blas_thread():
            poses = self.find_poses(small, _smallest(small, factor, settings), settings.places)
        scores = self.ranking.scores(poses)
        found = []
        for index, (pose, score) in enumerate(zip(poses, scores, strict=True)):
            neck, face = ((pose.points[PARTS.index(name)] + 0.5) / factor - 0.5 for name in ("neck", "face"))
            scale = self.ranking.corrected_scale(pose, agree_on_scale(poses, scores, index)) / factor
            found.append(PersonCandidate(neck, face, scale, self.ranking.log_odds(float(score)), pose.score))
        return found

    def detect_at(
        self, image: U8, places: Sequence[PersonCandidate], settings: DetectorSettings = DEFAULTS
    ) -> list[PersonDetection]:
        """The best poses at some places of an image, in their order, without those that nobody is seen at."""
        small, factor = _shrunk(image, settings)
        if small is None:
            return []
        found = []
        with one_blas_thread():
            for place in places:
                neck, face = ((at + 0.5) * factor - 0.5 for at in (place.neck, place.face))
                window = window_at(small, (neck[0], neck[1]), (face[0], face[1]), place.scale * factor)
                pose = self.pose_in_window(window, np.zeros(0))
                if pose.score >= place.min_score:
                    found.append(PersonDetection(self.parts, pose, place.probability, factor))
        return found

    def _people(self, image: U8, smallest: float, factor: float, settings: DetectorSettings) -> list[PersonDetection]:
        """The people in an image that is `factor` times as large as the given one."""
        poses = self.find_poses(image, smallest, settings.places)
        mirror = np.ascontiguousarray(image[:, ::-1]) if settings.mirrored else None
        if mirror is not None:
            width = image.shape[1]
            poses += [pose.mirror(width) for pose in self.find_poses(mirror, smallest, settings.places)]
        scores = self.ranking.scores(poses)
        people: list[PersonDetection] = []
        for index in suppress_duplicates(poses, scores):
            confidence = self.ranking.probability(float(scores[index]))
            if confidence < settings.least_confidence or len(people) == settings.most_people:
                break
            pose = poses[index]
            scale = self._scale(poses, scores, index)
            places = dict(zip(PARTS, pose.points, strict=True))
            again = self._again(image, mirror, places["neck"], places["face"], scale, pose.features)
            # At another scale the neck may have moved onto that of a person who is known already.
            if all(neck_distance(again, other.pose) >= SAME_PLACE for other in people):
                people.append(PersonDetection(self.parts, again, confidence, factor))
        return people

    def _scale(self, poses: Sequence[PoseHypothesis], scores: F64, index: int) -> float:
        """S of the person of a pose: the mean, of logarithms, over the image and its mirror image."""
        logs = []
        for turned in {pose.window.mirror for pose in poses}:
            own = [k for k, pose in enumerate(poses) if pose.window.mirror == turned]
            near = [n for n, k in enumerate(own) if neck_distance(poses[k], poses[index]) < SAME_PLACE]
            if near:
                best = max(near, key=lambda n: scores[own[n]])
                agreed = agree_on_scale([poses[k] for k in own], scores[own], best)
                logs.append(np.log(self.ranking.corrected_scale(poses[own[best]], agreed)))
        return float(np.exp(np.mean(logs)))

    def _again(
        self,
        image: U8,
        mirror: U8 | None,
        neck: F64,
        face: F64,
        scale: float,
        measures: F64,
    ) -> PoseHypothesis:
        """The best pose at a neck and a face (2,) px, in the image or in its mirror image."""
        pose = self.pose_in_window(window_at(image, (neck[0], neck[1]), (face[0], face[1]), scale), measures)
        if mirror is None:
            return pose
        width = image.shape[1]
        window = window_at(mirror, (width - 1 - neck[0], neck[1]), (width - 1 - face[0], face[1]), scale)
        other = self.pose_in_window(window, measures).mirror(width)
        return other if other.score > pose.score else pose

    def find_poses(self, image: U8, smallest: float, places: int) -> list[PoseHypothesis]:
        """The best pose in each of the most promising places, in no order of quality."""
        chosen = rescore(propose(image, self.root, smallest), self.forest, places)
        skin = self.skin.map(ColourImage.of(image))
        return [self.pose_at_candidate(image, skin, candidate, look) for candidate, look in chosen]

    def pose_at_candidate(self, image: U8, skin: RegionMap, candidate: RootCandidate, look: float) -> PoseHypothesis:
        """The best pose around a candidate to which the trees gave the score `look`; `skin` is the image's map."""
        window = window_at(image, candidate.neck, candidate.face, candidate.scale)
        relative = np.log(candidate.scale / max(image.shape[:2]))
        pose = self.pose_in_window(window, np.zeros(0))
        known = [candidate.score, look, relative, pose.score, window.outside]
        neck, face = (pose.points[PARTS.index(name)] for name in ("neck", "face"))
        measures = np.concatenate([known, skin_features(skin, neck, face, candidate.scale)])
        return PoseHypothesis(window, pose.beliefs, pose.placement, measures)

    def pose_in_window(self, window: FeatureWindow, measures: F64) -> PoseHypothesis:
        """The best pose in a window, with measures that are known already."""
        beliefs = pass_up(self.parts.tree, self.parts.unary(window))
        return PoseHypothesis(window, beliefs, best_placement(self.parts.tree, beliefs), measures)


def _shrunk(image: U8, settings: DetectorSettings) -> tuple[U8 | None, float]:
    """The image as it is looked at, None when it is too small, and its size in units of the given one."""
    pixels = check_image(image)
    factor = min(1.0, settings.largest_side / max(pixels.shape[:2]))
    if min(pixels.shape[:2]) * factor < LEAST_SIDE:
        return None, factor
    return resize(pixels, factor) if factor < 1 else pixels, factor


def _smallest(image: U8, factor: float, settings: DetectorSettings) -> float:
    """Smallest shoulder width to look for, px of an image that is `factor` times as large as the given one."""
    return max(settings.smallest * factor, max(image.shape[:2]) / 20 if settings.smallest == 0 else 8.0)


def check_image(image: U8) -> U8:
    """The image itself; InputError when it is none of the two kinds."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.size == 0:
        raise InputError("an image to look for people in is a uint8 array of one pixel at least")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise InputError(f"an image to look for people in is (H, W) or (H, W, 3), this one is {image.shape}")
    return image
