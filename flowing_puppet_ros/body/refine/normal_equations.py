# SPDX-License-Identifier: Apache-2.0
"""The normal equations of the refinement: the terms of surface, stitching and priors over all parts, in compiled loops.

The unknowns are, part after part, increments of rotation and translation, both in the part's own frame, and of its pose
coefficients; then those of the shape coefficients that all parts share. Only the lower triangle of the Hessian is
filled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.body.refine.joint_prior import joint_quadratic
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.posing import PosedPoints
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet, body_points, pose_points

PRIOR_RIDGE = 0.05
"""Standard deviation added to a joint's rotation (radians) and coefficients, which bounds the precision."""

# The points and unknowns of all parts, for compiled loops: basis (M, 3, D + S), numbers of pose coefficients (N,),
# first points (N + 1,), vertices of the points (M,), shares of the vertices (V,), first unknowns (N + 1,).
LayoutArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
# Hessian (U, U), of which the lower triangle is filled, and gradient (U,).
System = tuple[np.ndarray, np.ndarray]


class NormalEquations:
    """The normal equations of one model.

    Attributes:
        first: (N + 1,) the first unknown of every part; the last entry is that of the shape.
        size: U, the number of unknowns.
        share: (V,) one over the number of parts that a vertex belongs to.
        coefficients: for every pose coefficient its unknown, its part, and its number there.
    """

    def __init__(self, model: StitchedPuppet) -> None:
        self._model, self._points = model, body_points(model)
        self.share = self._points.share
        poses, starts = self._points.poses, self._points.starts
        self.first = np.concatenate([[0], np.cumsum(6 + poses)])
        self.size = int(self.first[-1]) + model.shape_count
        self._layout: LayoutArrays = (self._points.basis, poses, starts, self._points.rows, self.share, self.first)
        edges = model.tree.edges
        self._edges = np.array(edges, np.int64).reshape(-1, 2)
        ends = np.cumsum([0, *(len(interface.weight) for interface in model.interfaces)])
        above = [starts[p] + part.parent_index for (p, _), part in zip(edges, model.interfaces, strict=True)]
        below = [starts[c] + part.child_index for (_, c), part in zip(edges, model.interfaces, strict=True)]
        pairs = np.stack([np.concatenate(above), np.concatenate(below)], axis=1).astype(np.int64)
        weight = np.concatenate([interface.weight / interface.weight.sum() for interface in model.interfaces])
        self._stitches = (ends, pairs, weight)
        width = 3 + 2 * poses.max()
        mean, precision = np.zeros((len(edges), width)), np.zeros((len(edges), width, width))
        for edge, gaussian in enumerate(model.pairwise):
            count = len(gaussian.mean)
            covariance = gaussian.covariance + PRIOR_RIDGE**2 * np.eye(count)
            precision[edge, :count, :count] = np.linalg.inv(covariance)
            mean[edge, :count] = gaussian.mean
        self._joint_priors = (mean, precision)
        self.coefficients = (
            np.concatenate([np.arange(start + 6, start + 6 + n) for start, n in zip(self.first, poses, strict=False)]),
            np.repeat(np.arange(len(poses)), poses),
            np.concatenate([np.arange(n) for n in poses]),
        )

    def unknowns(self, part: int) -> np.ndarray:
        """Return the indices of the unknowns that move a part: its own and the shape."""
        own = np.arange(self.first[part], self.first[part + 1])
        return np.concatenate([own, np.arange(self.first[-1], self.size)])

    def pose_points(self, state: BodyState) -> PosedPoints:
        """Return the points of a body."""
        return pose_points(self._model, state)

    def add_surface(self, term: VertexQuadratic, posed: PosedPoints, rotation: np.ndarray, system: System) -> None:
        """Add a quadratic of every vertex for parts with `rotation` (N, 3, 3); a zero matrix costs nothing."""
        _add_surface((term.matrix, term.vector), posed.local, rotation, self._layout, system)

    def add_stitching(self, strength: float, posed: PosedPoints, rotation: np.ndarray, system: System) -> None:
        """Add `strength` times the mean squared gap of every interface (Eq. 48)."""
        points = (posed.local, posed.world)
        _add_stitching(strength, points, rotation, self._edges, self._stitches, self._layout, system)

    def add_joint_prior(self, strength: float, state: BodyState, system: System) -> None:
        """Add half the squared Mahalanobis distance of every edge to its Gaussian (Eq. 49), times `strength`."""
        body = (np.ascontiguousarray(state.rotation), state.pose)
        _add_joint_prior(strength, body, self._joint_priors, self._edges, self._layout, system)


@njit(cache=True, inline="always")
def _fill_jacobian(jacobian, local, basis, k, columns):  # type: ignore[no-untyped-def]
    """Write the derivative (3, 6 + columns) of a point in its part's frame by rotation, translation, coefficients."""
    x, y, z = local[k, 0], local[k, 1], local[k, 2]
    jacobian[:, :6] = 0.0
    jacobian[0, 1], jacobian[0, 2] = z, -y
    jacobian[1, 0], jacobian[1, 2] = -z, x
    jacobian[2, 0], jacobian[2, 1] = y, -x
    for i in range(3):
        jacobian[i, 3 + i] = 1.0
        for column in range(columns):
            jacobian[i, 6 + column] = basis[k, i, column]


@njit(cache=True, nogil=True)
def _add_surface(quadratic, local, rotations, layout, system):  # type: ignore[no-untyped-def]
    matrix, vector = quadratic
    basis, poses, starts, rows, share, first = layout
    shapes = len(system[1]) - first[-1]
    max_width = 6 + basis.shape[2]
    jacobian, weighted = np.empty((3, max_width)), np.empty((3, max_width))
    block, slope = np.empty((max_width, max_width)), np.empty(max_width)
    half, own, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for part in range(len(poses)):
        rotation = rotations[part]
        width = 6 + poses[part] + shapes
        block[:], slope[:] = 0.0, 0.0
        for k in range(starts[part], starts[part + 1]):
            row = rows[k]
            if matrix[row, 0, 0] + matrix[row, 1, 1] + matrix[row, 2, 2] == 0.0:
                continue
            # Written out, because calls for products of matrices this small take longer than the products.
            for i in range(3):
                for j in range(3):
                    half[i, j] = (
                        matrix[row, i, 0] * rotation[0, j]
                        + matrix[row, i, 1] * rotation[1, j]
                        + matrix[row, i, 2] * rotation[2, j]
                    )
            for j in range(3):
                pull[j] = share[row] * (
                    vector[row, 0] * rotation[0, j] + vector[row, 1] * rotation[1, j] + vector[row, 2] * rotation[2, j]
                )
                for i in range(3):
                    own[i, j] = share[row] * (
                        rotation[0, i] * half[0, j] + rotation[1, i] * half[1, j] + rotation[2, i] * half[2, j]
                    )
            _fill_jacobian(jacobian, local, basis, k, width - 6)
            for i in range(3):
                for column in range(width):
                    weighted[i, column] = (
                        own[i, 0] * jacobian[0, column]
                        + own[i, 1] * jacobian[1, column]
                        + own[i, 2] * jacobian[2, column]
                    )
            for column in range(width):
                a, b, c = jacobian[0, column], jacobian[1, column], jacobian[2, column]
                slope[column] += a * pull[0] + b * pull[1] + c * pull[2]
                for other in range(column + 1):
                    block[column, other] += a * weighted[0, other] + b * weighted[1, other] + c * weighted[2, other]
        _scatter(block, slope, width, (first[part], width - shapes, 0, 0, first[-1]), system)


@njit(cache=True, nogil=True)
def _scatter(block, slope, width, spans, system):  # type: ignore[no-untyped-def]
    """Add a lower triangle over the unknowns of one or two parts and the shape to the system.

    `spans` are the first part's first unknown and their number, the second part's, and the shape's first unknown.
    """
    hessian, gradient = system
    for column in range(width):
        row = _find_unknown(column, spans)
        gradient[row] += slope[column]
        for other in range(column + 1):
            hessian[row, _find_unknown(other, spans)] += block[column, other]


@njit(cache=True, inline="always")
def _find_unknown(column, spans):  # type: ignore[no-untyped-def]
    start, count, second_start, second_count, shape_start = spans
    if column < count:
        return start + column
    if column < count + second_count:
        return second_start + column - count
    return shape_start + column - count - second_count


@njit(cache=True, nogil=True)
def _add_stitching(strength, points, rotations, edges, stitches, layout, system):  # type: ignore[no-untyped-def]
    (local, world), (ends, pairs, weights) = points, stitches
    basis, poses, _, _, _, first = layout
    shapes = len(system[1]) - first[-1]
    max_width = 6 + basis.shape[2]
    above, below = np.empty((3, max_width)), np.empty((3, max_width))
    lines, gap = np.empty((3, 2 * max_width)), np.empty(3)
    block, slope = np.empty((2 * max_width, 2 * max_width)), np.empty(2 * max_width)
    for edge in range(len(edges)):
        parent, child = edges[edge, 0], edges[edge, 1]
        up, down = 6 + poses[parent], 6 + poses[child]
        width = up + down + shapes
        block[:], slope[:] = 0.0, 0.0
        for k in range(ends[edge], ends[edge + 1]):
            p, c = pairs[k, 0], pairs[k, 1]
            weight = strength * weights[k]
            _fill_jacobian(above, local, basis, p, up - 6 + shapes)
            _fill_jacobian(below, local, basis, c, down - 6 + shapes)
            for i in range(3):
                for column in range(up + shapes):
                    value = (
                        rotations[parent, i, 0] * above[0, column]
                        + rotations[parent, i, 1] * above[1, column]
                        + rotations[parent, i, 2] * above[2, column]
                    )
                    lines[i, column if column < up else column + down] = value
                for column in range(down + shapes):
                    value = (
                        rotations[child, i, 0] * below[0, column]
                        + rotations[child, i, 1] * below[1, column]
                        + rotations[child, i, 2] * below[2, column]
                    )
                    if column < down:
                        lines[i, up + column] = -value
                    else:
                        lines[i, up + column] -= value
                gap[i] = world[p, i] - world[c, i]
            # The three coordinates together: to read and write the block takes longer than the products.
            for column in range(width):
                a, b, d = weight * lines[0, column], weight * lines[1, column], weight * lines[2, column]
                slope[column] += a * gap[0] + b * gap[1] + d * gap[2]
                for other in range(column + 1):
                    block[column, other] += a * lines[0, other] + b * lines[1, other] + d * lines[2, other]
        _scatter(block, slope, width, (first[parent], up, first[child], down, first[-1]), system)


@njit(cache=True, nogil=True)
def _add_joint_prior(strength, body, priors, edges, layout, system):  # type: ignore[no-untyped-def]
    """Add the priors (means and precisions of the edges) of a body (rotations, pose coefficients)."""
    (rotations, pose), (mean, precision) = body, priors
    _, poses, _, _, _, first = layout
    hessian, gradient = system
    rows = np.empty(6 + precision.shape[1], np.int64)
    for edge in range(len(edges)):
        parent, child = edges[edge, 0], edges[edge, 1]
        up, down = poses[parent], poses[child]
        count = 3 + up + down
        deviation = np.empty(count)
        relative = so3.log_one(np.ascontiguousarray(rotations[parent].T) @ rotations[child])
        deviation[:3] = relative
        deviation[3 : 3 + up] = pose[parent, :up]
        deviation[3 + up :] = pose[child, :down]
        deviation -= mean[edge, :count]
        block, slope = joint_quadratic(relative, deviation, np.ascontiguousarray(precision[edge, :count, :count]))
        for k in range(3):
            rows[k], rows[3 + k] = first[parent] + k, first[child] + k
        for k in range(up):
            rows[6 + k] = first[parent] + 6 + k
        for k in range(down):
            rows[6 + up + k] = first[child] + 6 + k
        for k in range(count + 3):
            gradient[rows[k]] += strength * slope[k]
            for other in range(count + 3):
                if rows[other] <= rows[k]:
                    hessian[rows[k], rows[other]] += strength * block[k, other]
