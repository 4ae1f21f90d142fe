# SPDX-License-Identifier: Apache-2.0
"""Types of the parts (mixtures by the orientation of the limbs around them) and the springs between parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.cluster.vq import kmeans2

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.detector.part_filters import CELLS_PER_SCALE, PARENTS, PARTS
from flowing_puppet_ros.image.detector.pictorial_structure import FilterTree
from flowing_puppet_ros.learn.detector.data import JOINTS, Example
from flowing_puppet_ros.model.tree import mirrored_name

SPRING_WEIGHT = 0.1  # weight of a Gaussian's negative log-likelihood, in units of the margin
MIN_DEVIATION_CELLS, MAX_DEVIATION_CELLS = 0.7, 4.0  # of a part from its anchor
# Number of types, and the vectors (from, to) that determine the type; for paired parts, those of the left side.
TYPE_VECTORS: dict[str, tuple[int, tuple[tuple[str, str], ...]]] = {
    "neck": (4, (("neck", "face"), ("neck", "right_shoulder"), ("neck", "left_shoulder"))),
    "face": (4, (("neck", "face"), ("neck", "right_shoulder"), ("neck", "left_shoulder"))),
    "belly": (3, (("neck", "belly"),)),
    "left_hip": (3, (("belly", "left_hip"),)),
    "left_shoulder": (6, (("neck", "left_shoulder"), ("left_shoulder", "left_elbow"))),
    "left_upper_arm": (8, (("left_shoulder", "left_elbow"),)),
    "left_elbow": (14, (("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"))),
    "left_forearm": (10, (("left_elbow", "left_wrist"),)),
    "left_wrist": (10, (("left_elbow", "left_wrist"),)),
}


def locate_parts(example: Example) -> tuple[Array, Array]:
    """Return the positions (P, 2) px of the parts and whether they were seen (P,) bool."""
    joints = dict(zip(JOINTS, example.joints, strict=True))
    seen = dict(zip(JOINTS, example.seen.tolist(), strict=True))
    for side in ("right", "left"):
        shoulder, elbow, wrist = (f"{side}_{name}" for name in ("shoulder", "elbow", "wrist"))
        for name, ends in ((f"{side}_upper_arm", (shoulder, elbow)), (f"{side}_forearm", (elbow, wrist))):
            joints[name] = (joints[ends[0]] + joints[ends[1]]) / 2
            seen[name] = seen[ends[0]] and seen[ends[1]]
    return np.stack([joints[name] for name in PARTS]), np.array([seen[name] for name in PARTS])


@dataclass(frozen=True, slots=True, eq=False)
class PartTypes:
    """Types of the parts: cluster `centers` (T, 2 * vectors) of each, and the `tree` with springs and zero biases."""

    centers: tuple[Array, ...]
    tree: FilterTree

    @classmethod
    def learn(cls, examples: Sequence[Example], rng: np.random.Generator) -> Self:
        """Cluster the people and their mirror images; types of right parts mirror those of left parts."""
        both = [*examples, *(example.mirror() for example in examples)]
        nodes, seen = (np.stack(arrays) for arrays in zip(*(locate_parts(example) for example in both), strict=True))
        nodes = nodes / np.array([example.scale for example in both])[:, None, None]
        left: dict[str, Array] = {}
        for name, (count, vectors) in TYPE_VECTORS.items():
            known = np.all([seen[:, PARTS.index(end)] for pair in vectors for end in pair], axis=0)
            left[name] = _cluster(_describe(nodes[known], vectors), count, rng)
        centers = tuple(_centers_of_part(name, left) for name in PARTS)
        layers = np.stack(
            [_assign_nearest(_describe(nodes, _select_vectors(n)), c) for n, c in zip(PARTS, centers, strict=True)], 1
        )
        return cls(centers, _fit_springs(nodes * CELLS_PER_SCALE, seen, layers, centers))

    def assign_layers(self, nodes: Array) -> Array:
        """Return the layer (P,) of each part, given positions `nodes` (P, 2) in units of S."""
        types = [
            _assign_nearest(_describe(nodes[None], _select_vectors(n)), c)[0]
            for n, c in zip(PARTS, self.centers, strict=True)
        ]
        return np.array(types) + self.tree.first[:-1]


def _select_vectors(name: str) -> tuple[tuple[str, str], ...]:
    """Return the vectors that determine the type of a part."""
    if not name.startswith("right_"):
        return TYPE_VECTORS[name][1]
    mirrored = TYPE_VECTORS[name.replace("right_", "left_")][1]
    return tuple((mirrored_name(a), mirrored_name(b)) for a, b in mirrored)


def _describe(nodes: Array, vectors: tuple[tuple[str, str], ...]) -> Array:
    """Return the stacked vectors (N, 2 * vectors) of positions (N, P, 2)."""
    return np.concatenate([nodes[:, PARTS.index(b)] - nodes[:, PARTS.index(a)] for a, b in vectors], axis=1)


def _cluster(vectors: Array, count: int, rng: np.random.Generator) -> Array:
    """Return cluster centres (count, D); one, their mean, if there are too few vectors."""
    if len(vectors) < 10 * count:
        return vectors.mean(axis=0, keepdims=True) if len(vectors) else np.zeros((1, vectors.shape[1]))
    centers, labels = kmeans2(vectors, count, minit="++", seed=rng, iter=60)
    return np.asarray(centers[np.bincount(labels, minlength=count) > 0])


def _centers_of_part(name: str, left: dict[str, Array]) -> Array:
    """Return the type centres of a part, mirrored from the left side if need be."""
    if name in left:
        return left[name]
    mirrored = left[name.replace("right_", "left_")].copy()
    mirrored[:, 0::2] *= -1
    return mirrored


def _assign_nearest(vectors: Array, centers: Array) -> Array:
    nearest: Array = np.square(vectors[:, None] - centers[None]).sum(axis=2).argmin(axis=1)
    return nearest


def _fit_springs(nodes: Array, seen: Array, types: Array, centers: tuple[Array, ...]) -> FilterTree:
    """Fit mean and deviation of the step from the parent for every type; `nodes` (N, P, 2) in cells."""
    first = np.cumsum([0, *(len(c) for c in centers)])
    anchor, spring = np.zeros((first[-1], 2), np.float32), np.ones((first[-1], 2), np.float32)
    for part in range(1, len(PARTS)):
        steps = nodes[:, part] - nodes[:, PARENTS[part]]
        known = seen[:, part] & seen[:, PARENTS[part]]
        for kind in range(len(centers[part])):
            mine = steps[known & (types[:, part] == kind)]
            if not len(mine):
                mine = steps
            deviation = np.clip(mine.std(axis=0), MIN_DEVIATION_CELLS, MAX_DEVIATION_CELLS)
            anchor[first[part] + kind] = mine.mean(axis=0)
            spring[first[part] + kind] = SPRING_WEIGHT * 0.5 / deviation**2
    bias = np.zeros((first[-1], max(len(c) for c in centers)), np.float32)
    return FilterTree(np.array(PARENTS), first, anchor, spring, bias)
