# SPDX-License-Identifier: Apache-2.0
"""Whether a body that was fitted to a candidate is a person: what the rays of the whole scan say about it."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFit
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints

EXPLAINED_M, FOREIGN_M = 0.08, 0.10
"""Distance from the body up to which a candidate's points are explained, and from which on those of a column are not
its own."""
MAX_HIDDEN, MIN_OUTLINE = 0.5, 0.2
"""Share of a body that may be hidden where less of its outline is seen than this."""
COLUMN_RADIUS_M, COLUMN_HEIGHT_M = 0.5, (0.25, 2.0)


@dataclass(frozen=True, slots=True)
class FitEvidence:
    """What speaks for a body.

    Attributes:
        cost: metres, of the fit.
        supported: share of the rays that should end on the body and do, of those that nothing stops before.
        explained: share of the candidate's points that lie on the body.
        foreign: share of the points in a column about the body that do not.
        hidden: share of the rays to the body that end in front of it.
        log_points: natural logarithm of the candidate's number of points.
        confidence: of the fit.
        outline: share of the rays just left and right of the body that end behind it; not learned from.
    """

    cost: float
    supported: float
    explained: float
    foreign: float
    hidden: float
    log_points: float
    confidence: float
    outline: float

    @property
    def between_others(self) -> bool:
        """Whether most of the body is hidden and no outline is seen: a wall in the gap between two people, say."""
        return self.hidden > MAX_HIDDEN and self.outline < MIN_OUTLINE

    def to_array(self) -> np.ndarray:
        """Return the numbers (7,) that are learned from, in the order of the attributes."""
        return np.array(astuple(self)[:-1])


def weigh_fit(
    found: UprightFit, candidate: Candidate, scene: SceneHeights, rays: ScanRays, window: np.ndarray, faces: np.ndarray
) -> FitEvidence:
    """Compare a body with the candidate, the column around it, and the rays of the scan in its `window` (M,)."""
    vertices = found.fit.vertices
    count = rays.compare(window, vertices, vertex_normals(vertices, faces))
    index = NearestPoints(vertices)
    distance = index.query(scene.points[candidate.rows])[0]
    middle = vertices[:, :2].mean(axis=0)
    near = window[np.hypot(*(scene.points[window, :2] - middle).T) < COLUMN_RADIUS_M]
    height = scene.height[near]
    near = near[(height > COLUMN_HEIGHT_M[0]) & (height < COLUMN_HEIGHT_M[1])]
    foreign = float((index.query(scene.points[near])[0] > FOREIGN_M).mean()) if len(near) else 0.0
    return FitEvidence(
        cost=found.cost,
        supported=count.on / max(count.on + count.behind, 1),
        explained=float((distance < EXPLAINED_M).mean()),
        foreign=foreign,
        hidden=count.before / max(count.on + count.behind + count.before, 1),
        log_points=float(np.log(len(candidate.rows))),
        confidence=found.fit.confidence,
        outline=count.free / max(count.beside, 1),
    )
