# SPDX-License-Identifier: Apache-2.0
"""How far a fitted body may be believed: what of it lies on the cloud, and what of the cloud lies on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.model.sp import StitchedPuppet

WIDTH = 0.04  # metres: a vertex or point that far from the other surface counts a quarter
UNCOVERED = 0.04  # metres
# A body with more of the cloud uncovered, or a part less on the cloud, has a limb in a wrong place, or may have.
MUCH_UNCOVERED, LITTLE_ON_CLOUD = 0.005, 0.3
MIN_SEEN = 0.1
RELIABLE, RELIABLY_UNCOVERED = 0.6, 0.05
# Metres between the centres of two neighbours that lie in each other: a little more than what the search forbids (Eq.
# 51), less than in an elbow that is bent as far as it goes (0.064 in a telephone call).
SELF_INTERSECTING = 0.055
# What a folded limb costs in metres of distance: limbs vanish into limbs where they would otherwise be in the air.
SELF_INTERSECTION_COST = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class FitQuality:
    """A body against a cloud.

    Attributes:
        part_confidence: (16,) 0 to 1, how much of each part's seen surface lies on the cloud; 0 for unseen parts.
        seen: (16,) whether at least a tenth of the part's surface is seen.
        explained: 0 to 1, how much of the cloud lies on the body.
        uncovered: share of the cloud's points that are farther than 4 cm from the body.
        folded: joints at which the parts on both sides lie in each other (centres less than 5.5 cm apart).
        distance: mean over both ways of the distances between body and cloud, metres.
    """

    part_confidence: np.ndarray
    seen: np.ndarray
    explained: float
    uncovered: float
    self_intersections: int
    distance: float

    @property
    def cost(self) -> float:
        """What hypotheses are compared by, metres."""
        return self.distance + SELF_INTERSECTION_COST * self.self_intersections

    @property
    def limb_suspect(self) -> bool:
        """Whether a limb may be in a wrong place."""
        least = self.part_confidence[self.seen].min(initial=1.0)
        return self.uncovered > MUCH_UNCOVERED or self.self_intersections > 0 or bool(least < LITTLE_ON_CLOUD)

    @property
    def confidence(self) -> float:
        """0 to 1: the geometric mean of parts on the cloud and cloud on the body.

        A seen part that hardly lies on the cloud lessens it by up to a half, every fold halves it.
        """
        if not self.seen.any():
            return 0.0
        seen = self.part_confidence[self.seen]
        weakest = min(1.0, float(seen.min()) / LITTLE_ON_CLOUD)
        return float(np.sqrt(seen.mean() * self.explained)) * (1 + weakest) / 2 / (1 + self.self_intersections)

    @property
    def reliable(self) -> bool:
        """Whether the confidence is at least 0.6 and at most a twentieth of the cloud is uncovered.

        Of 168 fits of whole clouds (Anny, TOSCA, SHREC'19; good searches and bad ones) this lets none of 10 wrong ones
        pass and stops 9 of the 158 right ones, all of them poor.
        """
        return self.confidence >= RELIABLE and self.uncovered <= RELIABLY_UNCOVERED


def assess_fit(model: StitchedPuppet, vertices: np.ndarray, cloud: Cloud) -> FitQuality:
    """Compare a body with vertices (V, 3), metres, with a cloud.

    A vertex or a cloud point counts by the Geman-McClure weight of its distance to the other surface at 4 cm; a vertex
    counts nothing where the normals disagree.
    """
    normals = vertex_normals(vertices, model.faces)
    distance, index = cloud.nearest.query(vertices)
    weight = (WIDTH**2 / (WIDTH**2 + distance**2)) ** 2
    weight *= (normals * cloud.normals[index]).sum(axis=1) > 0
    seen = cloud.sees(vertices, normals)
    owner, parts = model.part_of_vertex, len(model.tree)
    count, size = np.bincount(owner[seen], minlength=parts), np.bincount(owner, minlength=parts)
    share = np.bincount(owner[seen], weight[seen], minlength=parts) / np.maximum(count, 1)
    back = NearestPoints(vertices).query(cloud.points)[0]
    centers = np.stack([vertices[owner == part].mean(axis=0) for part in range(parts)])
    apart = [np.linalg.norm(centers[parent] - centers[child]) for parent, child in model.tree.edges]
    return FitQuality(
        share,
        count >= MIN_SEEN * size,
        float(((WIDTH**2 / (WIDTH**2 + back**2)) ** 2).mean()),
        float((back > UNCOVERED).mean()),
        int(np.sum(np.array(apart) < SELF_INTERSECTING)),
        two_way_distance(vertices, model.faces, cloud),
    )
