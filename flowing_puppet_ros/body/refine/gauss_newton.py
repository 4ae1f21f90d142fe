# SPDX-License-Identifier: Apache-2.0
"""The refinement: Gauss-Newton over all parts at once, with one shape for the whole body and two-way correspondences.

The search treats the parts one by one; here the unknowns are the rotation, translation and deformation of all sixteen
parts and a single vector of intrinsic shape. Correspondences are renewed at every step and weighted by a Geman-McClure
kernel that narrows from step to step, so that distant limbs are attracted first and then the surface is fitted closely.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numba import njit

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence, VertexQuadratic, geman_mcclure
from flowing_puppet_ros.body.refine.joint_rows import JointRows
from flowing_puppet_ros.body.refine.normal_equations import NormalEquations, System
from flowing_puppet_ros.body.refine.tree_solution import TreeSolution
from flowing_puppet_ros.body.search.energy import RAY_SHARE, JointTargets
from flowing_puppet_ros.model.posing import PosedPoints
from flowing_puppet_ros.model.rotation import exp_one
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

MAX_COEFFICIENT = 3.5  # standard deviations
MAX_ROTATION_STEP_RAD = 0.5  # of each part
# Width of the robust kernel of joint targets, in widths of that of closest points.
JOINT_WIDTH_FACTOR = 2.5
# Cloud points that are matched to a vertex in every step; more make the steps slower and not better.
MAX_MATCHED_POINTS = 3000

# A further term on the body's vertices (V, 3), given the width of the robust kernel in metres at this step.
SurfaceTerm = Callable[[np.ndarray, float], VertexQuadratic]


@dataclass(frozen=True, slots=True, eq=False)
class RefineWeights:
    """Strength of each term against the mean squared distance between surfaces (square metres).

    The priors are much weaker than the spread of the training bodies suggests. The model cannot express about 1 cm of
    real surface, so priors at their learned weight would pull limbs and people towards the mean (2.4 cm instead of
    1.5 cm between scans of bodies that the model does not know). They only decide where the surface leaves a choice.

    Attributes:
        stitch: weight of the mean squared gap of an interface.
        pose: weight of a squared pose coefficient.
        shape: weight of the squared distance of the shape coefficients to `shape_center`.
        pairwise: weight of half the squared Mahalanobis distance of an edge to its Gaussian (Eq. 49).
        sigma_start: first width of the robust kernel, metres.
        sigma_end: last width of the robust kernel, metres.
        iterations: number of steps.
        alternate: sets that vertices and matched cloud points are divided into; a step asks one set for its matches.
        shape_center: (S,) expected shape in standard deviations, such as that of earlier frames; None for 0.
    """

    stitch: float = 0.1
    pose: float = 3e-8
    shape: float = 1e-6
    pairwise: float = 3e-8
    sigma_start: float = 0.10
    sigma_end: float = 0.03
    iterations: int = 25
    alternate: int = 1
    shape_center: np.ndarray | None = None


# Loosely stitched parts follow a dense surface more closely; the non-rigid refinement then closes the gaps.
LOOSE_STITCHING = RefineWeights(stitch=0.01, sigma_start=0.05, sigma_end=0.05, iterations=6)


class GaussNewton:
    """Gauss-Newton over all parts of one model."""

    def __init__(self, model: StitchedPuppet) -> None:
        self._model = model
        self._equations = NormalEquations(model)
        self._joints = JointRows(model, self._equations)
        self._solution = TreeSolution(model.tree.parents, self._equations.first)

    def run(
        self,
        state: BodyState,
        cloud: Cloud | None,
        targets: JointTargets,
        weights: RefineWeights,
        terms: Sequence[SurfaceTerm] = (),
    ) -> BodyState:
        """Refine a body; without a cloud and `terms` only joint targets, stitching and priors count.

        All parts of the result have the same shape coefficients, at first the mean of the body's.
        """
        state = BodyState(
            state.center.copy(),
            state.rotation.copy(),
            state.pose.copy(),
            np.tile(state.shape.mean(axis=0), (len(state.shape), 1)),
        )
        matches = None if cloud is None else TwoWayCorrespondence(cloud, MAX_MATCHED_POINTS, weights.alternate)
        ratio = weights.sigma_end / weights.sigma_start
        for step in range(weights.iterations):
            sigma = weights.sigma_start * ratio ** (step / max(weights.iterations - 1, 1))
            turns = [] if matches is None else [partial(self._attract, matches, step)]
            state = self._step(state, [*terms, *turns], targets, weights, sigma)
        return state

    def _attract(self, matches: TwoWayCorrespondence, turn: int, vertices: np.ndarray, sigma: float) -> VertexQuadratic:
        return matches.attract(vertices, self._model.faces, sigma, turn)

    def _step(
        self,
        state: BodyState,
        terms: Sequence[SurfaceTerm],
        targets: JointTargets,
        weights: RefineWeights,
        sigma: float,
    ) -> BodyState:
        equations = self._equations
        posed = equations.pose_points(state)
        hessian, gradient = system = np.zeros((equations.size, equations.size)), np.zeros(equations.size)
        if terms:
            # Their sum once, because to add a quadratic to the system takes ten times as long as to add two of them.
            surface = [term(posed.vertices, sigma) for term in terms]
            equations.add_surface(VertexQuadratic.sum(surface), posed, state.rotation, system)
        self._add_joints(targets, JOINT_WIDTH_FACTOR * sigma, posed, state.rotation, system)
        equations.add_stitching(weights.stitch, posed, state.rotation, system)
        equations.add_joint_prior(weights.pairwise, state, system)
        self._add_priors(state, weights, system)
        hessian[np.diag_indices(equations.size)] += 1e-9 + 1e-3 * hessian.diagonal()
        return self._retract(state, -self._solution.solve(hessian, gradient))

    def _add_joints(
        self, targets: JointTargets, width: float, posed: PosedPoints, rotation: np.ndarray, system: System
    ) -> None:
        chosen = np.flatnonzero(targets.weight > 0)
        if not len(chosen):
            return
        gap = self._joints.find_joints(chosen, posed.vertices) - targets.points[chosen]
        stays = np.tile(np.eye(3), (len(chosen), 1, 1))
        if targets.rays is not None:
            ray = targets.rays[chosen]
            stays -= (1 - RAY_SHARE) * ray[:, :, None] * ray[:, None, :]
            gap = (stays @ gap[:, :, None])[:, :, 0]
        trust = geman_mcclure((gap**2).sum(axis=1), width**2)
        self._joints.add(chosen, (gap, trust * targets.weight[chosen], stays), posed, rotation, system)

    def _add_priors(self, state: BodyState, weights: RefineWeights, system: System) -> None:
        hessian, gradient = system
        rows, parts, numbers = self._equations.coefficients
        hessian[rows, rows] += weights.pose
        gradient[rows] += weights.pose * state.pose[parts, numbers]
        shape = np.arange(self._equations.first[-1], self._equations.size)
        hessian[shape, shape] += weights.shape
        expected = 0.0 if weights.shape_center is None else weights.shape_center
        gradient[shape] += weights.shape * (state.shape[0] - expected)

    def _retract(self, state: BodyState, step: np.ndarray) -> BodyState:
        first, (rows, parts, numbers) = self._equations.first, self._equations.coefficients
        center, rotation, pose = state.center.copy(), np.ascontiguousarray(state.rotation), state.pose.copy()
        pose[parts, numbers] += step[rows]
        rotation = _move_parts(center, rotation, step, first)
        shape = np.clip(state.shape + step[first[-1] :], -MAX_COEFFICIENT, MAX_COEFFICIENT)
        pose = np.clip(pose, -MAX_COEFFICIENT, MAX_COEFFICIENT)
        return BodyState(center, rotation, pose, shape)


@njit(cache=True, nogil=True)
def _move_parts(center: np.ndarray, rotation: np.ndarray, step: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Move the centres (N, 3) by the steps' translations and return the rotations (N, 3, 3) turned by their turns."""
    turned = np.empty_like(rotation)
    for part in range(len(center)):
        turn, translation = step[first[part] : first[part] + 3].copy(), step[first[part] + 3 : first[part] + 6]
        angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
        turn *= min(1.0, MAX_ROTATION_STEP_RAD / max(angle, 1e-12))
        center[part] += rotation[part] @ translation
        turned[part] = rotation[part] @ exp_one(turn)
    return turned
