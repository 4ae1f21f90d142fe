# SPDX-License-Identifier: Apache-2.0
"""Energy of a configuration of 2D parts: the negative logarithm of Eq. 5 with the terms of Eq. 10."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.shape import PartShape, rotate
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree


class PairwiseEnergy:
    """Sum over the edges of -log N([z_j, sin, cos, q_ji, t_j, z_i, t_i]; mean, covariance) (Eqs. 5 and 10)."""

    def __init__(
        self,
        tree: PartTree,
        shapes: Sequence[PartShape],
        pairwise: Sequence[Gaussian],
        part_joints: Sequence[Sequence[int]],
    ) -> None:
        """Precompute; `part_joints` are the joint indices of every part: proximal, distal, then any others."""
        self._parent, self._child = np.array(tree.edges).T
        self._bone = np.array([joints[:2] for joints in part_joints])
        shared = [part_joints[i].index(part_joints[j][0]) for i, j in tree.edges]
        rows = [
            len(shapes[i].mean) - shapes[i].joint_count + row for (i, _), row in zip(tree.edges, shared, strict=True)
        ]
        ends = [(shapes[i], row) for (i, _), row in zip(tree.edges, rows, strict=True)]
        starts = [(shapes[j], len(shapes[j].mean) - shapes[j].joint_count) for _, j in tree.edges]
        self._end_mean, self._end_basis = _stack_points(ends)
        self._start_mean, self._start_basis = _stack_points(starts)
        self._mean = np.stack([pair.mean for pair in pairwise])
        factors = np.linalg.cholesky(np.stack([pair.covariance for pair in pairwise]))
        self._whiten = np.linalg.inv(factors)
        volume = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum()
        self._constant = float(volume + 0.5 * self._mean.size * np.log(2 * np.pi))

    def variables(self, joints: Array, coefficients: Array) -> Array:
        """Return the variables (E, 2Z+6) of Eq. 43 for `joints` (J, 2) m and `coefficients` (N, Z); model space."""
        i, j = self._parent, self._child
        ends = joints[self._bone]
        bone, center = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
        length = np.hypot(bone[:, 0], bone[:, 1])
        angle = np.arctan2(bone[:, 1], bone[:, 0])
        sine, cosine = np.sin(angle[j] - angle[i]), np.cos(angle[j] - angle[i])
        step = rotate(center[j] - center[i], -np.sin(angle[i]), np.cos(angle[i]))
        start = self._start_mean + np.einsum("ecz,ez->ec", self._start_basis, coefficients[j])
        end = self._end_mean + np.einsum("ecz,ez->ec", self._end_basis, coefficients[i])
        gap = step + rotate(start, sine, cosine) - end
        return np.column_stack([coefficients[j], sine, cosine, gap, length[j], coefficients[i], length[i]])

    def __call__(self, joints: Array, coefficients: Array) -> float:
        """Return the energy in nats; arguments as in `variables`."""
        deviation = self.variables(joints, coefficients) - self._mean
        whitened = np.einsum("ekl,el->ek", self._whiten, deviation)
        return float(0.5 * (whitened**2).sum() + self._constant)

    def evaluate_batch(self, joints: Array, coefficients: Array, edges: Sequence[int]) -> Array:
        """Return the energies (P,) of some of the `edges`, up to their constant.

        `joints` (P, J, 2) m in model space, `coefficients` (P, N, Z).
        """
        chosen = list(edges)
        i, j = self._parent[chosen], self._child[chosen]
        ends = joints[:, self._bone]
        bone, center = ends[:, :, 1] - ends[:, :, 0], ends.mean(axis=2)
        length = np.hypot(bone[..., 0], bone[..., 1])
        angle = np.arctan2(bone[..., 1], bone[..., 0])
        sine, cosine = np.sin(angle[:, j] - angle[:, i]), np.cos(angle[:, j] - angle[:, i])
        step = rotate(center[:, j] - center[:, i], -np.sin(angle[:, i]), np.cos(angle[:, i]))
        start = self._start_mean[chosen] + np.einsum("ecz,pez->pec", self._start_basis[chosen], coefficients[:, j])
        end = self._end_mean[chosen] + np.einsum("ecz,pez->pec", self._end_basis[chosen], coefficients[:, i])
        gap = step + rotate(start, sine, cosine) - end
        turn, lengths = np.stack([sine, cosine], axis=2), [length[:, k, None] for k in (j, i)]
        variables = np.concatenate([coefficients[:, j], turn, gap, lengths[0], coefficients[:, i], lengths[1]], axis=2)
        whitened = np.einsum("ekl,pel->pek", self._whiten[chosen], variables - self._mean[chosen])
        return np.asarray(0.5 * (whitened**2).sum(axis=(1, 2)))


def _stack_points(rows: Sequence[tuple[PartShape, int]]) -> tuple[Array, Array]:
    """Stack the means (E, 2) and bases (E, 2, Z) of one point of each part."""
    return np.stack([shape.mean[row] for shape, row in rows]), np.stack([shape.basis[row] for shape, row in rows])
