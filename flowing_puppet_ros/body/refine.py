# SPDX-License-Identifier: Apache-2.0
"""The finish: Gauss-Newton over all parts at once, with one shape for the whole body and matches both ways.

Where the search treats parts one by one, here the unknowns are the rotation, place and deformation of all sixteen parts
and a single vector of intrinsic shape. Matches are renewed at every step and weighted by a Geman-McClure kernel that
narrows from step to step, so that far limbs are first drawn in and the surface is then fitted closely.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.body.correspondence import Cloud, Matches, Quadratic
from flowing_puppet_ros.body.energy import JointTargets
from flowing_puppet_ros.body.joint_prior import JointPrior
from flowing_puppet_ros.body.points import PointSet
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

MAX_COEFFICIENT = 3.5
MAX_TURN = 0.5
# Joints are believed this many times more widely than closest points are.
JOINT_WIDTH = 2.5
# Cloud points that look for a vertex in every step; more make the steps slower and not better.
MATCHED = 3000

# What else draws the body's vertices (V, 3), given the width in metres of the robust kernel at this step.
SurfaceTerm = Callable[[np.ndarray, float], Quadratic]


@dataclass(frozen=True, slots=True, eq=False)
class RefineWeights:
    """Strength of each term against the mean squared distance between surfaces (square metres).

    The priors are much weaker than the spread of the training bodies alone would have them: the surface misses what no
    learned body has by a centimetre, and priors of that weight draw limbs and people to the mean (bodies that the model
    does not know: 2.4 cm instead of 1.5 cm between scans). They only decide where the surface leaves a choice.

    Attributes:
        stitch: mean squared gap of an interface.
        pose: squared pose coefficient.
        shape: squared distance of the shape coefficients to `shape_center`.
        pairwise: half squared Mahalanobis distance of an edge to its Gaussian (Eq. 49).
        sigma_start: first width of the robust kernel, metres.
        sigma_end: last width.
        iterations: steps.
        shape_center: (S,) shape that is expected, standard deviations, such as that of earlier frames; None for 0.
    """

    stitch: float = 0.1
    pose: float = 3e-8
    shape: float = 1e-6
    pairwise: float = 3e-8
    sigma_start: float = 0.10
    sigma_end: float = 0.03
    iterations: int = 25
    shape_center: np.ndarray | None = None


# Parts that hardly hold together follow a dense surface more closely; a start for the finish that closes the gaps.
LOOSE = RefineWeights(stitch=0.01, sigma_start=0.05, sigma_end=0.05, iterations=6)


class Refiner:
    """Gauss-Newton for one model."""

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        parts = range(len(model.tree))
        self._points = [PointSet.of_part(model, part, np.arange(len(model.part_vertices[part]))) for part in parts]
        self._share = 1.0 / np.bincount(np.concatenate(model.part_vertices), minlength=len(model.part_of_vertex))
        self._parents = [parent for parent, _ in model.tree.edges]
        self._prior = [JointPrior(pairwise) for pairwise in model.pairwise]
        self._basis = [np.concatenate([points.pose_basis, points.shape_basis], axis=2) for points in self._points]
        sizes = [6 + points.pose_basis.shape[2] for points in self._points]
        ends = np.cumsum(sizes)
        self._columns = [np.arange(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._shape_columns = ends[-1] + np.arange(model.shape_basis[0].shape[2])
        self._regressor = np.zeros((len(model.joint_names), len(model.part_of_vertex)))
        for row, (index, weight) in enumerate(zip(model.joint_index, model.joint_weight, strict=True)):
            np.add.at(self._regressor[row], index, weight)

    def run(
        self,
        state: BodyState,
        cloud: Cloud | None,
        targets: JointTargets,
        weights: RefineWeights,
        terms: Sequence[SurfaceTerm] = (),
    ) -> BodyState:
        """Refine a body; without a cloud and `terms` only believed joints, stitching and priors count.

        All parts of the result have the same shape coefficients; it starts from their mean.
        """
        state = BodyState(
            state.center.copy(),
            state.rotation.copy(),
            state.pose.copy(),
            np.tile(state.shape.mean(axis=0), (len(state.shape), 1)),
        )
        drawn = list(terms)
        if cloud is not None:
            matches = Matches(cloud, MATCHED)
            drawn.append(lambda vertices, sigma: matches.attract(vertices, self._model.faces, sigma))
        ratio = weights.sigma_end / weights.sigma_start
        for step in range(weights.iterations):
            sigma = weights.sigma_start * ratio ** (step / max(weights.iterations - 1, 1))
            state = self._step(state, drawn, targets, weights, sigma)
        return state

    def _step(
        self,
        state: BodyState,
        terms: Sequence[SurfaceTerm],
        targets: JointTargets,
        weights: RefineWeights,
        sigma: float,
    ) -> BodyState:
        local = [
            points.local(state.pose[part, None, : points.pose_basis.shape[2]], state.shape[part, None])[0]
            for part, points in enumerate(self._points)
        ]
        jacobians = [_jacobian(points, basis) for points, basis in zip(local, self._basis, strict=True)]
        world = [
            points @ rotation.T + center
            for points, rotation, center in zip(local, state.rotation, state.center, strict=True)
        ]
        size = self._shape_columns[-1] + 1
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        vertices = self._merge(world)
        for term in terms:
            self._add_quadratic(term(vertices, sigma), state.rotation, jacobians, hessian, gradient)
        self._add_joints(targets, JOINT_WIDTH * sigma, vertices, state.rotation, jacobians, hessian, gradient)
        self._add_stitching(weights.stitch, world, state.rotation, jacobians, hessian, gradient)
        self._add_priors(state, weights, hessian, gradient)
        hessian[np.diag_indices(size)] += 1e-9 + 1e-3 * hessian.diagonal()
        return self._moved(state, np.linalg.solve(hessian, -gradient))

    def _merge(self, world: list[np.ndarray]) -> np.ndarray:
        """Template vertices (V, 3): the mean of the copies in different parts."""
        vertices = np.zeros((len(self._share), 3))
        for rows, points in zip(self._model.part_vertices, world, strict=True):
            vertices[rows] += points * self._share[rows, None]
        return vertices

    def _block(self, part: int) -> np.ndarray:
        return np.concatenate([self._columns[part], self._shape_columns])

    def _add_quadratic(
        self,
        quadratic: Quadratic,
        rotation: np.ndarray,
        jacobians: list[np.ndarray],
        hessian: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        for part, (turn, jacobian) in enumerate(zip(rotation, jacobians, strict=True)):
            rows = self._model.part_vertices[part]
            share = self._share[rows]
            weighted = _weighted(jacobian, turn, rows, share, quadratic.matrix)
            flat = jacobian.reshape(-1, jacobian.shape[2])
            columns = self._block(part)
            hessian[np.ix_(columns, columns)] += flat.T @ weighted.reshape(flat.shape)
            gradient[columns] += (share[:, None] * quadratic.vector[rows] @ turn).reshape(-1) @ flat

    def _add_joints(
        self,
        targets: JointTargets,
        width: float,
        vertices: np.ndarray,
        rotation: np.ndarray,
        jacobians: list[np.ndarray],
        hessian: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        chosen = np.flatnonzero(targets.weight > 0)
        if not len(chosen):
            return
        gap = self._regressor[chosen] @ vertices - targets.points[chosen]
        trust = (width**2 / (width**2 + (gap**2).sum(axis=1))) ** 2
        rows = np.zeros((len(chosen), 3, len(gradient)))
        for part, jacobian in enumerate(jacobians):
            vertex = self._model.part_vertices[part]
            share = self._regressor[np.ix_(chosen, vertex)] * self._share[vertex]
            rows[:, :, self._block(part)] += rotation[part] @ np.tensordot(share, jacobian, 1)
        flat = rows.reshape(-1, len(gradient))
        weight = np.repeat(trust * targets.weight[chosen], 3)
        hessian += (flat * weight[:, None]).T @ flat
        gradient += flat.T @ (weight * gap.reshape(-1))

    def _add_stitching(
        self,
        strength: float,
        world: list[np.ndarray],
        rotation: np.ndarray,
        jacobians: list[np.ndarray],
        hessian: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        for edge, (parent, child) in enumerate(self._model.tree.edges):
            interface = self._model.interfaces[edge]
            weight = np.repeat(strength * interface.weight / interface.weight.sum(), 3)
            gap = (world[parent][interface.parent_index] - world[child][interface.child_index]).reshape(-1)
            a = (rotation[parent] @ jacobians[parent][interface.parent_index]).reshape(len(gap), -1)
            b = (rotation[child] @ jacobians[child][interface.child_index]).reshape(len(gap), -1)
            shapes = len(self._shape_columns)
            rows = np.concatenate([a[:, :-shapes], -b[:, :-shapes], a[:, -shapes:] - b[:, -shapes:]], axis=1)
            columns = np.concatenate([self._columns[parent], self._columns[child], self._shape_columns])
            hessian[np.ix_(columns, columns)] += (rows * weight[:, None]).T @ rows
            gradient[columns] += rows.T @ (weight * gap)

    def _add_priors(self, state: BodyState, weights: RefineWeights, hessian: np.ndarray, gradient: np.ndarray) -> None:
        for part, columns in enumerate(self._columns):
            hessian[columns[6:], columns[6:]] += weights.pose
            gradient[columns[6:]] += weights.pose * state.pose[part, : len(columns) - 6]
        hessian[self._shape_columns, self._shape_columns] += weights.shape
        expected = 0.0 if weights.shape_center is None else weights.shape_center
        gradient[self._shape_columns] += weights.shape * (state.shape[0] - expected)
        relative = so3.log(state.rotation[self._parents].transpose(0, 2, 1) @ state.rotation[1:])
        for edge, (parent, child) in enumerate(self._model.tree.edges):
            of_parent, of_child = self._columns[parent], self._columns[child]
            block, slope = self._prior[edge].quadratic(
                relative[edge],
                state.pose[parent, : len(of_parent) - 6],
                state.pose[child, : len(of_child) - 6],
            )
            columns = np.concatenate([of_parent[:3], of_child[:3], of_parent[6:], of_child[6:]])
            hessian[np.ix_(columns, columns)] += weights.pairwise * block
            gradient[columns] += weights.pairwise * slope

    def _moved(self, state: BodyState, step: np.ndarray) -> BodyState:
        pose = state.pose.copy()
        rigid = np.stack([step[columns[:6]] for columns in self._columns])
        turn, shift = rigid[:, :3], rigid[:, 3:]
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        turn = turn * np.minimum(1.0, MAX_TURN / np.maximum(angle, 1e-12))
        center = state.center + np.squeeze(state.rotation @ shift[:, :, None], axis=2)
        for part, columns in enumerate(self._columns):
            pose[part, : len(columns) - 6] += step[columns[6:]]
        shape = np.clip(state.shape + step[self._shape_columns], -MAX_COEFFICIENT, MAX_COEFFICIENT)
        pose = np.clip(pose, -MAX_COEFFICIENT, MAX_COEFFICIENT)
        return BodyState(center, state.rotation @ so3.exp(turn), pose, shape)


@njit(cache=True, nogil=True)
def _jacobian(local: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Derivative (N, 3, 6 + D + S) of a part's points in its own frame by turn, shift, pose and shape.

    Turn and shift are along the part's own axes; `basis` (N, 3, D + S) is that of its pose and shape.
    """
    found = np.zeros((len(local), 3, 6 + basis.shape[2]))
    for k in range(len(local)):
        x, y, z = local[k]
        found[k, 0, 1], found[k, 0, 2] = z, -y
        found[k, 1, 0], found[k, 1, 2] = -z, x
        found[k, 2, 0], found[k, 2, 1] = y, -x
        for i in range(3):
            found[k, i, 3 + i] = 1.0
            for column in range(basis.shape[2]):
                found[k, i, 6 + column] = basis[k, i, column]
    return found


@njit(cache=True, nogil=True)
def _weighted(
    jacobian: np.ndarray, rotation: np.ndarray, rows: np.ndarray, share: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """The products share_k R^T A_k R J_k (N, 3, M) of a part's vertices `rows`; A (V, 3, 3) along the world's axes."""
    found = np.empty_like(jacobian)
    for k in range(len(rows)):
        own = share[k] * (rotation.T @ matrix[rows[k]] @ rotation)
        for i in range(3):
            for column in range(jacobian.shape[2]):
                found[k, i, column] = (
                    own[i, 0] * jacobian[k, 0, column]
                    + own[i, 1] * jacobian[k, 1, column]
                    + own[i, 2] * jacobian[k, 2, column]
                )
    return found
