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
from scipy.linalg import solve

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence, VertexQuadratic
from flowing_puppet_ros.body.refine.normal_equations import NormalEquations, PosedPoints
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

MAX_COEFFICIENT = 3.5
MAX_TURN = 0.5
# Joints are believed this many times more widely than closest points are.
JOINT_WIDTH = 2.5
# Cloud points that look for a vertex in every step; more make the steps slower and not better.
MATCHED = 3000

# What else draws the body's vertices (V, 3), given the width in metres of the robust kernel at this step.
SurfaceTerm = Callable[[np.ndarray, float], VertexQuadratic]


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


class GaussNewton:
    """Gauss-Newton for one model."""

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        self._equations = NormalEquations(model)
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
            matches = TwoWayCorrespondence(cloud, MATCHED)
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
        equations = self._equations
        placed = equations.placed(state)
        hessian, gradient = np.zeros((equations.size, equations.size)), np.zeros(equations.size)
        for term in terms:
            drawn = term(placed.vertices, sigma)
            equations.add_surface(drawn.matrix, drawn.vector, placed, state.rotation, hessian, gradient)
        self._add_joints(targets, JOINT_WIDTH * sigma, placed, state.rotation, hessian, gradient)
        equations.add_stitching(weights.stitch, placed, state.rotation, hessian, gradient)
        equations.add_joint_prior(weights.pairwise, state, hessian, gradient)
        self._add_priors(state, weights, hessian, gradient)
        hessian[np.diag_indices(equations.size)] += 1e-9 + 1e-3 * hessian.diagonal()
        return self._retract(state, solve(hessian, -gradient, lower=True, assume_a="pos", overwrite_a=True))

    def _add_joints(
        self,
        targets: JointTargets,
        width: float,
        placed: PosedPoints,
        turns: np.ndarray,
        hessian: np.ndarray,
        gradient: np.ndarray,
    ) -> None:
        chosen = np.flatnonzero(targets.weight > 0)
        if not len(chosen):
            return
        gap = self._regressor[chosen] @ placed.vertices - targets.points[chosen]
        trust = (width**2 / (width**2 + (gap**2).sum(axis=1))) ** 2
        rows = np.zeros((len(chosen), 3, len(gradient)))
        for part, jacobian in enumerate(self._equations.jacobians(placed)):
            vertex = self._model.part_vertices[part]
            share = self._regressor[np.ix_(chosen, vertex)] * self._equations.share[vertex]
            rows[:, :, self._equations.unknowns(part)] += turns[part] @ np.tensordot(share, jacobian, 1)
        flat = rows.reshape(-1, len(gradient))
        weight = np.repeat(trust * targets.weight[chosen], 3)
        hessian += (flat * weight[:, None]).T @ flat
        gradient += flat.T @ (weight * gap.reshape(-1))

    def _add_priors(self, state: BodyState, weights: RefineWeights, hessian: np.ndarray, gradient: np.ndarray) -> None:
        rows, parts, numbers = self._equations.coefficients
        hessian[rows, rows] += weights.pose
        gradient[rows] += weights.pose * state.pose[parts, numbers]
        shape = np.arange(self._equations.first[-1], self._equations.size)
        hessian[shape, shape] += weights.shape
        expected = 0.0 if weights.shape_center is None else weights.shape_center
        gradient[shape] += weights.shape * (state.shape[0] - expected)

    def _retract(self, state: BodyState, step: np.ndarray) -> BodyState:
        first, (rows, parts, numbers) = self._equations.first, self._equations.coefficients
        pose = state.pose.copy()
        rigid = step[first[:-1, None] + np.arange(6)]
        turn, shift = rigid[:, :3], rigid[:, 3:]
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        turn = turn * np.minimum(1.0, MAX_TURN / np.maximum(angle, 1e-12))
        center = state.center + np.squeeze(state.rotation @ shift[:, :, None], axis=2)
        pose[parts, numbers] += step[rows]
        shape = np.clip(state.shape + step[first[-1] :], -MAX_COEFFICIENT, MAX_COEFFICIENT)
        pose = np.clip(pose, -MAX_COEFFICIENT, MAX_COEFFICIENT)
        return BodyState(center, state.rotation @ so3.exp(turn), pose, shape)
