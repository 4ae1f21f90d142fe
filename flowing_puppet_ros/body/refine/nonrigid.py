# SPDX-License-Identifier: Apache-2.0
"""The non-rigid refinement: every vertex of a fitted body moves onto the cloud, held by its neighbours.

The fit of the parts leaves what no pose and no learned shape can express, such as a belly, a face or a fist. Here the
unknowns are free offsets of all vertices. They are attracted by `TwoWayCorrespondence` and held together by the squared
differences between every offset and the mean of its neighbours' (the umbrella operator of Kobbelt et al., SIGGRAPH
1998), which lets smooth corrections pass and resists wrinkles.
"""

from __future__ import annotations

from dataclasses import dataclass
from inspect import signature

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import LinearOperator, cg, splu

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence

# Weight of the squared offsets: where the cloud gives no evidence, nothing moves.
ANCHOR_WEIGHT = 0.01
# Mean weight of the correspondences in the preconditioner; the solution does not depend on it.
TYPICAL_WEIGHT = 0.45
SOLVER_TOLERANCE = 1e-3  # relative residual of conjugate gradients
MAX_SOLVER_STEPS = 60  # of conjugate gradients
_RELATIVE_TOLERANCE = "rtol" if "rtol" in signature(cg).parameters else "tol"  # its name before SciPy 1.12


@dataclass(frozen=True, slots=True)
class NonRigidWeights:
    """How far and how stiffly vertices move.

    Attributes:
        stiffness: weight of the squared umbrella differences of the offsets; correspondences weigh about 2 per vertex.
        sigma_start: first width of the robust kernel, metres.
        sigma_end: last width of the robust kernel, metres.
        iterations: rounds of matching and solving.
    """

    stiffness: float = 50.0
    sigma_start: float = 0.03
    sigma_end: float = 0.015
    iterations: int = 6


def umbrella_laplacian(faces: np.ndarray, count: int) -> csr_matrix:
    """Return the operator (V, V) that subtracts from every vertex's value the mean of its neighbours along edges."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    degree = np.bincount(edges[:, 0], minlength=count)
    linked = coo_matrix((1 / degree[edges[:, 0]], edges.T), shape=(count, count))
    return (diags((degree > 0).astype(float)) - linked).tocsr()


class NonRigidRefinement:
    """The non-rigid refinement of meshes of one topology; what depends on the topology alone is computed once."""

    def __init__(self, faces: np.ndarray, count: int, weights: NonRigidWeights) -> None:
        self._faces = faces
        self._weights = weights
        operator = umbrella_laplacian(faces, count)
        self._stiff = (weights.stiffness * (operator.T @ operator) + ANCHOR_WEIGHT * identity(count)).tocsr()
        # Correspondences couple the coordinates of a vertex and change every time; without that coupling the system is
        # the same for all bodies, and its factors are a good preconditioner for conjugate gradients.
        typical = (self._stiff + TYPICAL_WEIGHT * identity(count)).tocsc()
        self._factors = splu(
            typical, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def run(self, vertices: np.ndarray, cloud: Cloud) -> np.ndarray:
        """Return fitted vertices (V, 3) in metres moved onto a cloud seen from all sides."""
        weights, count = self._weights, len(vertices)
        matches, offsets = TwoWayCorrespondence(cloud), np.zeros_like(vertices)
        ratio = weights.sigma_end / weights.sigma_start
        for step in range(weights.iterations):
            sigma = weights.sigma_start * ratio ** (step / max(weights.iterations - 1, 1))
            term = matches.attract(vertices + offsets, self._faces, sigma)
            # Each direction of the correspondences has a total weight of 1.
            offsets += self._solve(count * term.matrix, count * term.vector + self._stiff @ offsets)
        return vertices + offsets

    def _solve(self, matrix: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the step (V, 3) against the gradient (V, 3), for matrices (V, 3, 3) of the correspondences."""
        shape, size = gradient.shape, gradient.size

        def multiply(step: np.ndarray) -> np.ndarray:
            offset = step.reshape(shape)
            return np.asarray((np.squeeze(matrix @ offset[:, :, None], axis=2) + self._stiff @ offset).ravel())

        def precondition(residual: np.ndarray) -> np.ndarray:
            return np.asarray(self._factors.solve(np.ascontiguousarray(residual.reshape(shape))).ravel())

        solution, _ = cg(
            LinearOperator((size, size), matvec=multiply, dtype=np.float64),
            -gradient.ravel(),
            atol=0.0,
            maxiter=MAX_SOLVER_STEPS,
            M=LinearOperator((size, size), matvec=precondition, dtype=np.float64),
            **{_RELATIVE_TOLERANCE: SOLVER_TOLERANCE},
        )
        return np.asarray(solution.reshape(shape))
