# SPDX-License-Identifier: Apache-2.0
"""The fit of one body to a person's own points, started in place by the joints that a camera sees.

The joints pull across their rays only, weakly, and not at all in the last steps: they say which limb is which, and
the cloud says where it is. A body with left and right exchanged is fitted too, since a network may exchange them, of
the whole person or of limbs that would cross; the one that the cloud contradicts least is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.normals import downsample
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.cloud.rig_cloud import RigCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, make_joint_targets
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig
from flowing_puppet_ros.fusion.lift import LiftedJoints
from flowing_puppet_ros.fusion.limb_depths import CHAINS
from flowing_puppet_ros.fusion.limb_search import LimbSearcher, find_on_surface
from flowing_puppet_ros.fusion.puppet_joints import find_other_sides, trunk_rows
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

PULLED = RefineWeights(pose=1e-7, pairwise=1e-7, shape=3e-6, sigma_start=0.2, sigma_end=0.03, iterations=14)
"""With joints, from far away."""
EXCHANGED = replace(PULLED, iterations=8, alternate=2)
"""The same with left and right exchanged, enough to see whether it is worth more."""
QUICK = replace(PULLED, iterations=8, alternate=2)
"""With joints, quickly."""
FREE = RefineWeights(pose=1e-7, pairwise=1e-7, shape=3e-6, sigma_start=0.06, sigma_end=0.03, iterations=8)
"""Without joints, at the end."""
CLOSE = RefineWeights(pose=1e-7, pairwise=1e-7, shape=3e-6, sigma_start=0.08, sigma_end=0.04, iterations=6, alternate=2)
"""With joints, after a limb has been hung anew."""
MAX_FIT_POINTS = 4000
MAX_SWAP_RATIO = 0.9
"""Cost of the body with exchanged sides, in costs of the other, below which it is kept: networks are mostly right."""
HIDDEN_SHARE = 0.25
"""Of the weight, for joints that the puppet itself hides."""
MIN_START_CONFIDENCE, MIN_LIMB_CONFIDENCE = 0.1, 0.3
"""In a start: what joints of trunk and head count at least, since a puppet places them as the rest of the body
suggests, and below which those of limbs do not count, since a hanging arm is a better guess."""
MIN_GOOD_CONFIDENCE = 0.4  # of a body that is not fitted once more
HELD_SHARE, HELD_UNKNOWN = 0.3, 0.15
"""Of the weight that seen joints keep in the last steps, and the share of the body out of sight from which on."""
START_STEPS, FEW_STEPS = 15, 6
"""Of Gauss-Newton from the joints alone, for a start and where the body only needs to be about right."""
SHOULDERS = ("left_shoulder", "right_shoulder")
LOWER_TRUNK = ("left_hip", "right_hip", "pelvis", "belly")

type NamedJoints = dict[str, tuple[float, float, float, float]]
"""x, y, z in metres and a weight, by name."""


class JointFitter:
    """Fits bodies of one model from lifted joints."""

    def __init__(self, fitter: BodyFitter, strength: float) -> None:
        """Fit with the parts of `fitter`; `strength` is the weight of a certain joint against the whole cloud."""
        self.fitter = fitter
        self.model = fitter.model
        self._strength = strength
        self.limbs = LimbSearcher(fitter.hypotheses, fitter.model)
        self._is_limb = np.ones(len(self.model.joint_names), dtype=bool)
        self._is_limb[trunk_rows(self.model)] = False

    def start(self, joints: LiftedJoints, steps: int = START_STEPS) -> BodyState:
        """Return the body that the joints describe, after so many steps; InputError when they describe none."""
        floor = np.where(self._is_limb, 0.0, MIN_START_CONFIDENCE)
        weight = np.where(joints.found, np.sqrt(np.maximum(joints.confidence, floor)), 0.0)
        certain = np.where(joints.guessed, HIDDEN_SHARE * weight, weight)
        named = self._name(joints, certain)
        if not any(name in named for name in LOWER_TRUNK):
            named = _add_trunk(self.model, named, self._name(joints, weight))
        targets = make_joint_targets(self.model, named)
        return body_from_joints(self.model, self.fitter.gauss_newton, targets, steps)

    def _name(self, joints: LiftedJoints, weight: F64) -> NamedJoints:
        """Return the joints that have a weight (J,), as name -> (x, y, z, weight)."""
        return {
            name: (float(x), float(y), float(z), float(sure))
            for name, (x, y, z), sure in zip(self.model.joint_names, joints.points, weight, strict=True)
            if sure > 0
        }

    def make_targets(self, joints: LiftedJoints) -> JointTargets:
        """Return the pull of the joints across their rays; doubtful ones pull by their confidence squared."""
        weight = np.where(joints.found, joints.confidence**2, 0.0)
        weight = np.where(joints.hidden, HIDDEN_SHARE * weight, weight)
        points, rays = np.nan_to_num(joints.points), np.nan_to_num(joints.rays)
        return JointTargets(points, self._strength * weight, rays)

    def make_cloud(
        self, points: F64, field: SensorField | SensorRig | None, viewpoint: F64 | None = None
    ) -> SingleViewCloud:
        """Return the person's points (N, 3) m of a sensor, and what that can know of the person.

        The sensor is at `viewpoint` (3,) m, or at the origin.
        """
        if isinstance(field, SensorRig):
            return RigCloud.seen_by(points, field)
        points = downsample(points, None, MAX_FIT_POINTS)[0]
        viewpoint = np.zeros(3) if viewpoint is None else viewpoint
        return SingleViewCloud.seen_from(points, None, viewpoint, field=field)

    def take_cloud(self, person: PersonCloud, known: Cloud | None) -> SingleViewCloud:
        """Return a person's cloud, as it is `known` already where that is one of a single view."""
        if isinstance(known, SingleViewCloud):
            return known
        return self.make_cloud(person.points, person.field, person.viewpoint)

    def fit(self, cloud: SingleViewCloud, start: BodyState, joints: LiftedJoints) -> BodyFit:
        """Fit a body to the person's points, from `start`.

        Joints of which the person has no points may be wrong, unless the sensor is blind there: should the body be, the
        fit without them may be better.
        """
        fit = self._fit_either_way(cloud, start, joints)
        on_surface = find_on_surface(joints) | joints.blank | ~self._is_limb
        if fit.confidence >= MIN_GOOD_CONFIDENCE or not (joints.found & ~on_surface).any():
            return fit
        sure = replace(joints, points=np.where(on_surface[:, None], joints.points, np.nan))
        try:
            other = self._fit_either_way(cloud, self.start(sure), sure)
        except InputError:
            return fit
        return other if other.confidence > fit.confidence else fit

    def _fit_either_way(self, cloud: SingleViewCloud, start: BodyState, joints: LiftedJoints) -> BodyFit:
        """Fit a body from `start` and with the sides exchanged, whichever is better."""
        coarse = CoarseCloud.of(cloud)
        unknown = measure_unknown_share(self.model, start, cloud)
        pulled, close = (strengthen_priors(weights, unknown) for weights in (PULLED, CLOSE))
        terms, run = [cloud.free_space_term], self.fitter.gauss_newton.run
        targets, bank = self.make_targets(joints), self.fitter.hypotheses.pose_bank
        body = run(start, cloud, targets, pulled, terms)
        few, limit, given = strengthen_priors(EXCHANGED, unknown), MAX_SWAP_RATIO * bank.cost(body, coarse), joints
        for other in (swap_lifted(self.model, given), *swap_crossed(self.model, body, given)):
            other_targets = self.make_targets(other)
            exchanged = run(self.start(other, FEW_STEPS), cloud, other_targets, few, terms)
            if (cost := bank.cost(exchanged, coarse)) < limit:
                body, joints, targets, limit = exchanged, other, other_targets, cost
        if joints is not given:
            body = run(body, cloud, targets, pulled, terms)
        body = self.limbs.improve(
            body, coarse, joints, self.limbs.find_doubtful(body, joints),
            lambda tried: run(tried, cloud, targets, close, terms),
        )  # fmt: skip
        return self._finish(body, cloud, joints, targets, unknown)

    def fit_quickly(self, cloud: SingleViewCloud, start: BodyState, joints: LiftedJoints) -> BodyFit:
        """Fit a body to the person's points, from `start`, in a quarter of the time of `fit`.

        Left and right are taken as the joints say, and limbs that are elsewhere are left to `hang_anew`.
        """
        unknown = measure_unknown_share(self.model, start, cloud)
        pulled, targets = strengthen_priors(QUICK, unknown), self.make_targets(joints)
        body = self.fitter.gauss_newton.run(start, cloud, targets, pulled, [cloud.free_space_term])
        return self._finish(body, cloud, joints, targets, unknown)

    def _finish(
        self, body: BodyState, cloud: SingleViewCloud, joints: LiftedJoints, targets: JointTargets, unknown: float
    ) -> BodyFit:
        """Take the last steps, in which the cloud decides, and tell how good the body is."""
        free, held = strengthen_priors(FREE, unknown), self.hold(joints, targets, unknown)
        body = self.fitter.gauss_newton.run(body, cloud, held, free, [cloud.free_space_term])
        fit = self.fitter.assess(body, cloud)
        return replace(fit, reliable=fit.reliable and not self.limbs.contradicts(fit.state, joints))

    def hang_anew(
        self, cloud: SingleViewCloud, body: BodyState, joints: LiftedJoints, limbs: Sequence[int]
    ) -> BodyFit | None:
        """Return the fit of a body with `limbs` hung anew, None where nothing better is found."""
        unknown = measure_unknown_share(self.model, body, cloud)
        close, targets = strengthen_priors(CLOSE, unknown), self.make_targets(joints)
        found = self.limbs.improve(
            body, CoarseCloud.of(cloud), joints, limbs,
            lambda tried: self.fitter.gauss_newton.run(tried, cloud, targets, close, [cloud.free_space_term]),
        )  # fmt: skip
        return None if found is body else self.fitter.assess(found, cloud)

    def hold(self, joints: LiftedJoints, targets: JointTargets, unknown: float) -> JointTargets:
        """Return the pull of joints in the last steps: of those not seen, and of all where ends are out of sight.

        Nothing else would hold the former. Of a body that is cut off, the cloud holds no limb along its axis, and
        of a few centimetres there the shape would make many of the stature. `unknown` is the body's share out of sight.
        """
        share = HELD_SHARE * float(np.clip(unknown / HELD_UNKNOWN, 0.0, 1.0))
        return replace(targets, weight=np.where(joints.guessed, 1.0, share) * targets.weight)


def swap_crossed(model: StitchedPuppet, body: BodyState, joints: LiftedJoints) -> list[LiftedJoints]:
    """Return the joints with left called right of limbs that cross from a body's trunk on, arms and legs by themselves.

    A network may be sure of the hips and take one knee for the other. The cloud contradicts the legs of those who do
    cross them less as they are.
    """
    found, places = [], model.joints(model.vertices(body))
    for near, far, *rest in CHAINS:
        aside = [
            points[model.joint_names.index(f"left_{name}")] - points[model.joint_names.index(f"right_{name}")]
            for points, name in ((places, near), (joints.points, far))
        ]
        if float(aside[0] @ aside[1]) < 0:  # not so where one has no depth
            found.append(swap_lifted(model, joints, (far, *rest)))
    return found


def swap_lifted(model: StitchedPuppet, joints: LiftedJoints, kinds: Sequence[str] | None = None) -> LiftedJoints:
    """Return the joints with left called right, of all or of some `kinds`, such as knees."""
    other = list(find_other_sides(model.joint_names))
    if kinds is not None:
        swapped = [name.partition("_")[2] in kinds for name in model.joint_names]
        other = [pair if swap else own for own, (pair, swap) in enumerate(zip(other, swapped, strict=True))]
    return replace(
        joints,
        points=joints.points[other],
        rays=joints.rays[other],
        confidence=joints.confidence[other],
        hidden=joints.hidden[other],
        blank=joints.blank[other],
        choices={other[joint]: choices for joint, choices in joints.choices.items()},
    )


def _add_trunk(model: StitchedPuppet, joints: NamedJoints, places: NamedJoints) -> NamedJoints:
    """Return the joints with the neck and the pelvis of somebody upright, if `places` have both shoulders.

    Arms alone do not tell which way the trunk goes on below the shoulders.
    """
    if not all(name in places for name in SHOULDERS):
        return joints
    template = dict(zip(model.joint_names, model.joints(model.vertices(model.rest_state())), strict=True))
    found, mean = (_stand_between(*(np.array(known[name][:3]) for name in SHOULDERS)) for known in (places, template))
    sure = min(places[name][3] for name in SHOULDERS)
    added = {}
    for name in ("neck", "pelvis"):
        x, y, z = found[0] + found[1] @ mean[1].T @ (template[name] - mean[0])
        added[name] = (float(x), float(y), float(z), 0.5 * sure)
    return {**added, **joints}


def _stand_between(left: F64, right: F64) -> tuple[F64, F64]:
    """Return the middle (3,) m of two shoulders, and the axes (3, 3) as columns: to the left, forward, up."""
    side = (left - right) * [1.0, 1.0, 0.0]
    side /= max(float(np.linalg.norm(side)), 1e-6)
    up = np.array([0.0, 0.0, 1.0])
    return (left + right) / 2, np.stack([side, np.cross(side, up), up], axis=1)
