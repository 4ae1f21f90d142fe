# SPDX-License-Identifier: Apache-2.0
"""The people of one image in one cloud: joints lifted, points shared out, a body fitted to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.limb_crop import list_capsules
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.segmentation.planes import PlaneCache, find_planes, is_clear_of_planes, subsample
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.depth_smoothing import smooth_depth
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.fusion.joint_fit import FEW_STEPS, HIDDEN_SHARE, MIN_LIMB_CONFIDENCE, JointFitter
from flowing_puppet_ros.fusion.lift import LiftedJoints, find_lifted_onto_others, lift_joints
from flowing_puppet_ros.fusion.ownership import OUTSIDE, assign_points, find_shown
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, list_bones, trunk_rows
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.process.threads import one_blas_thread, parallel_map, usable_threads
from flowing_puppet_ros.settings import Settings, setting

MAX_LIMB_M = 0.6
"""Length of a limb that takes points by itself."""
JOINT_RADIUS_M = 0.04
"""Of a limb at a sure joint, which takes points though the next joint towards the trunk is not known."""
MIN_PLACES, PLACE_WEIGHT = 4, 0.1
"""Joints by whose places a body is moved, at least, and the weight of a certain one."""
BLANK_RADIUS_M = 0.2
"""Around a bone that the sensor has no values of, within which it knows nothing but the person's points."""
NO_BONES = np.empty((0, 2, 3))
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
    min_confidence: float = setting(
        0.3, "confidence from which on a body that is not reliable is published", low=0.0, high=1.0, advanced=True
    )
    max_lag: float = setting(
        0.35, "time from a cloud to the nearest puppets up to which they belong together", unit="s", low=0.0, high=5.0
    )  # fmt: skip
    wait: float = setting(
        2.0,
        "time by which puppets or silhouettes may lag behind the clouds before these are used without waiting for them",
        unit="s", low=0.0, high=10.0, advanced=True,
    )  # fmt: skip
    colour_only: bool = setting(
        True,
        "publish whom the camera sees where there is no depth: joints alone, as far away as their size says, never"
        " reliable",
        advanced=True,
    )
    rectified: bool = setting(
        False, "puppets are those of a rectified image, as P of puppets/camera_info says, not K and D", advanced=True
    )
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
        self.fitter = fitter
        self.min_points = settings.min_points
        self.threads = usable_threads(fitter.settings.threads)
        self._trunk = trunk_rows(fitter.model)
        self._bones = list_bones(fitter.model)

    def fit_people(
        self, cloud: SeenCloud, puppets: Sequence[PuppetJoints], image: RangeImage | None
    ) -> list[tuple[str, BodyFit]]:
        """Return (id, body) of the puppets that have enough points; the same for any number of threads.

        `image` is the cloud's range image, which says what the sensor can know of each person.
        """
        with one_blas_thread():
            clear, floor = self.find_clear(cloud.points, None, cloud.viewpoint)
            claims, _ = self.claim(cloud, puppets, clear)
            people = [
                make_person(cloud, image, claim.own, floor, 0, self.find_blanks(claim.joints)) for claim in claims
            ]
            found = parallel_map(
                lambda pair: self.fit_claim(*pair), list(zip(claims, people, strict=True)), self.threads
            )
        return [
            (claim.puppet.id, fit)
            for claim, fit in zip(claims, found, strict=True)
            if fit is not None and self.is_proven(fit)
        ]

    def find_clear(
        self, points: F64, cache: PlaneCache | None = None, sensor: F64 | None = None
    ) -> tuple[Bools, Bools]:
        """Return which points (N,) are neither floor nor wall, and which are floor.

        `cache` has those of before, and `sensor` (3,) m is above the floor.
        """
        origin, clearance = np.zeros(3), self._settings.plane_clearance
        few = subsample(points)
        known = cache.get(few, clearance, origin) if cache else None
        floor, walls = known or find_planes(points, clearance, sensor)
        if cache and known is None:
            cache.put(few, clearance, floor, walls, origin)
        clear = is_clear_of_planes(points, clearance, floor, walls)
        on_floor = np.zeros(len(points), dtype=bool) if floor is None else floor.height(points) <= clearance
        return clear, on_floor

    def claim(
        self,
        cloud: SeenCloud,
        puppets: Sequence[PuppetJoints],
        clear: Bools,
        known: Sequence[BodyState | None] = (),
        others: Sequence[BodyState] = (),
    ) -> tuple[list[Claim], list[Bools]]:
        """Share the `clear` (N,) points out among the puppets, and other people of whom there is no puppet.

        Args:
            cloud: with pixels.
            puppets: in its camera's image.
            clear: (N,) points that may be anybody's.
            known: where the bodies of the puppets should be, None for new ones.
            others: where the bodies of the other people should be.

        Returns:
            The claims of the puppets that have enough points, and the points (N,) of the others.
        """
        bodies = list(known) or [None] * len(puppets)
        expected = [None if body is None else self.find_joints(body) for body in bodies]
        puppets, masks = list(puppets), [find_shown(cloud, puppet, self._bones) for puppet in puppets]
        own = [clear if mask is None else clear & (mask != OUTSIDE) for mask in masks]
        shown = [None if mask is None else mask[clear] for mask in masks]
        claims: list[Claim | None] = []
        extra = [self.list_body(self.find_joints(body)) for body in others]
        for _round in range(CLAIM_ROUNDS if any(body is None for body in bodies) else 1):
            claims = [self._start(cloud, *each) for each in zip(puppets, own, bodies, expected, strict=True)]
            for number in self._hide_others(puppets, claims, cloud):
                claims[number] = self._start(cloud, puppets[number], own[number], bodies[number], expected[number])
            limbs = [
                np.empty((0, 8)) if claim is None else self._list_capsules(claim, joints)
                for claim, joints in zip(claims, expected, strict=True)
            ]
            owner = np.full(len(cloud.points), -1, dtype=np.int32)
            owner[clear] = assign_points(cloud.points[clear], [*limbs, *extra], shown)
            own = [owner == number for number in range(len(puppets))]
        found = [
            replace(claim, joints=lift_joints(self.model, claim.puppet, cloud, points, joints), own=points)
            for claim, points, joints in zip(claims, own, expected, strict=True)
            if claim is not None and np.count_nonzero(points) >= self.min_points
        ]
        return found, [owner == len(puppets) + number for number in range(len(others))] if claims or others else []

    @staticmethod
    def _hide_others(puppets: list[PuppetJoints], claims: Sequence[Claim | None], cloud: SeenCloud) -> list[int]:
        """Call the joints hidden that were lifted onto another person; return the numbers of the puppets with such."""
        known = [(number, claim.joints) for number, claim in enumerate(claims) if claim is not None]
        onto = find_lifted_onto_others([joints for _, joints in known], cloud.camera.rotation[2])
        changed = []
        for (number, _), hidden in zip(known, onto, strict=True):
            if (hidden & ~puppets[number].hidden).any():
                puppets[number] = replace(puppets[number], hidden=puppets[number].hidden | hidden)
                changed.append(number)
        return changed

    def _start(
        self, cloud: SeenCloud, puppet: PuppetJoints, usable: Bools, body: BodyState | None, expected: F64 | None
    ) -> Claim | None:
        """Return a puppet's joints on the `usable` (N,) points and the body that they describe, None without one.

        Where the body should be is known better from the clouds before: then it is `body`, and `expected` (J, 3) m are
        its joints.
        """
        joints = lift_joints(self.model, puppet, cloud, usable, expected)
        try:
            return Claim(puppet, joints, self.joint_fitter.start(joints, FEW_STEPS) if body is None else body, usable)
        except InputError:
            return None

    def find_joints(self, body: BodyState) -> F64:
        """Return a body's joints (J, 3), metres."""
        return np.asarray(self.model.joints(self.model.vertices(body)))

    def _list_capsules(self, claim: Claim, expected: F64 | None) -> F64:
        """Return the capsules (C, 8) of a body, and of limbs that end in sure joints, should the body miss them.

        `expected` are the body's joints (J, 3) m if they are known already.
        """
        joints, numbers = claim.joints, {name: number for number, name in enumerate(self.model.joint_names)}
        found = {name: joints.points[number] for name, number in numbers.items() if joints.found[number]}
        sure = {name for name in found if joints.confidence[numbers[name]] >= MIN_LIMB_CONFIDENCE}
        limbs = list_capsules(found, sure)
        limbs = limbs[np.linalg.norm(limbs[:, :3] - limbs[:, 3:6], axis=1) < MAX_LIMB_M]
        seen = [found[name] for name in found if name in sure and "_" in name and not joints.hidden[numbers[name]]]
        ends = np.array([[*place, *place, JOINT_RADIUS_M, JOINT_RADIUS_M] for place in seen])
        body = self.find_joints(claim.start) if expected is None else expected
        return np.concatenate([self.list_body(body), limbs, ends.reshape(-1, 8)])

    def list_body(self, joints: F64) -> F64:
        """Return the capsules (C, 8) of a body with `joints` (J, 3), metres."""
        return list_capsules(dict(zip(self.model.joint_names, joints, strict=True)))

    def fit_claim(
        self, claim: Claim, person: PersonCloud, known: Cloud | None = None, quick: bool = False
    ) -> BodyFit | None:
        """Return the body of a puppet's own points, from its joints; None where there is none.

        `known` is the person's cloud as a tracker has prepared it; `quick`: without a look at the exchanged sides,
        which a track tells apart.
        """
        fitter = self.joint_fitter
        try:
            cloud, start = fitter.take_cloud(person, known), fitter.start(claim.joints)
            return (fitter.fit_quickly if quick else fitter.fit)(cloud, start, claim.joints)
        except InputError:
            return None

    def complete_targets(self, claim: Claim, targets: JointTargets, body: BodyState) -> JointTargets:
        """Return targets with the joints that have no depth, each on its ray where the body's joint is nearest."""
        rays, puppet = np.nan_to_num(claim.joints.rays), claim.puppet
        joints = self.find_joints(body)
        missing = puppet.known & ~claim.joints.found
        along = ((joints - claim.joints.centre) * rays).sum(axis=1, keepdims=True)
        weight = self._settings.joint_strength * HIDDEN_SHARE * puppet.confidence**2
        return JointTargets(
            np.where(missing[:, None], claim.joints.centre + along * rays, targets.points),
            np.where(missing, weight, targets.weight),
            rays,
        )

    def find_places(self, claim: Claim) -> JointTargets | None:
        """Return where the joints that are surely seen are, with their depths; None where they are too few."""
        joints = claim.joints
        seen = joints.found & ~joints.guessed & (joints.confidence >= MIN_LIMB_CONFIDENCE)
        if np.count_nonzero(seen) < MIN_PLACES:
            return None
        weight = np.where(seen, PLACE_WEIGHT * joints.confidence, 0.0)
        return JointTargets(np.nan_to_num(joints.points), weight)

    def find_blanks(self, joints: LiftedJoints) -> F64:
        """Return the bones (K, 2, 3) m whose ends the puppet surely sees where the sensor has no values."""
        bones = [[first, last] for first, last in self._bones if joints.blank[first] or joints.blank[last]]
        ends = joints.points[np.array(bones, dtype=np.int64).reshape(-1, 2)]
        return np.asarray(ends[np.isfinite(ends).all(axis=(1, 2))])

    def is_proven(self, fit: BodyFit) -> bool:
        """Return whether a body shows that the puppet is a person: a reliable one, or one that is not all wrong."""
        return fit.reliable or fit.confidence >= self._settings.min_confidence

    def find_trunk(self, body: BodyState) -> F64:
        """Return the middle (3,) of a body's trunk, metres."""
        return np.asarray(self.find_joints(body)[self._trunk].mean(axis=0))

    def find_trunk_pixel(self, puppet: PuppetJoints) -> F64:
        """Return the middle (2,) of a puppet's trunk, pixels; NaN where it has none."""
        places = puppet.pixels[self._trunk]
        places = places[np.isfinite(places).all(axis=1)]
        return np.asarray(places.mean(axis=0)) if len(places) else np.full(2, np.nan)


def make_person(
    cloud: SeenCloud, image: RangeImage | None, own: Bools, floor: Bools, stamp: int, blanks: F64 = NO_BONES
) -> PersonCloud:
    """Return a person's `own` (N,) points with what the sensor can know of the person.

    The floor (N,) hides nobody: who stood below it would be hidden by it, and longer legs would cost nothing. Nothing
    is known around the bones `blanks` (K, 2, 3) m.
    """
    if image is None:
        return PersonCloud(cloud.points[own], None, stamp, cloud.viewpoint, np.flatnonzero(own))
    field = image.make_field(own | floor)
    if len(blanks):
        field = field.doubt_around(blanks, BLANK_RADIUS_M, cloud.points[own])
    points = smooth_depth(image, cloud.points, own)
    return PersonCloud(points, None, stamp, cloud.viewpoint, np.flatnonzero(own), field=field)
