# SPDX-License-Identifier: Apache-2.0
"""Whether a body that was fitted to a candidate is a person: what the rays of the whole scan say about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.bank.body_bank import stature_cost
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights
from flowing_puppet_ros.body.upright.candidate_shape import SHAPE_NAMES, describe_candidates
from flowing_puppet_ros.body.upright.scan_rays import BANDS, ScanRays
from flowing_puppet_ros.body.upright.upright_fit import UprightFit
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.model.sp import StitchedPuppet

EXPLAINED_M, CLOSE_M, FOREIGN_M = 0.08, 0.03, 0.10
"""Distances from the body up to which a candidate's points are explained, and are close, and from which on those of a
column are not its own."""
MAX_HIDDEN, MIN_OUTLINE = 0.5, 0.2
"""Share of a body that may be hidden where less of its outline is seen than this."""
COLUMN_RADIUS_M, COLUMN_HEIGHT_M = 0.5, (0.25, 2.0)
CROWN_RADIUS_M, CROWN_LIMITS_M = 0.2, (0.08, 0.5)
"""Radius about a body's crown, and heights over it, at which nothing is over a person's head."""
MAX_CROWN_SHARE = 1.0
UNSEEN = -1.0  # in place of a share of no rays


EVIDENCE_NAMES = (
    "cost", "distance", "supported", "explained", "foreign", "hidden", "log_points", "confidence", "outline",
    "stature", "crown", "shape", *(f"supported_{k}" for k in range(BANDS)), *(f"outline_{k}" for k in range(BANDS)),
    "close", "alignment", *SHAPE_NAMES,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class FitEvidence:
    """What speaks for a body.

    `values` by `EVIDENCE_NAMES`: cost, metres, of the fit; distance, metres, between body and cloud; supported, share
    of the rays that should end on the body and do, of those that nothing stops before; explained, the share of the
    candidate's points that lie on the body; foreign, the share of the points in a column about it that do not; hidden,
    the share of the rays to the body that end in front of it; log_points, logarithm of the candidate's number of
    points; confidence, of the fit; outline, the share of the rays just left and right of the body that end behind it;
    stature, what it costs; crown, points over the head, for each of the candidate's; shape, how unusual the shape is;
    supported and outline for the legs, the trunk, and head and shoulders; close, as explained, within a smaller
    distance; alignment, the mean cosine of the cloud's normals and the body's; and what the candidate looks like, by
    which a coat stand is told from a person whom it would fit.
    """

    values: np.ndarray

    @property
    def between_others(self) -> bool:
        """Whether most of the body is hidden and no outline is seen: a wall in the gap between two people, say."""
        hidden, outline = (self.values[EVIDENCE_NAMES.index(name)] for name in ("hidden", "outline"))
        return bool(hidden > MAX_HIDDEN and outline < MIN_OUTLINE)


def weigh_fit(
    found: UprightFit,
    cloud: SingleViewCloud,
    candidate: Candidate,
    scene: SceneHeights,
    rays: ScanRays,
    window: np.ndarray,
    model: StitchedPuppet,
) -> FitEvidence:
    """Compare a body with the candidate it was fitted to, the column about it, and the rays of the scan.

    `cloud` are some of the candidate's points; `window` (M,) are the rays near the body.
    """
    fit, vertices = found.fit, found.fit.vertices
    normals = vertex_normals(vertices, model.faces)
    count = rays.compare(window, vertices, normals)
    index = NearestPoints(vertices)
    nearest = index.query(cloud.points)[1]
    distance = index.query(scene.points[candidate.rows])[0]
    middle = vertices[:, :2].mean(axis=0)
    near, away = scene.index.find_near(scene.points, middle, COLUMN_RADIUS_M)
    height = scene.height[near]
    column = near[(height > COLUMN_HEIGHT_M[0]) & (height < COLUMN_HEIGHT_M[1])]
    foreign = float((index.query(scene.points[column])[0] > FOREIGN_M).mean()) if len(column) else 0.0
    over = scene.points[near, 2] - vertices[:, 2].max()
    crown = np.sum((away < CROWN_RADIUS_M) & (over > CROWN_LIMITS_M[0]) & (over < CROWN_LIMITS_M[1]))
    total = [int(part.sum()) for part in count]
    values = [
        found.cost,
        fit.two_way_distance,
        _share(total[0], total[0] + total[1]),
        float((distance < EXPLAINED_M).mean()),
        foreign,
        _share(total[2], sum(total[:3])),
        float(np.log(len(candidate.rows))),
        fit.confidence,
        _share(total[3], total[4]),
        float(stature_cost(np.array(found.stature))),
        min(float(crown) / len(candidate.rows), MAX_CROWN_SHARE),
        float(np.sqrt((fit.state.shape**2).mean())),
        *(_share(count.on[k], count.on[k] + count.behind[k]) for k in range(BANDS)),
        *(_share(count.free[k], count.beside[k]) for k in range(BANDS)),
        float((distance < CLOSE_M).mean()),
        float((cloud.normals * normals[nearest]).sum(axis=1).mean()),
        *describe_candidates([candidate], scene, rays.viewpoint)[0],
    ]
    return FitEvidence(np.array(values, dtype=np.float64))


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole else UNSEEN
