# SPDX-License-Identifier: Apache-2.0
"""The non-rigid finish: every vertex of a fitted body moves by itself onto the cloud, and its neighbours with it.

What no pose and no learned shape can express (a belly, a face, a fist) is left over after the fit of the parts. Here
the unknowns are free offsets of all vertices. They are drawn by the matches of `correspondence.Matches` and held
together by the squared differences between every offset and the mean of its neighbours' (the umbrella operator of
Kobbelt et al., SIGGRAPH 1998), which lets smooth corrections pass and resists wrinkles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence

# Weight of the squared offsets themselves: where the cloud says nothing at all, nothing moves.
ANCHOR = 0.01
# Mean weight of the matches in the preconditioner; the solution does not depend on it.
TYPICAL_WEIGHT = 0.45
TOLERANCE = 1e-3
MAX_SOLVER_STEPS = 60


@dataclass(frozen=True, slots=True)
class NonRigidWeights:
    """How far and how stiffly vertices move.

    Attributes:
        stiffness: weight of the squared umbrella differences of the offsets, against matches that weigh about 2 a
            vertex.
        sigma_start: first width of the matches' robust kernel, metres.
        sigma_end: last width.
        iterations: rounds of matching and solving.
    """

    stiffness: float = 50.0
    sigma_start: float = 0.03
    sigma_end: float = 0.015
    iterations: int = 6


def umbrella_laplacian(faces: np.ndarray, count: int) -> csr_matrix:
    """The operator (V, V) that takes from every vertex's value the mean of its neighbours' along the edges of faces."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    degree = np.bincount(edges[:, 0], minlength=count)
    linked = coo_matrix((1 / degree[edges[:, 0]], edges.T), shape=(count, count))
    return (diags_array((degree > 0).astype(float)) - linked).tocsr()


class NonRigidRefinement:
    """The finish for meshes of one topology; what depends on the topology alone is computed once."""

    def __init__(self, faces: np.ndarray, count: int, weights: NonRigidWeights) -> None:
        self._faces = faces
        self._weights = weights
        operator = umbrella_laplacian(faces, count)
        self._stiff = (weights.stiffness * (operator.T @ operator) + ANCHOR * eye_array(count)).tocsr()
        # The matches couple the coordinates of a vertex and are different every time; without that coupling the system
        # is one and the same for all bodies, and its factors precondition conjugate gradients well.
        typical = (self._stiff + TYPICAL_WEIGHT * eye_array(count)).tocsc()
        self._factors = splu(
            typical, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def run(self, vertices: np.ndarray, cloud: Cloud) -> np.ndarray:
        """Move fitted vertices (V, 3), metres, onto a cloud that shows all sides; (V, 3)."""
        weights, count = self._weights, len(vertices)
        matches, offsets = TwoWayCorrespondence(cloud), np.zeros_like(vertices)
        ratio = weights.sigma_end / weights.sigma_start
        for turn in range(weights.iterations):
            sigma = weights.sigma_start * ratio ** (turn / max(weights.iterations - 1, 1))
            drawn = matches.attract(vertices + offsets, self._faces, sigma)
            # The matches either way weigh 1 over all vertices.
            offsets += self._solve(count * drawn.matrix, count * drawn.vector + self._stiff @ offsets)
        return vertices + offsets

    def _solve(self, matrix: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """The step (V, 3) against the gradient (V, 3), for match matrices (V, 3, 3)."""
        shape, size = gradient.shape, gradient.size

        def system(step: np.ndarray) -> np.ndarray:
            moved = step.reshape(shape)
            return np.asarray((np.squeeze(matrix @ moved[:, :, None], axis=2) + self._stiff @ moved).ravel())

        def precondition(residual: np.ndarray) -> np.ndarray:
            return np.asarray(self._factors.solve(np.ascontiguousarray(residual.reshape(shape))).ravel())

        found, _ = cg(
            LinearOperator((size, size), matvec=system, dtype=np.float64),
            -gradient.ravel(),
            rtol=TOLERANCE,
            maxiter=MAX_SOLVER_STEPS,
            M=LinearOperator((size, size), matvec=precondition, dtype=np.float64),
        )
        return np.asarray(found.reshape(shape))
