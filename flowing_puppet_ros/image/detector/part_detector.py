# SPDX-License-Identifier: Apache-2.0
"""The person detector for one image: a tree of HOG part filters that stands in for FMP and PS of the thesis.

1. Rigid head-and-shoulders filters propose where people are and how large; boosted trees choose among the proposals.
2. Around each candidate the part filters, mixtures by the limbs' orientation, find the best pose exactly, by dynamic
   programming.
3. A logistic regression on both scores gives the probability that this is a person.

The joints follow the puppet's convention (shoulders near the armpits), so sticks and keypoints need no mapping to
become a Deformable Structures puppet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.evidence.image.colour import ColourImage, SkinColour
from flowing_puppet_ros.evidence.image.region import RegionMap
from flowing_puppet_ros.image.detector.boosted_trees import BoostedTrees
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection, PoseHypothesis
from flowing_puppet_ros.image.detector.part_filters import PARTS, FeatureWindow, PartFilters, extract_window
from flowing_puppet_ros.image.detector.pictorial_structure import FilterTree, find_best_placement, pass_up
from flowing_puppet_ros.image.detector.proposals import propose, rescore
from flowing_puppet_ros.image.detector.root_filters import RootCandidate, RootFilters, resize
from flowing_puppet_ros.image.detector.scoring import (
    MIN_NECK_DISTANCE,
    PoseScorer,
    agree_on_scale,
    neck_distance,
    suppress_duplicates,
)
from flowing_puppet_ros.image.detector.skin_features import skin_features
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.images import as_image
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.process.threads import one_blas_thread

WEIGHTS = "upper"
MIN_SIDE_PX = 24  # nothing is found in a smaller image


DEFAULT_SETTINGS = DetectorSettings()


@dataclass(frozen=True, slots=True, eq=False)
class PartDetector:
    """Learned filters and trees, and the scorer of the poses that they find."""

    root: RootFilters
    trees: BoostedTrees
    parts: PartFilters
    skin: SkinColour
    scorer: PoseScorer

    @classmethod
    def load(cls, name: str = WEIGHTS) -> Self:
        """Load a shipped detector; InputError when there is none of that name."""
        return cls.from_arrays(weights.load("detector", name))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Self:
        """Make a detector from the arrays that `to_arrays` returns."""
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
        """Return the arrays for an .npz file; filters in half precision."""
        tree = self.parts.tree
        return {
            "root_filters": self.root.filters.astype(np.float16),
            "root_bias": self.root.bias,
            "root_offsets": self.root.offsets,
            "tree_features": self.trees.feature,
            "tree_thresholds": self.trees.threshold,
            "tree_leaves": self.trees.leaves,
            "part_filters": self.parts.filters.astype(np.float16),
            "parents": tree.parents,
            "first": tree.first,
            "anchor": tree.anchor,
            "spring": tree.spring,
            "type_bias": tree.bias,
            "skin": self.skin.log_ratio.astype(np.float32),
            "rank_weight": self.scorer.weight,
            "rank_scale": self.scorer.scale,
            "rank_odds": self.scorer.odds,
        }

    def detect(self, image: U8, settings: DetectorSettings = DEFAULT_SETTINGS) -> list[PersonDetection]:
        """Detect the people in an image (H, W, 3) RGB or (H, W) grey uint8, most confident first; see `as_image`."""
        small, factor = _shrink(image, settings)
        if small is None:
            return []
        # Several BLAS threads would sum in another order, and a robot that runs many nodes has no cores to spare.
        with one_blas_thread():
            return self._detect_people(small, _min_width(small, factor, settings), factor, settings)

    def propose(self, image: U8, settings: DetectorSettings = DEFAULT_SETTINGS) -> list[PersonCandidate]:
        """Return all candidates of an image, in no order; one person may have several."""
        small, factor = _shrink(image, settings)
        if small is None:
            return []
        with one_blas_thread():
            poses = self.find_poses(small, _min_width(small, factor, settings), settings.max_candidates)
        scores = self.scorer.score(poses)
        found = []
        for index, (pose, score) in enumerate(zip(poses, scores, strict=True)):
            neck, face = ((pose.points[PARTS.index(name)] + 0.5) / factor - 0.5 for name in ("neck", "face"))
            scale = self.scorer.correct_scale(pose, agree_on_scale(poses, scores, index)) / factor
            found.append(PersonCandidate(neck, face, scale, self.scorer.log_odds(float(score)), pose.score))
        return found

    def detect_at(
        self, image: U8, candidates: Sequence[PersonCandidate], settings: DetectorSettings = DEFAULT_SETTINGS
    ) -> list[PersonDetection]:
        """Fit a pose at each candidate and return, in their order, those that reach the candidate's `min_score`."""
        small, factor = _shrink(image, settings)
        if small is None:
            return []
        found = []
        with one_blas_thread():
            for candidate in candidates:
                neck, face = ((at + 0.5) * factor - 0.5 for at in (candidate.neck, candidate.face))
                window = extract_window(small, (neck[0], neck[1]), (face[0], face[1]), candidate.scale * factor)
                pose = self.fit_in_window(window, np.zeros(0))
                if pose.score >= candidate.min_score:
                    found.append(PersonDetection(self.parts, pose, candidate.probability, factor))
        return found

    def _detect_people(
        self, image: U8, min_width: float, factor: float, settings: DetectorSettings
    ) -> list[PersonDetection]:
        """Detect the people in an image that is `factor` times as large as the given one."""
        poses = self.find_poses(image, min_width, settings.max_candidates)
        mirror = np.ascontiguousarray(image[:, ::-1]) if settings.mirrored else None
        if mirror is not None:
            width = image.shape[1]
            poses += [pose.mirror(width) for pose in self.find_poses(mirror, min_width, settings.max_candidates)]
        scores = self.scorer.score(poses)
        people: list[PersonDetection] = []
        for index in suppress_duplicates(poses, scores):
            confidence = self.scorer.probability(float(scores[index]))
            if confidence < settings.min_confidence or len(people) == settings.max_people:
                break
            pose = poses[index]
            scale = self._estimate_scale(poses, scores, index)
            points = dict(zip(PARTS, pose.points, strict=True))
            refitted = self._refit(image, mirror, points["neck"], points["face"], scale, pose.features)
            # At another scale the neck may have moved onto that of an already detected person.
            if all(neck_distance(refitted, other.pose) >= MIN_NECK_DISTANCE for other in people):
                people.append(PersonDetection(self.parts, refitted, confidence, factor))
        return people

    def _estimate_scale(self, poses: Sequence[PoseHypothesis], scores: F64, index: int) -> float:
        """Estimate S of the person of a pose: the geometric mean over the image and its mirror image."""
        logs = []
        for mirror in {pose.window.mirror for pose in poses}:
            own = [k for k, pose in enumerate(poses) if pose.window.mirror == mirror]
            near = [n for n, k in enumerate(own) if neck_distance(poses[k], poses[index]) < MIN_NECK_DISTANCE]
            if near:
                best = max(near, key=lambda n: scores[own[n]])
                agreed = agree_on_scale([poses[k] for k in own], scores[own], best)
                logs.append(np.log(self.scorer.correct_scale(poses[own[best]], agreed)))
        return float(np.exp(np.mean(logs)))

    def _refit(
        self,
        image: U8,
        mirror: U8 | None,
        neck: F64,
        face: F64,
        scale: float,
        features: F64,
    ) -> PoseHypothesis:
        """Return the best pose at a neck and a face (2,) px, in the image or in its mirror image."""
        pose = self.fit_in_window(extract_window(image, (neck[0], neck[1]), (face[0], face[1]), scale), features)
        if mirror is None:
            return pose
        width = image.shape[1]
        window = extract_window(mirror, (width - 1 - neck[0], neck[1]), (width - 1 - face[0], face[1]), scale)
        other = self.fit_in_window(window, features).mirror(width)
        return other if other.score > pose.score else pose

    def find_poses(self, image: U8, min_width: float, max_candidates: int) -> list[PoseHypothesis]:
        """Return the best pose at each of the most promising candidates, in no order of quality."""
        chosen = rescore(propose(image, self.root, min_width), self.trees, max_candidates)
        skin = self.skin.map(ColourImage.of(image))
        return [self.fit_at_candidate(image, skin, candidate, tree_score) for candidate, tree_score in chosen]

    def fit_at_candidate(
        self, image: U8, skin: RegionMap, candidate: RootCandidate, tree_score: float
    ) -> PoseHypothesis:
        """Fit the best pose around a candidate with the trees' score `tree_score`; `skin` is the image's skin map."""
        window = extract_window(image, candidate.neck, candidate.face, candidate.scale)
        relative = np.log(candidate.scale / max(image.shape[:2]))
        pose = self.fit_in_window(window, np.zeros(0))
        known = [candidate.score, tree_score, relative, pose.score, window.outside]
        neck, face = (pose.points[PARTS.index(name)] for name in ("neck", "face"))
        features = np.concatenate([known, skin_features(skin, neck, face, candidate.scale)])
        return PoseHypothesis(window, pose.beliefs, pose.placement, features)

    def fit_in_window(self, window: FeatureWindow, features: F64) -> PoseHypothesis:
        """Fit the best pose in a window, and give it `features` that are known already."""
        beliefs = pass_up(self.parts.tree, self.parts.respond(window))
        return PoseHypothesis(window, beliefs, find_best_placement(self.parts.tree, beliefs), features)


def _shrink(image: U8, settings: DetectorSettings) -> tuple[U8 | None, float]:
    """Return the image as it is searched, None when it is too small, and its size in units of the given one."""
    pixels = as_image(image)
    factor = min(1.0, settings.max_side / max(pixels.shape[:2]))
    if min(pixels.shape[:2]) * factor < MIN_SIDE_PX:
        return None, factor
    return resize(pixels, factor) if factor < 1 else pixels, factor


def _min_width(image: U8, factor: float, settings: DetectorSettings) -> float:
    """Return the minimum shoulder width to detect, px of an image that is `factor` times as large as the given one."""
    return max(
        settings.min_shoulder_width * factor, max(image.shape[:2]) / 20 if settings.min_shoulder_width == 0 else 8.0
    )
