# SPDX-License-Identifier: Apache-2.0
"""The body beneath the garments of a dense whole scan: one shape within human limits, with the garments outside of it.

A body that is fitted to a clothed scan by least squares lies in the middle of the garments' folds, so it is too wide,
and its joints are too far out. How far the scan departs from any body's surface, part by part, tells how loose a
garment is: it touches the body in some places and stands off in others, so its mean distance is between one and two of
its spreads. The cloud is moved inwards by the distance at which its points lie, within one-sided margins of each part,
and the body is fitted to it again.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import MIN_NORMAL_COSINE, NORMAL_LENGTH_M, Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

MIN_CLOTHED_SPREAD_M = 0.0045
"""Root mean square distance between scan and body above which somebody wears more than skin: 2 to 3 mm without."""
SKIN_SPREAD_M = 0.0035  # of a bare part, which the model cannot express
MEAN_PER_SPREAD = 1.7  # distance of a garment, in spreads of it
MARGIN_IN, MARGIN_OUT = 0.7, 2.5
"""How much nearer to the body and farther from it than the mean a garment may lie at no cost, in spreads."""
MAX_SPREAD_M = 0.012  # of a garment that says where the limb is; skirts say less
MAX_GAP_M = 0.12  # of a garment; what is farther away is something else
MIN_PART_POINTS = 20
ROUNDS = 4
WEIGHTS = RefineWeights(sigma_start=0.05, sigma_end=0.03, iterations=5)


def measure_gaps(model: StitchedPuppet, body: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return how far the vertices (V, 3) of a surface lie outside of those of a body, along its normals (V,)."""
    return np.asarray(((surface - body) * vertex_normals(body, model.faces)).sum(axis=1))


def measure_part_gaps(model: StitchedPuppet, body: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return the mean of `measure_gaps` over each part (16,)."""
    total = np.bincount(model.part_of_vertex, measure_gaps(model, body, surface), minlength=len(model.tree))
    return np.asarray(total / np.bincount(model.part_of_vertex, minlength=len(model.tree)))


class BodyBeneath:
    """Finds the bodies of one model beneath what people wear."""

    def __init__(self, model: StitchedPuppet, gauss_newton: GaussNewton) -> None:
        self._model = model
        self._gauss_newton = gauss_newton

    def find(self, state: BodyState, cloud: Cloud) -> BodyState:
        """Return the body beneath a dense whole cloud to which `state` is fitted; that itself where nothing is worn."""
        gap, part, used = self._measure_gaps(state, cloud)
        if not used.any() or np.sqrt((gap[used] ** 2).mean()) < MIN_CLOTHED_SPREAD_M:
            return state
        square = self._mean_of_parts(gap**2, part, used)
        none = JointTargets.none(self._model)
        for _ in range(ROUNDS):
            worn = np.minimum(np.sqrt(np.maximum(square - SKIN_SPREAD_M**2, 0.0)), MAX_SPREAD_M)[part]
            low, high = (MEAN_PER_SPREAD - MARGIN_IN) * worn, (MEAN_PER_SPREAD + MARGIN_OUT) * worn
            inner = cloud.points - np.clip(gap, low, high)[:, None] * cloud.normals
            state = self._gauss_newton.run(state, Cloud.of(inner, cloud.normals), none, WEIGHTS)
            gap, part, used = self._measure_gaps(state, cloud)
            mean = self._mean_of_parts(gap, part, used)
            square = self._mean_of_parts((gap - mean[part]) ** 2, part, used)
        return state

    def _measure_gaps(self, state: BodyState, cloud: Cloud) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how far the points (N,) lie outside of the body, metres, at which parts, and which are near it."""
        vertices = self._model.vertices(state)
        normals = vertex_normals(vertices, self._model.faces)
        nearest = NearestPoints(vertices, normals, NORMAL_LENGTH_M).query(cloud.points, cloud.normals)[1]
        gap = ((cloud.points - vertices[nearest]) * normals[nearest]).sum(axis=1)
        alike = (normals[nearest] * cloud.normals).sum(axis=1) > MIN_NORMAL_COSINE
        return gap, self._model.part_of_vertex[nearest], alike & (np.abs(gap) < MAX_GAP_M)

    def _mean_of_parts(self, values: np.ndarray, part: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Return the mean value of each part's used points (16,), 0 where these are few."""
        count = np.bincount(part[used], minlength=len(self._model.tree))
        total = np.bincount(part[used], values[used], minlength=len(self._model.tree))
        return np.where(count < MIN_PART_POINTS, 0.0, total / np.maximum(count, 1))
