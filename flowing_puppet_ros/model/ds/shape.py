# SPDX-License-Identifier: Apache-2.0
"""Shape of the parts of a 2D puppet: linear contour models, bone frames, and shape inference from joints.

Equations are the thesis's: 6 and 7 (shape of a part), 23 to 30 (belief propagation of shape given joints).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree

View = Literal["front", "back"]

JOINT_NOISE = 0.003
"""Standard deviation, in metres, with which a part's own joint points constrain its shape coefficients."""

COEFFICIENT_LIMIT = 3.0
"""Standard deviations within which shape coefficients, which have unit variance, are kept."""


@dataclass(frozen=True, slots=True, eq=False)
class PuppetShape:
    """One instance of a Deformable Structures puppet.

    `joints` (J, 2) and `contours` (K_i, 2) per part are in pixels (in metres of model space if `scale` is 1).
    `coefficients` (Z,) per part have unit prior variance, `scale` is in px/m, and `view` is the side the camera sees.
    """

    joints: Array
    contours: tuple[Array, ...]
    coefficients: tuple[Array, ...]
    scale: float
    view: View


@dataclass(frozen=True, slots=True, eq=False)
class PartShape:
    """Linear model of one part in its bone frame (Eq. 6): `mean` (K+M, 2) m, `basis` (K+M, 2, Z) m.

    K contour points come first, then the part's M joint points: proximal, distal, then any others. The basis is scaled
    so that the coefficients have unit variance.
    """

    mean: Array
    basis: Array
    joint_count: int

    def points(self, coefficients: Array) -> Array:
        """Return all points (K+M, 2) for `coefficients` (Z,) in the bone frame (Eq. 6)."""
        return np.asarray(self.mean + self.basis @ coefficients)

    def contour(self, coefficients: Array) -> Array:
        """Return the contour points (K, 2) for `coefficients` (Z,) in the bone frame."""
        return self.points(coefficients)[: -self.joint_count]

    def joints(self, coefficients: Array) -> Array:
        """Return the joint points (M, 2) for `coefficients` (Z,) in the bone frame."""
        return self.points(coefficients)[-self.joint_count :]


@dataclass(frozen=True, slots=True)
class PairLayout:
    """Indices of the variables of the pairwise Gaussian of Eq. 10: [z_j, sin, cos, q_ji (2), t_j, z_i, t_i]."""

    size: int

    @property
    def child(self) -> list[int]:
        """Shape coefficients z_j of the child."""
        return list(range(self.size))

    @property
    def angle(self) -> list[int]:
        """Sine and cosine of the child's angle relative to the parent."""
        return [self.size, self.size + 1]

    @property
    def gap(self) -> list[int]:
        """Distance q_ji from the parent's joint point to the child's, in the parent's bone frame."""
        return [self.size + 2, self.size + 3]

    @property
    def child_length(self) -> list[int]:
        """Bone length t_j of the child."""
        return [self.size + 4]

    @property
    def parent(self) -> list[int]:
        """Shape coefficients z_i of the parent."""
        return list(range(self.size + 5, 2 * self.size + 5))

    @property
    def parent_length(self) -> list[int]:
        """Bone length t_i of the parent."""
        return [2 * self.size + 5]


def rotate(points: Array, sine: float | Array, cosine: float | Array) -> Array:
    """Rotate `points` (..., 2) from image x towards image y."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def shape_posterior(
    tree: PartTree, shapes: Sequence[PartShape], pairwise: Sequence[Gaussian], noise: float = JOINT_NOISE
) -> tuple[Array, Array]:
    """Belief propagation of Eqs. 23-30 for every observation at once.

    All factors are Gaussian, so precisions do not depend on what is observed and the believed coefficients are an
    affine function of it. Information vectors are therefore carried as matrices that act on [observation, 1].
    The likelihood of a part's joint points is N(y_i; B z_i + m, noise^2) (the thesis sets its covariance by hand).
    The pairwise densities are used as p(z_j, sin, cos, t_j | z_i), so that their product counts each part once.

    The observation stacks, part by part, the joint points y_i in the bone frame (x, y each), then, edge by edge,
    (sin, cos, t_j). Returns `gain` (N*Z, D) and `offset` (N*Z,): posterior means are `gain @ observation + offset`.
    """
    size = shapes[0].basis.shape[2]
    counts = [2 * shape.joint_count for shape in shapes]
    width = sum(counts) + 3 * len(pairwise) + 1
    precision = np.zeros((len(tree), size, size))
    information = np.zeros((len(tree), size, width))
    precision[0] = np.eye(size)
    for part, shape in enumerate(shapes):
        start = sum(counts[:part])
        basis = shape.basis[-shape.joint_count :].reshape(-1, size)
        precision[part] += basis.T @ basis / noise**2
        information[part, :, start : start + counts[part]] = basis.T / noise**2
        information[part, :, -1] -= basis.T @ shape.mean[-shape.joint_count :].ravel() / noise**2
    factors = [_edge_factor(pair, size, sum(counts) + 3 * e, width) for e, pair in enumerate(pairwise)]
    return _propagate_beliefs(tree, precision, information, factors)


@dataclass(frozen=True, slots=True, eq=False)
class _EdgeFactor:
    """log phi(z_i, z_j) = -1/2 [z_i; z_j]' [[ii, ij], [ij', jj]] [z_i; z_j] + [z_i; z_j]' [parent; child] [o; 1]."""

    ii: Array
    ij: Array
    jj: Array
    parent: Array
    child: Array


def _edge_factor(pair: Gaussian, size: int, start: int, width: int) -> _EdgeFactor:
    """Return the pairwise term of Eq. 23 as precisions and information vectors (Eqs. 28 and 30)."""
    layout = PairLayout(size)
    outcome = layout.child + layout.angle + layout.child_length
    joint = pair.marginal(outcome + layout.parent)
    a, b = slice(0, size + 3), slice(size + 3, None)
    slope = np.linalg.solve(joint.covariance[b, b], joint.covariance[b, a]).T
    weight = np.linalg.inv(joint.covariance[a, a] - slope @ joint.covariance[b, a])
    residual = np.zeros((size + 3, width))
    residual[:, -1] = joint.mean[a] - slope @ joint.mean[b]
    residual[size:, start : start + 3] = -np.eye(3)
    return _EdgeFactor(
        ii=slope.T @ weight @ slope,
        ij=-(slope.T @ weight)[:, :size],
        jj=weight[:size, :size],
        parent=-slope.T @ weight @ residual,
        child=weight[:size] @ residual,
    )


def _propagate_beliefs(
    tree: PartTree, precision: Array, information: Array, factors: Sequence[_EdgeFactor]
) -> tuple[Array, Array]:
    """Pass messages (Eqs. 23 and 24) up and down in information form; return the map to the means (Eqs. 25-27, 29)."""
    upward_precision, upward_information = precision.copy(), information.copy()
    message: dict[int, tuple[Array, Array]] = {}
    for parent, child in reversed(tree.edges):
        factor = factors[child - 1]
        inner = np.linalg.inv(upward_precision[child] + factor.jj)
        own = factor.ij @ inner
        message[child] = (
            factor.ii - own @ factor.ij.T,
            factor.parent - own @ (upward_information[child] + factor.child),
        )
        upward_precision[parent] += message[child][0]
        upward_information[parent] += message[child][1]
    belief_precision, belief_information = upward_precision.copy(), upward_information.copy()
    for parent, child in tree.edges:
        factor = factors[child - 1]
        without = belief_precision[parent] - message[child][0]
        inner = np.linalg.inv(without + factor.ii)
        own = factor.ij.T @ inner
        rest = belief_information[parent] - message[child][1] + factor.parent
        belief_precision[child] = upward_precision[child] + factor.jj - own @ factor.ij
        belief_information[child] = upward_information[child] + factor.child - own @ rest
    means = np.linalg.solve(belief_precision, belief_information).reshape(-1, information.shape[2])
    return np.ascontiguousarray(means[:, :-1]), np.ascontiguousarray(means[:, -1])
