# SPDX-License-Identifier: Apache-2.0
"""The first body of a candidate: the best of the upright bank after a few Gauss-Newton steps, soles on the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit

from flowing_puppet_ros.body.bank.body_bank import stature_cost
from flowing_puppet_ros.body.bank.posed_bank import make_posed_bank
from flowing_puppet_ros.body.bank.upright_bank import (
    CHILD_TOP_M,
    make_child_bank,
    make_upright_bank,
)
from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.normals import downsample
from flowing_puppet_ros.body.cloud.rig_cloud import RigCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import MAX_THREADS, parallel_map, usable_threads

STARTS = 8  # bodies of the bank that are refined
FEW_POINTS = RefineWeights(pose=1e-5, shape=3e-5, pairwise=5e-7, sigma_start=0.12, sigma_end=0.05, iterations=8)
MANY_POINTS = RefineWeights(pose=1e-6, shape=5e-6, pairwise=1e-7, sigma_start=0.08, sigma_end=0.04, iterations=8)
MIN_MANY_POINTS = 400
"""Points from which on they tell more about a body than the priors do."""
BEST_OF_WAY = 2  # bodies of those that face the same way that many points refine further
COST_SCALE_M, SAME_POSE_M, FINAL_STEPS = 0.003, 0.2, 2
"""Difference of the costs of two bodies at which the worse counts 1 / e, mean distance of their joints up to which they
are averaged, and steps from the mean."""
CLOSE_M, CLOSE_WORTH_M, ALIGNMENT_WORTH_M = 0.03, 0.1, 0.1
"""Distance up to which a point is close to a body, and what a share of 1 of close points and a cosine of 1 between the
normals are worth."""
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
        score: metres, the cost less what speaks for which way it faces: see `_score`.
    """

    fit: BodyFit
    cost: float
    stature: float
    score: float


class _Refined(NamedTuple):
    """A refined body with its cost and stature, metres."""

    cost: float
    body: BodyState
    stature: float


class UprightFitter:
    """The upright first answer of one model."""

    def __init__(self, fitter: BodyFitter, max_threads: int = MAX_THREADS) -> None:
        """Fit as `fitter` does, on its threads, but at most so many."""
        self._fitter = fitter
        self._none = JointTargets.none(fitter.model)
        self._threads = usable_threads(min(fitter.settings.threads, max_threads))

    def warm_up(self) -> None:
        """Make the banks beforehand."""
        make_child_bank(self._fitter.model)
        make_posed_bank(self._fitter.model)

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
        return SingleViewCloud.seen_from(points, None, viewpoint, unknown, field)

    def find_rough(
        self, cloud: SingleViewCloud, floor: float, facing: np.ndarray | None = None, quick: bool = False
    ) -> list[tuple[float, BodyState]]:
        """Return the bank's best bodies with their costs in metres; `quick`: of a fourth of it; `facing` as there.

        Of children a sixteenth: most of what is low is none.
        """
        model, every = self._fitter.model, 2 if quick else 1
        starts = make_upright_bank(model).find_best(cloud, floor, STARTS, facing, every)
        if cloud.points[:, 2].max() - floor > CHILD_TOP_M:
            return starts
        children = make_child_bank(model).find_best(cloud, floor, STARTS, facing, every**2)
        return sorted([*starts, *children], key=lambda start: start[0])[:STARTS]

    def find_posed(self, cloud: SingleViewCloud, floor: float, quick: bool = False) -> list[tuple[float, BodyState]]:
        """Return the best bodies of those who sit, bend or crouch, with costs in metres; as `find_rough`."""
        return make_posed_bank(self._fitter.model).find_best(cloud, floor, STARTS, every=2 if quick else 1, by_top=True)

    def fit(
        self, cloud: SingleViewCloud, floor: float, facing: np.ndarray | None = None, quick: bool = False
    ) -> UprightFit:
        """Fit the best upright body to a cloud; `floor` is z of the floor, m; `facing` (2,) as in `BodyBank`.

        A `quick` one is that of the best of a part of the bank, in a tenth of the time.
        """
        starts = self.find_rough(cloud, floor, facing, quick)
        return self.refine(starts[:1] if quick else starts, cloud, floor)

    def refine(self, starts: list[tuple[float, BodyState]], cloud: SingleViewCloud, floor: float) -> UprightFit:
        """Refine bodies and return the best; `floor` is z of the floor, metres."""
        coarse = CoarseCloud.of(cloud)
        terms = [cloud.free_space_term, lambda vertices, _: floor_term(vertices, floor)]

        def run(body: BodyState, weights: RefineWeights) -> _Refined:
            body = self._fitter.gauss_newton.run(body, cloud, self._none, weights, terms)
            stature = self._fitter.model.measure_height(body.shape)
            cost = self._fitter.hypotheses.pose_bank.cost(body, coarse) + float(stature_cost(np.array(stature)))
            return _Refined(cost, body, stature)

        def improve(body: BodyState) -> _Refined:
            return run(body, replace(FEW_POINTS, shape_center=body.shape[0]))

        ways = _group_by_facing(parallel_map(improve, [body for _, body in starts], self._threads))
        if len(cloud.points) >= MIN_MANY_POINTS:
            best = [each.body for way in ways for each in way[:BEST_OF_WAY]]
            ways = _group_by_facing(parallel_map(lambda body: run(body, MANY_POINTS), best, self._threads))
        elif len(starts) > 1:
            last = replace(FEW_POINTS, iterations=FINAL_STEPS, sigma_start=FEW_POINTS.sigma_end)
            means = [self._average(way) for way in ways]
            ways = [[run(mean, replace(last, shape_center=mean.shape[0]))] for mean in means]
        return min((self._finish(way[0], cloud) for way in ways), key=lambda each: each.score)

    def _finish(self, found: _Refined, cloud: SingleViewCloud) -> UprightFit:
        fit = keep_place_only(self._fitter.model, self._fitter.assess(found.body, cloud), len(cloud.points))
        return UprightFit(fit, found.cost, found.stature, self._score(fit, found.cost, cloud))

    def _score(self, fit: BodyFit, cost: float, cloud: SingleViewCloud) -> float:
        """Return by which of two bodies that face opposite ways the right one is known, metres; less is better.

        Their costs hardly differ, but a body that faces the right way is close to more of the points, and its normals
        are more like the cloud's.
        """
        distance, nearest = NearestPoints(fit.vertices).query(cloud.points)
        normals = vertex_normals(fit.vertices, self._fitter.model.faces)[nearest]
        alignment = float((cloud.normals * normals).sum(axis=1).mean())
        return cost - CLOSE_WORTH_M * float((distance < CLOSE_M).mean()) - ALIGNMENT_WORTH_M * alignment

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

    def choose_facing(self, first: BodyFit, full: BodyFit, cloud: SingleViewCloud, floor: float) -> BodyFit:
        """Return the body of a full fit, turned round if it does not face as the `first` one and that is likelier.

        A full fit is closer to the cloud whichever way it faces, which says little about front and back.
        """
        if first.state.rotation[0, :2, 0] @ full.state.rotation[0, :2, 0] > 0:
            return full
        turned = self.turn_round(full.state, cloud, floor)
        return min(self.rate(full, cloud), turned, self.rate(first, cloud), key=lambda each: each.score).fit

    def rate(self, fit: BodyFit, cloud: SingleViewCloud) -> UprightFit:
        """Return a body that was fitted otherwise with its cost on a cloud."""
        stature = self._fitter.model.measure_height(fit.state.shape)
        cost = self._fitter.hypotheses.pose_bank.cost(fit.state, CoarseCloud.of(cloud))
        cost += float(stature_cost(np.array(stature)))
        return UprightFit(fit, cost, stature, self._score(fit, cost, cloud))

    def _average(self, found: list[_Refined]) -> BodyState:
        """Return the mean of those bodies that stand as the likeliest does.

        Where few points leave much open, the mean of what they allow is nearer to the truth than the best of it.
        """
        model = self._fitter.model
        cost = np.array([each.cost for each in found])
        weight = np.exp((cost.min() - cost) / COST_SCALE_M)
        joints = np.stack([model.joints(model.vertices(each.body)) for each in found])
        apart = np.linalg.norm(joints[:, None] - joints[None], axis=3).mean(axis=2)
        middle = int((apart @ weight).argmin())
        near = np.flatnonzero(apart[middle] < SAME_POSE_M)
        share = weight[near] / weight[near].sum()
        base, bodies = found[middle].body, [found[k].body for k in near]
        turns = np.stack([so3.log(np.swapaxes(base.rotation, -1, -2) @ body.rotation) for body in bodies])
        return BodyState(
            np.tensordot(share, np.stack([body.center for body in bodies]), 1),
            base.rotation @ so3.exp(np.tensordot(share, turns, 1)),
            np.tensordot(share, np.stack([body.pose for body in bodies]), 1),
            np.tensordot(share, np.stack([body.shape for body in bodies]), 1),
        )


def _group_by_facing(found: list[_Refined]) -> list[list[_Refined]]:
    """Return the bodies that face as the best one does, and those that do not, if any; the best of each first."""
    found = sorted(found, key=lambda each: each.cost)
    ahead = found[0].body.rotation[0, :2, 0]
    same = [bool(each.body.rotation[0, :2, 0] @ ahead > 0) for each in found]
    ways = [[each for each, own in zip(found, same, strict=True) if own is side] for side in (True, False)]
    return [way for way in ways if way]


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
    return VertexQuadratic(*_pull_to_floor(vertices, floor))


@njit(cache=True, nogil=True)
def _pull_to_floor(vertices, floor):  # type: ignore[no-untyped-def]
    """Return the matrices (V, 3, 3) and vectors (V, 3) of `floor_term`."""
    matrix, vector = np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3))
    lowest = np.partition(vertices[:, 2], SOLE_VERTICES - 1)[SOLE_VERTICES - 1]
    weight = FLOOR_WEIGHT / SOLE_VERTICES
    for k in range(len(vertices)):
        if vertices[k, 2] <= lowest or vertices[k, 2] < floor:
            matrix[k, 2, 2], vector[k, 2] = weight, weight * (vertices[k, 2] - floor)
    return matrix, vector
