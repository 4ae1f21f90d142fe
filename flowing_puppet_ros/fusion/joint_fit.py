# SPDX-License-Identifier: Apache-2.0
"""The fit of one body to a person's own points, started in place by the joints that a camera sees.

The joints pull across their rays only, weakly, and not at all in the last steps: they say which limb is which, and
the cloud says where it is. A body with left and right exchanged is fitted too, since a network may exchange them, and
the one that the cloud contradicts less is kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, make_joint_targets
from flowing_puppet_ros.body.fit.partial_view import measure_unknown_share, strengthen_priors
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.fusion.lift import LiftedJoints
from flowing_puppet_ros.fusion.puppet_joints import find_other_sides, trunk_rows
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

PULLED = RefineWeights(pose=1e-7, pairwise=1e-7, shape=1e-6, sigma_start=0.2, sigma_end=0.03, iterations=20)
"""With joints, from far away."""
FREE = RefineWeights(pose=1e-7, pairwise=1e-7, shape=1e-6, sigma_start=0.06, sigma_end=0.03, iterations=8)
"""Without joints, at the end."""
MAX_FIT_POINTS = 4000
MAX_SWAP_RATIO = 0.9
"""Cost of the body with exchanged sides, in costs of the other, below which it is kept: networks are mostly right."""
WIDE = RefineWeights(pose=1e-7, pairwise=1e-7, shape=1e-6, sigma_start=0.2, sigma_end=0.03, iterations=15)
"""Without joints, where they were so wrong that the body is not reliable."""
REACH = RefineWeights(pose=1e-7, pairwise=1e-7, shape=1e-6, sigma_start=0.2, sigma_end=0.03, iterations=12)
MIN_REACH_M, REACH_STRENGTH, MAX_REACH_RATIO = 0.08, 0.05, 1.02
"""Distance of an arm's joint from where it was lifted to, from which the joints of arms pull in all directions, how
strongly, and the two-way distance, in that of the body before, up to which the result is kept."""
HIDDEN_SHARE = 0.25
"""Of the weight, for joints that the puppet itself hides."""
MIN_START_CONFIDENCE, MIN_LIMB_CONFIDENCE = 0.1, 0.3
"""In a start: what joints of trunk and head count at least, since a puppet places them as the rest of the body
suggests, and below which those of limbs do not count, since a hanging arm is a better guess."""
SPINE_M = 0.5
"""From the shoulders to the pelvis of a person of whom no more than shoulders and head are seen."""


class JointFitter:
    """Fits bodies of one model from lifted joints."""

    def __init__(self, fitter: BodyFitter, strength: float) -> None:
        """Fit with the parts of `fitter`; `strength` is the weight of a certain joint against the whole cloud."""
        self.fitter = fitter
        self.model = fitter.model
        self._strength = strength
        self._is_limb = np.ones(len(self.model.joint_names), dtype=bool)
        self._is_limb[trunk_rows(self.model)] = False

    def start(self, joints: LiftedJoints) -> BodyState:
        """Return the body that the joints describe; InputError when they describe none."""
        floor = np.where(self._is_limb, 0.0, MIN_START_CONFIDENCE)
        weight = np.where(joints.found, np.sqrt(np.maximum(joints.confidence, floor)), 0.0)
        weight[self._is_limb & (joints.confidence < MIN_LIMB_CONFIDENCE)] = 0.0
        certain = np.where(joints.hidden, 0.0, weight)
        try:
            targets = make_joint_targets(self.model, self._name(joints, certain))
        except InputError:
            targets = make_joint_targets(self.model, _add_pelvis(self._name(joints, weight)))
        return body_from_joints(self.model, self.fitter.gauss_newton, targets)

    def _name(self, joints: LiftedJoints, weight: F64) -> dict[str, tuple[float, float, float, float]]:
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

    def make_cloud(self, points: F64, field: SensorField | None, viewpoint: F64 | None = None) -> SingleViewCloud:
        """Return the person's points (N, 3) m of a sensor, and what that can know of the person.

        The sensor is at `viewpoint` (3,) m, or at the origin.
        """
        points = downsample(points, None, MAX_FIT_POINTS)[0]
        viewpoint = np.zeros(3) if viewpoint is None else viewpoint
        return SingleViewCloud.seen_from(points, estimate_normals(points, viewpoint), viewpoint, field=field)

    def fit(self, cloud: SingleViewCloud, start: BodyState, joints: LiftedJoints) -> BodyFit:
        """Fit a body to the person's points, from `start` and with the sides exchanged, whichever is better."""
        coarse = CoarseCloud.of(cloud)
        targets = self.make_targets(joints)
        unknown = measure_unknown_share(self.model, start, cloud)
        pulled, free = strengthen_priors(PULLED, unknown), strengthen_priors(FREE, unknown)
        terms, run = [cloud.free_space_term], self.fitter.gauss_newton.run
        tried = []
        for body, pull in ((start, targets), (self.start(swap_lifted(self.model, joints)), self._swap(targets))):
            found = run(body, cloud, pull, pulled, terms)
            tried.append((self.fitter.hypotheses.pose_bank.cost(found, coarse), found))
        _, body = tried[tried[1][0] < MAX_SWAP_RATIO * tried[0][0]]
        none = JointTargets.none(self.model)
        fit = self.fitter.assess(run(body, cloud, none, free, terms), cloud)
        if not fit.reliable:
            wide = self.fitter.assess(run(fit.state, cloud, none, strengthen_priors(WIDE, unknown), terms), cloud)
            fit = min(fit, wide, key=lambda found: found.two_way_distance)
        return self._reach_for_hands(
            fit, cloud, joints if body is tried[0][1] else swap_lifted(self.model, joints), unknown
        )

    def _reach_for_hands(self, fit: BodyFit, cloud: SingleViewCloud, joints: LiftedJoints, unknown: float) -> BodyFit:
        """Return the body with arms that point at the camera where the cloud is, if that is closer.

        Seen from the front such an arm has few points, and across the rays it lies as well before the belly: only the
        depth of elbow and wrist tells.
        """
        gap = np.linalg.norm(fit.joints - joints.points, axis=1)
        arm = np.array([name.endswith(("elbow", "wrist", "hand")) for name in self.model.joint_names])
        sure = arm & joints.found & ~joints.hidden & (joints.confidence >= MIN_LIMB_CONFIDENCE)
        if not (sure & (gap > MIN_REACH_M)).any():
            return fit
        targets = JointTargets(np.nan_to_num(joints.points), np.where(sure, REACH_STRENGTH * joints.confidence, 0.0))
        weights = strengthen_priors(REACH, unknown)
        terms, run = [cloud.free_space_term], self.fitter.gauss_newton.run
        body = run(fit.state, cloud, targets, weights, terms)
        free = strengthen_priors(FREE, unknown)
        reached = self.fitter.assess(run(body, cloud, JointTargets.none(self.model), free, terms), cloud)
        return reached if reached.two_way_distance <= MAX_REACH_RATIO * fit.two_way_distance else fit

    def _swap(self, targets: JointTargets) -> JointTargets:
        other = list(find_other_sides(self.model.joint_names))
        rays = None if targets.rays is None else targets.rays[other]
        return JointTargets(targets.points[other], targets.weight[other], rays)


def swap_lifted(model: StitchedPuppet, joints: LiftedJoints) -> LiftedJoints:
    """Return the joints with left called right."""
    other = list(find_other_sides(model.joint_names))
    return replace(
        joints,
        points=joints.points[other],
        rays=joints.rays[other],
        confidence=joints.confidence[other],
        hidden=joints.hidden[other],
    )


def _add_pelvis(joints: dict[str, tuple[float, float, float, float]]) -> dict[str, tuple[float, float, float, float]]:
    """Return joints that lie on a line, as shoulders and neck do, with a pelvis below them."""
    above = [np.array(joints[name][:3]) for name in ("left_shoulder", "right_shoulder") if name in joints]
    if len(above) < 2:
        return joints
    middle = (above[0] + above[1]) / 2
    sure = min(joints[name][3] for name in ("left_shoulder", "right_shoulder"))
    return {**joints, "pelvis": (float(middle[0]), float(middle[1]), float(middle[2]) - SPINE_M, 0.5 * sure)}
