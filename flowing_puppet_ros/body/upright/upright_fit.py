# SPDX-License-Identifier: Apache-2.0
"""The first body of a candidate: the best of the upright bank after a few Gauss-Newton steps, soles on the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.cloud.rig_cloud import RigCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.upright.upright_bank import (
    make_upright_bank,
    stature_cost,
)
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.threads import parallel_map, usable_threads

STARTS = 7  # bodies of the bank that are refined
FEW_POINTS = RefineWeights(pose=1e-5, shape=3e-5, pairwise=5e-7, sigma_start=0.12, sigma_end=0.05, iterations=8)
MANY_POINTS = RefineWeights(pose=1e-6, shape=5e-6, pairwise=1e-7, sigma_start=0.08, sigma_end=0.04, iterations=8)
MIN_MANY_POINTS = 400
"""Points from which on they tell more about a body than the priors do."""
COST_SCALE_M, SAME_POSE_M, FINAL_STEPS = 0.003, 0.2, 2
"""Difference of the costs of two bodies at which the worse counts 1 / e, mean distance of their joints up to which they
are averaged, and steps from the mean."""
FLOOR_WEIGHT, SOLE_VERTICES = 0.3, 25
"""Weight of the floor against that of the cloud, and the lowest vertices that are on it."""
MIN_LIMB_POINTS = 60
"""Points from which on they tell about limbs."""
TRUNK_PARTS = ("torso", "head")
MAX_FIT_POINTS = 1500


@dataclass(frozen=True, slots=True, eq=False)
class UprightFit:
    """The best upright body on a candidate.

    Attributes:
        fit: the body.
        cost: metres, how far body and cloud are from each other, with the prior of the stature.
        stature: metres.
    """

    fit: BodyFit
    cost: float
    stature: float


class UprightFitter:
    """The upright first answer of one model."""

    def __init__(self, fitter: BodyFitter) -> None:
        self._fitter = fitter
        self._none = JointTargets.none(fitter.model)
        self._threads = usable_threads(fitter.settings.threads)

    def warm_up(self) -> None:
        """Make the bank beforehand."""
        make_upright_bank(self._fitter.model)

    def make_cloud(
        self,
        points: np.ndarray,
        viewpoint: np.ndarray,
        unknown: np.ndarray | None,
        field: SensorField | SensorRig | None = None,
    ) -> SingleViewCloud:
        """Return the cloud of a candidate; InputError when part of it lies behind the sensor.

        Args:
            points: (N, 3) metres.
            viewpoint: (3,) position of the sensor, metres.
            unknown: (K, 3) m, see `ScanRays.find_unknown`; None where there is a field.
            field: what the sensor can know of the candidate.
        """
        if isinstance(field, SensorRig):
            return RigCloud.seen_by(points, field)
        points = downsample(points, None, MAX_FIT_POINTS)[0]
        return SingleViewCloud.seen_from(points, estimate_normals(points, viewpoint), viewpoint, unknown, field)

    def find_rough(self, cloud: SingleViewCloud, floor: float) -> list[tuple[float, BodyState]]:
        """Return the bank's best bodies with their costs in metres."""
        return make_upright_bank(self._fitter.model).find_best(cloud, floor, STARTS)

    def fit(self, cloud: SingleViewCloud, floor: float, facing: np.ndarray | None = None) -> UprightFit:
        """Fit the best upright body to a cloud; `floor` is z of the floor, m; `facing` (2,) as in `UprightBank`."""
        starts = make_upright_bank(self._fitter.model).find_best(cloud, floor, STARTS, facing)
        return self.refine(starts, cloud, floor)

    def refine(self, starts: list[tuple[float, BodyState]], cloud: SingleViewCloud, floor: float) -> UprightFit:
        """Refine bodies and return the best; `floor` is z of the floor, metres."""
        coarse = CoarseCloud.of(cloud)
        many = len(cloud.points) >= MIN_MANY_POINTS

        def improve(
            start: tuple[float, BodyState], steps: int = FEW_POINTS.iterations
        ) -> tuple[float, BodyState, float]:
            terms = [cloud.free_space_term, lambda vertices, _: floor_term(vertices, floor)]
            center = start[1].shape[0]
            weights = replace(FEW_POINTS, shape_center=center, iterations=steps)
            if steps < FEW_POINTS.iterations:
                weights = replace(weights, sigma_start=FEW_POINTS.sigma_end)
            body = self._fitter.gauss_newton.run(start[1], cloud, self._none, weights, terms)
            if many:
                body = self._fitter.gauss_newton.run(body, cloud, self._none, MANY_POINTS, terms)
            stature = self._fitter.model.measure_height(body.shape)
            cost = self._fitter.hypotheses.pose_bank.cost(body, coarse) + float(stature_cost(np.array(stature)))
            return cost, body, stature

        found = parallel_map(improve, starts, self._threads)
        if not many and len(found) > 1:
            found = [improve((0.0, self._average([(cost, body) for cost, body, _ in found])), FINAL_STEPS)]
        cost, body, stature = min(found, key=lambda each: each[0])
        fit = keep_place_only(self._fitter.model, self._fitter.assess(body, cloud), len(cloud.points))
        return UprightFit(fit, cost, stature)

    def turn_round(self, body: BodyState, cloud: SingleViewCloud, floor: float) -> UprightFit:
        """Fit a body that faces the other way, with its limbs where they are; `floor` is z of the floor, metres."""
        facing = body.rotation[0, :, 0]
        yaw = float(np.arctan2(facing[1], facing[0]))
        middle = np.array([*body.center[0, :2], 0.0])
        ahead, back = so3.exp_one(np.array([0.0, 0.0, -yaw])), so3.exp_one(np.array([0.0, 0.0, yaw + np.pi]))
        level = BodyState((body.center - middle) @ ahead.T, ahead @ body.rotation, body.pose, body.shape)
        other = self._fitter.model.mirror(level)
        turned = BodyState(other.center @ back.T + middle, back @ other.rotation, other.pose, other.shape)
        return self.refine([(0.0, turned)], cloud, floor)

    def rate(self, fit: BodyFit, cloud: SingleViewCloud) -> UprightFit:
        """Return a body that was fitted otherwise with its cost on a cloud."""
        stature = self._fitter.model.measure_height(fit.state.shape)
        cost = self._fitter.hypotheses.pose_bank.cost(fit.state, CoarseCloud.of(cloud))
        return UprightFit(fit, cost + float(stature_cost(np.array(stature))), stature)

    def _average(self, found: list[tuple[float, BodyState]]) -> BodyState:
        """Return the mean of those bodies, given with their costs in metres, that stand as the likeliest does.

        Where few points leave much open, the mean of what they allow is nearer to the truth than the best of it.
        """
        model = self._fitter.model
        cost = np.array([each[0] for each in found])
        weight = np.exp((cost.min() - cost) / COST_SCALE_M)
        joints = np.stack([model.joints(model.vertices(body)) for _, body in found])
        apart = np.linalg.norm(joints[:, None] - joints[None], axis=3).mean(axis=2)
        middle = int((apart @ weight).argmin())
        near = np.flatnonzero(apart[middle] < SAME_POSE_M)
        share = weight[near] / weight[near].sum()
        base, bodies = found[middle][1], [found[k][1] for k in near]
        turns = np.stack([so3.log(np.swapaxes(base.rotation, -1, -2) @ body.rotation) for body in bodies])
        return BodyState(
            np.tensordot(share, np.stack([body.center for body in bodies]), 1),
            base.rotation @ so3.exp(np.tensordot(share, turns, 1)),
            np.tensordot(share, np.stack([body.pose for body in bodies]), 1),
            np.tensordot(share, np.stack([body.shape for body in bodies]), 1),
        )


def keep_place_only(model: StitchedPuppet, fit: BodyFit, points: int) -> BodyFit:
    """Return a body on so few `points` that only its place, height and heading can be told, marked as such.

    Its limbs are inferred, its trunk and head are near what was seen, and as a whole it is not reliable.
    """
    if points >= MIN_LIMB_POINTS:
        return fit
    trunk = np.isin(np.array(model.tree.names)[model.part_of_vertex], TRUNK_PARTS)
    state = np.minimum(fit.visibility.vertices, np.where(trunk, Visibility.NEAR, Visibility.INFERRED)).astype(np.int8)
    visibility = BodyVisibility.of_vertices(model, state)
    told = np.isin(model.tree.names, TRUNK_PARTS)
    return replace(fit, visibility=visibility, part_confidence=fit.part_confidence * told, reliable=False)


def floor_term(vertices: np.ndarray, floor: float) -> VertexQuadratic:
    """Return the quadratic that puts the lowest of the vertices (V, 3) m on the floor, and all that are below it."""
    chosen = np.zeros(len(vertices), dtype=bool)
    chosen[np.argpartition(vertices[:, 2], SOLE_VERTICES)[:SOLE_VERTICES]] = True
    chosen |= vertices[:, 2] < floor
    weight = np.where(chosen, FLOOR_WEIGHT / SOLE_VERTICES, 0.0)
    matrix, vector = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    matrix[:, 2, 2], vector[:, 2] = weight, weight * (vertices[:, 2] - floor)
    return VertexQuadratic(matrix, vector)
