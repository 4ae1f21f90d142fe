# SPDX-License-Identifier: Apache-2.0
"""The people of one image in one cloud: joints lifted, points shared out, a body fitted to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.cloud.limb_crop import list_capsules
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.segmentation.planes import find_planes, is_clear_of_planes
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.fusion.joint_fit import MIN_LIMB_CONFIDENCE, JointFitter
from flowing_puppet_ros.fusion.lift import LiftedJoints, lift_joints
from flowing_puppet_ros.fusion.ownership import assign_points
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.threads import one_blas_thread, parallel_map, usable_threads


MAX_LIMB_M = 0.6
"""Length of a limb that takes points by itself."""
CLAIM_ROUNDS = 2
"""In the first, joints that a neighbour hides are lifted onto the neighbour."""


@dataclass(frozen=True)
class FusionSettings(Settings):
    """Settings of the fits to puppets and cloud."""

    joint_strength: float = setting(
        0.02, "weight of a certain joint of a puppet relative to the whole cloud", low=0.0, high=1.0, advanced=True
    )
    min_points: int = setting(60, "minimum points of a person whom a body is fitted to", low=50, high=100000,
                              advanced=True)  # fmt: skip
    plane_clearance: float = setting(
        0.03, "distance from floor and walls up to which points are nobody's", unit="m", low=0.005, high=0.5,
        advanced=True,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What belongs to one puppet: its lifted `joints`, the body that they describe and its points (N,)."""

    puppet: PuppetJoints
    joints: LiftedJoints
    start: BodyState
    own: Bools


class PeopleFitter:
    """Fits a body to each puppet of an image that has points in a cloud."""

    def __init__(self, fitter: BodyFitter, settings: FusionSettings) -> None:
        """Fit with the model and the parts of `fitter`."""
        self.joint_fitter = JointFitter(fitter, settings.joint_strength)
        self.model = fitter.model
        self._settings = settings
        self._threads = usable_threads(fitter.settings.threads)

    def fit_people(
        self, cloud: SeenCloud, puppets: Sequence[PuppetJoints], image: RangeImage | None
    ) -> list[tuple[str, BodyFit]]:
        """Return (id, body) of the puppets that have enough points; the same for any number of threads."""
        with one_blas_thread():
            clear, floor = self.find_clear(cloud.points)
            claims = self.claim(cloud, puppets, clear)
            found = parallel_map(lambda claim: self._fit(cloud, claim, image, floor), claims, self._threads)
        return [(claim.puppet.id, fit) for claim, fit in zip(claims, found, strict=True) if fit is not None]

    def find_clear(self, points: F64) -> tuple[Bools, Bools]:
        """Return which points (N,) are neither floor nor wall, and which are floor."""
        floor, walls = find_planes(points, self._settings.plane_clearance)
        clear = is_clear_of_planes(points, self._settings.plane_clearance, floor, walls)
        on_floor = np.zeros(len(points), dtype=bool) if floor is None else (
            floor.height(points) <= self._settings.plane_clearance
        )  # fmt: skip
        return clear, on_floor

    def claim(self, cloud: SeenCloud, puppets: Sequence[PuppetJoints], clear: Bools) -> list[Claim]:
        """Share the `clear` (N,) points out among the puppets; those without depth or too few points get none."""
        own = [clear] * len(puppets)
        claims: list[Claim | None] = []
        for _round in range(CLAIM_ROUNDS):
            claims = [self._start(cloud, puppet, points) for puppet, points in zip(puppets, own, strict=True)]
            limbs = [np.empty((0, 8)) if claim is None else self._list_capsules(claim) for claim in claims]
            owner = np.full(len(cloud.points), -1, dtype=np.int32)
            owner[clear] = assign_points(cloud.points[clear], limbs)
            own = [owner == number for number in range(len(puppets))]
        return [
            replace(claim, joints=lift_joints(self.model, claim.puppet, cloud, points), own=points)
            for claim, points in zip(claims, own, strict=True)
            if claim is not None and np.count_nonzero(points) >= self._settings.min_points
        ]

    def _start(self, cloud: SeenCloud, puppet: PuppetJoints, usable: Bools) -> Claim | None:
        """Return a puppet's joints on the `usable` (N,) points and the body that they describe, None without one."""
        joints = lift_joints(self.model, puppet, cloud, usable)
        try:
            return Claim(puppet, joints, self.joint_fitter.start(joints), usable)
        except InputError:
            return None

    def _list_capsules(self, claim: Claim) -> F64:
        """Return the capsules (C, 8) of a body, and of the limbs whose joints are certain, should the body miss them."""
        names, joints = self.model.joint_names, claim.joints
        body = self.model.joints(self.model.vertices(claim.start))
        certain = joints.found & ~joints.hidden & (joints.confidence >= MIN_LIMB_CONFIDENCE)
        seen = {name: place for name, place, sure in zip(names, joints.points, certain, strict=True) if sure}
        limbs = list_capsules(seen)
        limbs = limbs[np.linalg.norm(limbs[:, :3] - limbs[:, 3:6], axis=1) < MAX_LIMB_M]
        return np.concatenate([list_capsules(dict(zip(names, body, strict=True))), limbs])

    def _fit(self, cloud: SeenCloud, claim: Claim, image: RangeImage | None, floor: Bools) -> BodyFit | None:
        # The floor hides nobody: whoever stood below it would be hidden by it, and longer legs would cost nothing.
        field = None if image is None else image.make_field(claim.own | floor)
        try:
            seen = self.joint_fitter.make_cloud(cloud.points[claim.own], field)
            return self.joint_fitter.fit(seen, claim.start, claim.joints)
        except InputError:
            return None
