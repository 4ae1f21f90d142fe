# SPDX-License-Identifier: Apache-2.0
"""How far a fitted body can be trusted: how much of it lies on the cloud, and how much of the cloud lies on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, SurfaceDistances, geman_mcclure, measure_distances
from flowing_puppet_ros.body.cloud.mesh_geometry import sum_groups, vertex_normals
from flowing_puppet_ros.model.sp import StitchedPuppet

KERNEL_WIDTH_M = 0.04  # distance to the other surface at which a vertex or point counts a quarter
MAX_COVERED_DISTANCE_M = 0.04  # between a covered cloud point and the body
MAX_STRAY_NOISES = 4.0
"""Distance from the body, in deviations of the cloud's noise and beside those 4 cm, from which on a point is stray. A
depth camera's noise grows with the distance, and at 3.5 m every tenth point is 4 cm away from a body that is right."""
# With more of the cloud uncovered, or a part less on the cloud, a limb may be in a wrong place.
MAX_LIMB_UNCOVERED, MIN_PART_CONFIDENCE = 0.005, 0.3
MIN_SEEN_SHARE = 0.1  # of a part's vertices
# Bounds of a reliable body.
MIN_CONFIDENCE, MAX_UNCOVERED = 0.6, 0.05
# Distance between the centres of neighbouring parts below which they intersect: a little more than the search forbids
# (Eq. 51), less than in an elbow that is bent as far as it goes (0.064 m with a phone at the ear).
MIN_DISJOINT_DISTANCE_M = 0.055
# Cost of a self-intersection: limbs are folded into limbs where they would otherwise be in the air.
SELF_INTERSECTION_COST_M = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class FitQuality:
    """The quality of a body on a cloud.

    Attributes:
        part_confidence: (16,) 0 to 1, how much of each part's seen surface lies on the cloud; 0 for unseen parts.
        seen: (16,) whether at least a tenth of the part's surface is seen.
        explained: 0 to 1, how much of the cloud lies on the body.
        uncovered: share of the cloud's points that are farther than 4 cm from the body.
        stray: share of the cloud's points that are farther from the body than 4 cm and the cloud's noise explain.
        self_intersections: joints whose two parts intersect (centres less than 5.5 cm apart).
        distance: mean distance between body and cloud over both directions, metres.
        surface: the distances from which all of this follows.
    """

    part_confidence: np.ndarray
    seen: np.ndarray
    explained: float
    uncovered: float
    stray: float
    self_intersections: int
    distance: float
    surface: SurfaceDistances

    @property
    def cost(self) -> float:
        """Cost by which hypotheses are compared, metres."""
        return self.distance + SELF_INTERSECTION_COST_M * self.self_intersections

    @property
    def limb_suspect(self) -> bool:
        """Whether a limb may be in a wrong place."""
        lowest = self.part_confidence[self.seen].min(initial=1.0)
        uncovered = self.uncovered > MAX_LIMB_UNCOVERED
        return uncovered or self.self_intersections > 0 or bool(lowest < MIN_PART_CONFIDENCE)

    @property
    def confidence(self) -> float:
        """Geometric mean of the parts on the cloud and the cloud on the body, 0 to 1.

        A seen part that hardly lies on the cloud lowers it by up to a half; every self-intersection divides it further.
        """
        if not self.seen.any():
            return 0.0
        seen = self.part_confidence[self.seen]
        weakest = min(1.0, float(seen.min()) / MIN_PART_CONFIDENCE)
        return float(np.sqrt(seen.mean() * self.explained)) * (1 + weakest) / 2 / (1 + self.self_intersections)

    @property
    def reliable(self) -> bool:
        """Whether the confidence is at least 0.6 and at most a twentieth of the cloud is stray.

        Of 168 fits of whole clouds (Anny, TOSCA, SHREC'19; good and bad searches) it rejects all 10 wrong ones and 9 of
        the 158 right ones, all of them poor.
        """
        return self.confidence >= MIN_CONFIDENCE and self.stray <= MAX_UNCOVERED


def assess_fit(model: StitchedPuppet, vertices: np.ndarray, cloud: Cloud) -> FitQuality:
    """Assess a body with `vertices` (V, 3) in metres on a cloud.

    Vertices and cloud points count with the `geman_mcclure` weight of their distance to the other surface, of width
    4 cm; vertices not at all where the normals disagree.
    """
    normals = vertex_normals(vertices, model.faces)
    distances = measure_distances(vertices, normals, model.faces, cloud)
    seen = np.flatnonzero(distances.seen[: len(vertices)])
    weight = geman_mcclure(distances.to_cloud[: len(seen)] ** 2, KERNEL_WIDTH_M**2)
    weight *= (normals[seen] * cloud.normals[distances.nearest[: len(seen)]]).sum(axis=1) > 0
    owner, parts = model.part_of_vertex, len(model.tree)
    count, size = np.bincount(owner[seen], minlength=parts), np.bincount(owner, minlength=parts)
    share = np.bincount(owner[seen], weight, minlength=parts) / np.maximum(count, 1)
    to_vertex = distances.to_vertex
    centers = sum_groups(vertices, owner, parts) / size[:, None]
    edges = np.array(model.tree.edges)
    apart = np.linalg.norm(centers[edges[:, 0]] - centers[edges[:, 1]], axis=1)
    return FitQuality(
        share,
        count >= MIN_SEEN_SHARE * size,
        float(geman_mcclure(to_vertex**2, KERNEL_WIDTH_M**2).mean()),
        float((to_vertex > MAX_COVERED_DISTANCE_M).mean()),
        float((to_vertex > np.hypot(MAX_COVERED_DISTANCE_M, MAX_STRAY_NOISES * cloud.noise)).mean()),
        int(np.count_nonzero(apart < MIN_DISJOINT_DISTANCE_M)),
        distances.two_way,
        distances,
    )
