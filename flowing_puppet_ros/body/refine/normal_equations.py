# SPDX-License-Identifier: Apache-2.0
"""The normal equations of the finish: what surface, stitching and priors say of all parts, in compiled loops.

The unknowns are, part after part, an increment of turn and of place, both along the part's own axes, and of its pose
coefficients; then one of the shape coefficients that all parts share. Only the lower triangle of the matrix is filled.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from flowing_puppet_ros.body.refine.joint_prior import joint_quadratic
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

PRIOR_RIDGE = 0.05
"""Added to the spread of a joint's rotation (radians) and coefficients: a bounded precision."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedPoints:
    """A body's points: (M, 3) of all parts one after the other in their own frames and in the world, metres.

    `vertices` (V, 3) are the template's, the mean of the copies in different parts.
    """

    local: np.ndarray
    world: np.ndarray
    vertices: np.ndarray


class NormalEquations:
    """Of one model.

    Attributes:
        first: (N + 1,) the first unknown of every part; the last entry is that of the shape.
        size: number of unknowns.
        basis: (M, 3, D + S) pose and then shape basis of the parts' points, zero beyond a part's own.
        share: (V,) one over the number of parts that a vertex belongs to.
    """

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        poses = np.array([model.pose_count(part) for part in range(len(model.tree))])
        self._starts = np.concatenate([[0], np.cumsum([len(rows) for rows in model.part_vertices])])
        self._rows = np.concatenate(model.part_vertices).astype(np.int64)
        self.share = 1.0 / np.bincount(self._rows, minlength=len(model.part_of_vertex))
        self._mean = np.concatenate([model.mean_shape[i] + model.mean_pose[i] for i in range(len(poses))])
        self.basis = np.zeros((len(self._rows), 3, poses.max() + model.shape_count))
        for part, count in enumerate(poses):
            own = self.basis[self._starts[part] : self._starts[part + 1]]
            own[:, :, :count], own[:, :, count : count + model.shape_count] = (
                model.pose_basis[part], model.shape_basis[part],
            )  # fmt: skip
        self._poses = poses
        self.first = np.concatenate([[0], np.cumsum(6 + poses)])
        self.size = int(self.first[-1]) + model.shape_count
        edges = model.tree.edges
        self._edges = np.array(edges, np.int64).reshape(-1, 2)
        ends = np.cumsum([0, *(len(interface.weight) for interface in model.interfaces)])
        above = [self._starts[p] + part.parent_index for (p, _), part in zip(edges, model.interfaces, strict=True)]
        below = [self._starts[c] + part.child_index for (_, c), part in zip(edges, model.interfaces, strict=True)]
        pairs = np.stack([np.concatenate(above), np.concatenate(below)], axis=1).astype(np.int64)
        weight = np.concatenate([interface.weight / interface.weight.sum() for interface in model.interfaces])
        self._stitches = (ends, pairs, weight)
        width = 3 + 2 * poses.max()
        self._precision, self._expected = np.zeros((len(edges), width, width)), np.zeros((len(edges), width))
        for edge, gaussian in enumerate(model.pairwise):
            count = len(gaussian.mean)
            spread = gaussian.covariance + PRIOR_RIDGE**2 * np.eye(count)
            self._precision[edge, :count, :count] = np.linalg.inv(spread)
            self._expected[edge, :count] = gaussian.mean

        # Of every pose coefficient: its unknown, its part, and its number there.
        self.coefficients = (
            np.concatenate([np.arange(start + 6, start + 6 + n) for start, n in zip(self.first, poses, strict=False)]),
            np.repeat(np.arange(len(poses)), poses),
            np.concatenate([np.arange(n) for n in poses]),
        )

    def unknowns(self, part: int) -> np.ndarray:
        """The unknowns that move a part: its own and the shape."""
        own = np.arange(self.first[part], self.first[part + 1])
        return np.concatenate([own, np.arange(self.first[-1], self.size)])

    def jacobians(self, placed: PosedPoints) -> list[np.ndarray]:
        """Per part the derivatives (N_i, 3, unknowns) of its points in its own frame."""
        shapes, made = self.size - int(self.first[-1]), []
        for part, (start, end) in enumerate(pairwise(self._starts)):
            jacobian = np.empty((end - start, 3, 6 + self._poses[part] + shapes))
            _fill_jacobians(jacobian, placed.local[start:end], self.basis[start:end])
            made.append(jacobian)
        return made

    def placed(self, state: BodyState) -> PosedPoints:
        """Where the points of a body are; its shape is that of the first part."""
        body = (state.center, state.rotation, state.pose, state.shape[0])
        return PosedPoints(
            *_pose_points(*body, self._mean, self.basis, self._poses, self._starts, self._rows, self.share)
        )

    def add_surface(
        self,
        matrix: np.ndarray,
        vector: np.ndarray,
        placed: PosedPoints,
        turns: np.ndarray,
        hessian: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        """Add a quadratic of every vertex, see `correspondence.Quadratic`; `turns` (N, 3, 3) are the parts' rotations.

        A vertex without one costs nothing.
        """
        _add_surface(
            matrix, vector, placed.local, turns, self.basis, self._poses, self._starts, self._rows, self.share,
            self.first, hessian, gradient,
        )  # fmt: skip

    def add_stitching(
        self, strength: float, placed: PosedPoints, turns: np.ndarray, hessian: np.ndarray, gradient: np.ndarray
    ) -> None:
        """Add `strength` times the mean squared gap of every interface (Eq. 48)."""
        _add_stitching(
            strength, placed.local, placed.world, turns, self.basis, self._poses, self._edges, self._stitches,
            self.first, hessian, gradient,
        )  # fmt: skip

    def add_joint_prior(self, strength: float, state: BodyState, hessian: np.ndarray, gradient: np.ndarray) -> None:
        """Add half the squared Mahalanobis distance of every edge to its Gaussian (Eq. 49), times `strength`."""
        parents, children = self._edges[:, 0], self._edges[:, 1]
        relative = so3.log(state.rotation[parents].transpose(0, 2, 1) @ state.rotation[children])
        _add_joint_prior(
            strength, relative, state.pose, self._expected, self._precision, self._poses, self._edges, self.first,
            hessian, gradient,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _pose_points(  # type: ignore[no-untyped-def]
    center, turns, pose, shape, mean, basis, poses, starts, rows, share
):
    local, world = np.empty_like(mean), np.empty_like(mean)
    vertices = np.zeros((len(share), 3))
    amounts = np.zeros(basis.shape[2])
    for part in range(len(poses)):
        used = poses[part] + len(shape)
        amounts[: poses[part]] = pose[part, : poses[part]]
        amounts[poses[part] : used] = shape
        for k in range(starts[part], starts[part + 1]):
            for i in range(3):
                total = mean[k, i]
                for column in range(used):
                    total += basis[k, i, column] * amounts[column]
                local[k, i] = total
            row = rows[k]
            for i in range(3):
                world[k, i] = center[part, i] + (
                    turns[part, i, 0] * local[k, 0] + turns[part, i, 1] * local[k, 1] + turns[part, i, 2] * local[k, 2]
                )
                vertices[row, i] += share[row] * world[k, i]
    return local, world, vertices


@njit(cache=True, inline="always")
def _fill_jacobian(jacobian, local, basis, k, columns):  # type: ignore[no-untyped-def]
    """Write the derivative (3, 6 + columns) of a point in its part's frame by turn, place and coefficients."""
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
def _fill_jacobians(jacobians, local, basis):  # type: ignore[no-untyped-def]
    for k in range(len(local)):
        _fill_jacobian(jacobians[k], local, basis, k, jacobians.shape[2] - 6)


@njit(cache=True, nogil=True)
def _add_surface(  # type: ignore[no-untyped-def]
    matrix, vector, local, turns, basis, poses, starts, rows, share, first, hessian, gradient
):
    shapes = len(gradient) - first[-1]
    most = 6 + basis.shape[2]
    jacobian, weighted = np.empty((3, most)), np.empty((3, most))
    block, slope = np.empty((most, most)), np.empty(most)
    half, own, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for part in range(len(poses)):
        turn = turns[part]
        width = 6 + poses[part] + shapes
        block[:], slope[:] = 0.0, 0.0
        for k in range(starts[part], starts[part + 1]):
            row = rows[k]
            if matrix[row, 0, 0] + matrix[row, 1, 1] + matrix[row, 2, 2] == 0.0:
                continue
            # Products of matrices this small take longer to call than to write out.
            for i in range(3):
                for j in range(3):
                    half[i, j] = (
                        matrix[row, i, 0] * turn[0, j] + matrix[row, i, 1] * turn[1, j] + matrix[row, i, 2] * turn[2, j]
                    )
            for j in range(3):
                pull[j] = share[row] * (
                    vector[row, 0] * turn[0, j] + vector[row, 1] * turn[1, j] + vector[row, 2] * turn[2, j]
                )
                for i in range(3):
                    own[i, j] = share[row] * (
                        turn[0, i] * half[0, j] + turn[1, i] * half[1, j] + turn[2, i] * half[2, j]
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
        _scatter(block, slope, width, first[part], width - shapes, 0, 0, first[-1], hessian, gradient)


@njit(cache=True, nogil=True)
def _scatter(  # type: ignore[no-untyped-def]
    block, slope, width, start, count, second_start, second_count, shape_start, hessian, gradient
):
    """Add a lower triangle over one or two parts' unknowns and the shape where it belongs."""
    for column in range(width):
        to = _place(column, start, count, second_start, second_count, shape_start)
        gradient[to] += slope[column]
        for other in range(column + 1):
            hessian[to, _place(other, start, count, second_start, second_count, shape_start)] += block[column, other]


@njit(cache=True, inline="always")
def _place(column, start, count, second_start, second_count, shape_start):  # type: ignore[no-untyped-def]
    if column < count:
        return start + column
    if column < count + second_count:
        return second_start + column - count
    return shape_start + column - count - second_count


@njit(cache=True, nogil=True)
def _add_stitching(  # type: ignore[no-untyped-def]
    strength, local, world, turns, basis, poses, edges, stitches, first, hessian, gradient
):
    ends, pairs, weights = stitches
    shapes = len(gradient) - first[-1]
    most = 6 + basis.shape[2]
    above, below = np.empty((3, most)), np.empty((3, most))
    line = np.empty(2 * most)
    block, slope = np.empty((2 * most, 2 * most)), np.empty(2 * most)
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
                        turns[parent, i, 0] * above[0, column]
                        + turns[parent, i, 1] * above[1, column]
                        + turns[parent, i, 2] * above[2, column]
                    )
                    line[column if column < up else column + down] = value
                for column in range(down + shapes):
                    value = (
                        turns[child, i, 0] * below[0, column]
                        + turns[child, i, 1] * below[1, column]
                        + turns[child, i, 2] * below[2, column]
                    )
                    if column < down:
                        line[up + column] = -value
                    else:
                        line[up + column] -= value
                gap = weight * (world[p, i] - world[c, i])
                for column in range(width):
                    slope[column] += line[column] * gap
                    scaled = weight * line[column]
                    for other in range(column + 1):
                        block[column, other] += scaled * line[other]
        _scatter(block, slope, width, first[parent], up, first[child], down, first[-1], hessian, gradient)


@njit(cache=True, nogil=True)
def _add_joint_prior(  # type: ignore[no-untyped-def]
    strength, relative, pose, expected, precision, poses, edges, first, hessian, gradient
):
    most = 6 + precision.shape[1]
    to = np.empty(most, np.int64)
    for edge in range(len(edges)):
        parent, child = edges[edge, 0], edges[edge, 1]
        up, down = poses[parent], poses[child]
        count = 3 + up + down
        deviation = np.empty(count)
        deviation[:3] = relative[edge]
        deviation[3 : 3 + up] = pose[parent, :up]
        deviation[3 + up :] = pose[child, :down]
        deviation -= expected[edge, :count]
        block, slope = joint_quadratic(relative[edge], deviation, np.ascontiguousarray(precision[edge, :count, :count]))
        for k in range(3):
            to[k], to[3 + k] = first[parent] + k, first[child] + k
        for k in range(up):
            to[6 + k] = first[parent] + 6 + k
        for k in range(down):
            to[6 + up + k] = first[child] + 6 + k
        for k in range(count + 3):
            gradient[to[k]] += strength * slope[k]
            for other in range(count + 3):
                if to[other] <= to[k]:
                    hessian[to[k], to[other]] += strength * block[k, other]
