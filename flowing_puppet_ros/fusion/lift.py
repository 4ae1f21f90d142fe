# SPDX-License-Identifier: Apache-2.0
"""Joints of a puppet lifted into the cloud: the median depth of the person's own points around each, and some more.

Joints lie within the body, behind the surface that a sensor sees, by a distance that depends on the joint. A joint
without points of the person around it has no depth: it counts across the ray only, as do all others in the end
(`JointTargets.rays`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.fusion.limb_depths import (
    CHAINS,
    HALF_SEEN_CONFIDENCE,
    LIMB_REACH_M,
    TRUNK_REACH_M,
    DepthChoices,
    choose_depths,
    list_choices,
    measure_seen_share,
)
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, list_bones, measure_distance_by_size, trunk_rows
from flowing_puppet_ros.fusion.seen_cloud import SeenCloud
from flowing_puppet_ros.model.sp import StitchedPuppet

BEHIND_SURFACE_M = {
    "shoulder": 0.06, "elbow": 0.04, "wrist": 0.025, "hand": 0.02, "hip": 0.10, "knee": 0.055, "ankle": 0.03,
    "foot": 0.03, "neck": 0.06, "belly": 0.11, "face": 0.09,
}  # fmt: skip
"""Distance along the ray from the seen surface to each joint."""
RADIUS_M, MIN_RADIUS_PX = 0.04, 2.5
"""Around a joint, within which the person's points give its depth."""
MIN_POINTS = 3
MISSED_FACTOR = 2.0
"""Of the radius around a sure joint of somebody known, where none of the person's points are: its pixel is beside a
thin limb. Of somebody new it takes too much for a limb."""
SURFACE_GAP_M, MIN_SURFACE_SHARE, MAX_SURFACES = 0.08, 0.15, 3
"""Between the depths of two surfaces, share of a surface in the points around a joint, and how many there may be."""
MIN_EXPECTED_POINTS, BLANK_SHARES = 9.0, (0.05, 0.5)
"""Points along a bone, if as dense as in the whole image, from which on it may be blank, and the shares of them below
which it is: of the person's own, and of all."""
CHOSEN = {name for chain in CHAINS for name in chain}
"""Joints whose depth is chosen among several."""
MAX_JUMP_M, MAX_EXPECTED_GAP_M, MIN_EXPECTED = 0.12, 0.3, 3
"""Between the rays and where their joints are expected: the median of all and that of one, beyond which the depths
there tell nothing; and joints of the trunk that tell its depth."""
SAME_PLACE_M, MIN_TRUNK_GAP_M, MIN_OTHER_CONFIDENCE = 0.12, 0.1, 0.3
"""Between the joints of two people of which one was lifted onto the other, by how much it is nearer to the other's
trunk than to its own along the axis, and what a joint that may be the other's counts at least."""
MIN_SIZE_BONES, SIZE_CONFIDENCE, SIZE_DEVIATION = 3, 0.3, 0.3
"""Bones between joints of this confidence that tell how far away somebody is, at least, and the standard deviation of
the logarithm of that distance: people differ, and bend."""
MAX_TRUNK_DEPTH_M, MAX_LIMB_DEPTH_M = 0.45, 0.8
"""From the trunk's depth, within which the joints of trunk and limbs are."""


@dataclass(frozen=True, slots=True, eq=False)
class LiftedJoints:
    """Joints in the cloud's frame, in the body model's order.

    Attributes:
        points: (J, 3) metres, NaN where there is no depth.
        rays: (J, 3) unit vectors from the camera to the joints, NaN where unknown.
        confidence: (J,) 0 to 1, that of the puppet, 0 without a depth.
        hidden: (J,) whether the joint is probably not on the surface that is seen at its pixel.
        blank: (J,) whether the puppet is sure of the joint and the sensor has no value around it, as on black clothes.
        depth: median depth of the trunk in metres along the camera's axis, NaN without any.
        centre: (3,) metres, where the camera is.
        choices: of the limbs' joints, the places that each may have, by its number.
    """

    points: F64
    rays: F64
    confidence: F64
    hidden: Bools
    blank: Bools
    depth: float
    centre: F64
    choices: Mapping[int, DepthChoices]

    @property
    def found(self) -> Bools:
        """Which joints (J,) have a depth."""
        return np.isfinite(self.points).all(axis=1)

    @property
    def guessed(self) -> Bools:
        """Which joints (J,) have a depth that no surface at their pixel tells."""
        return self.hidden | self.blank


def lift_joints(
    model: StitchedPuppet, puppet: PuppetJoints, cloud: SeenCloud, usable: Bools, expected: F64 | None = None
) -> LiftedJoints:
    """Lift the joints of a puppet into a cloud.

    Args:
        model: the body model.
        puppet: joints in the image of the cloud's camera.
        cloud: the cloud with pixels.
        usable: (N,) which points may be the person's.
        expected: (J, 3) metres, where the joints should be, None for a person who is new.
    """
    kinds = [_kind(name) for name in model.joint_names]
    offsets = np.array([BEHIND_SURFACE_M.get(kind, 0.0) for kind in kinds])
    rays, axis, centre = cloud.camera.cast_rays(puppet.pixels), cloud.camera.rotation[2], cloud.camera.centre
    samples, beyond = _collect_samples(puppet, cloud, usable, np.flatnonzero(puppet.known))
    outside = _find_outside(puppet, cloud)
    trunk = trunk_rows(model)
    should = _expect_depths(expected, rays, cloud)
    likely = float("nan") if expected is not None else _find_likely_depth(model, puppet, samples, rays, axis)
    depth = _find_trunk_depth(puppet, samples, trunk, should[trunk], likely)
    missed = _find_missed(samples, depth)
    blank = _find_blank(list_bones(model), puppet, cloud, usable, missed, depth) & ~outside
    if expected is not None:
        missed = missed[puppet.confidence[missed] >= HALF_SEEN_CONFIDENCE]
        samples.update(_collect_samples(puppet, cloud, usable, missed, MISSED_FACTOR)[0])
    points = np.full((len(offsets), 3), np.nan)
    hidden, seen_share = puppet.hidden.copy(), measure_seen_share(puppet.confidence, puppet.hidden)
    choices: dict[int, DepthChoices] = {}
    for joint, values in samples.items():
        near_trunk = joint in trunk
        near = values[np.abs(values - depth) < (MAX_TRUNK_DEPTH_M if near_trunk else MAX_LIMB_DEPTH_M)]
        near = near[:0] if blank[joint] else near
        chosen = kinds[joint] in CHOSEN
        if len(near) < MIN_POINTS and not (
            chosen and _may_be_there(values, beyond[joint], bool(outside[joint] | blank[joint]), depth)
        ):
            continue
        if not chosen:
            along = _find_median(near) / (rays[joint] @ axis) + offsets[joint]
            points[joint] = centre + rays[joint] * along
            continue
        choices[joint] = list_choices(
            rays[joint], axis, centre, _find_surfaces(near), offsets[joint], depth,
            TRUNK_REACH_M if near_trunk else LIMB_REACH_M, seen_share[joint], should[joint],
        )  # fmt: skip
    for joint, choice in choose_depths(model, choices).items():
        points[joint] = choices[joint].points[choice]
        hidden[joint] |= not (choices[joint].seen[choice] or blank[joint])
    found = np.isfinite(points).all(axis=1)
    confidence = np.where(found, puppet.confidence, 0.0)
    return LiftedJoints(points, rays, confidence, hidden, blank, depth, centre, choices)


def find_lifted_onto_others(people: Sequence[LiftedJoints], axis: F64) -> list[Bools]:
    """Return which joints (J,) of each of the people of one image were probably lifted onto another of them.

    Where an arm is behind a neighbour's, a network may take that for it, and be sure. The neighbour has a joint there,
    and a trunk that is clearly nearer to it along the camera's `axis` (3,).
    """
    found = []
    depth = [(joints.points - joints.centre) @ axis for joints in people]
    for own, (joints, along) in enumerate(zip(people, depth, strict=True)):
        onto = np.zeros(len(along), dtype=bool)
        for other, theirs in enumerate(people):
            sure = theirs.found & ~theirs.hidden & (theirs.confidence >= MIN_OTHER_CONFIDENCE)
            if other == own or not sure.any():
                continue
            gap = np.linalg.norm(joints.points[:, None] - theirs.points[sure], axis=2).min(axis=1)
            nearer = np.abs(along - theirs.depth) + MIN_TRUNK_GAP_M < np.abs(along - joints.depth)
            onto |= (gap < SAME_PLACE_M) & nearer
        found.append(onto)
    return found


def _expect_depths(expected: F64 | None, rays: F64, cloud: SeenCloud) -> F64:
    """Return the depths (J,) m of `expected` joints, NaN where the puppet sees most of them, or this one, elsewhere."""
    if expected is None:
        return np.full(len(rays), np.nan)
    place = expected - cloud.camera.centre
    across = np.linalg.norm(np.cross(place, rays), axis=1)
    known = across[np.isfinite(across)]
    jumped = not len(known) or np.median(known) > MAX_JUMP_M
    return np.where(jumped | ~(across < MAX_EXPECTED_GAP_M), np.nan, place @ cloud.camera.rotation[2])


def _find_outside(puppet: PuppetJoints, cloud: SeenCloud) -> Bools:
    """Return which joints (J,) of a puppet lie outside of the rectangle of a cloud's pixels."""
    low, high = cloud.rectangle
    with np.errstate(invalid="ignore"):
        return np.asarray(((puppet.pixels < low) | (puppet.pixels > high)).any(axis=1))


def _find_blank(
    bones: Sequence[tuple[int, int]], puppet: PuppetJoints, cloud: SeenCloud, usable: Bools, missed: I64, depth: float
) -> Bools:
    """Return which joints (J,) end a bone of which the sensor has no values, though a puppet is sure of one end.

    Black clothes and hair swallow the light of depth sensors, and the sun outshines it.

    Args:
        bones: the rows of the joints at the ends of each.
        puppet: the puppet.
        cloud: the cloud with pixels.
        usable: (N,) which points may be the person's.
        missed: joints without points of the person.
        depth: of the trunk, metres, NaN where unknown.
    """
    blank = np.zeros(len(puppet.confidence), dtype=bool)
    if not len(missed) or not np.isfinite(depth):
        return blank
    low, high = cloud.rectangle
    density = np.count_nonzero(cloud.seen) / max(float(np.prod(high - low)), 1.0)
    radius, sure = RADIUS_M * cloud.camera.focal / depth, puppet.confidence >= HALF_SEEN_CONFIDENCE
    for ends in bones:
        if not (puppet.known[list(ends)].all() and sure[list(ends)].any() and np.isin(ends, missed).any()):
            continue
        line = puppet.pixels[list(ends)]
        rows = _find_along(line, cloud.pixels, radius)
        expected = density * 2 * radius * float(np.linalg.norm(line[1] - line[0]))
        if expected < MIN_EXPECTED_POINTS or len(rows) >= BLANK_SHARES[1] * expected:
            continue
        own = usable[rows] & (np.abs(cloud.depth[rows] - depth) < MAX_LIMB_DEPTH_M)
        if np.count_nonzero(own) < BLANK_SHARES[0] * expected:
            blank[[joint for joint in ends if joint in missed]] = True
    return blank


def _find_along(line: F64, pixels: F64, radius: float) -> I64:
    """Return the rows of `pixels` (N, 2) that are within a `radius` in pixels from a `line` (2, 2) between its ends."""
    with np.errstate(invalid="ignore"):
        low, high = line.min(axis=0) - radius, line.max(axis=0) + radius
        x, y = pixels[:, 0], pixels[:, 1]
        rows = np.flatnonzero((x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]))
    along = (line[1] - line[0]) / max(float(np.linalg.norm(line[1] - line[0])), 1e-9)
    place = pixels[rows] - line[0]
    inside = (place @ along >= 0) & ((pixels[rows] - line[1]) @ along <= 0)
    return rows[inside & (np.abs(place @ np.array([-along[1], along[0]])) < radius)]


def _may_be_there(own: F64, others: F64, unseen: bool, depth: float) -> bool:
    """Return whether a joint without points of the person around it may be at its pixel all the same.

    It may where the sensor shows nothing, and where the person's points are mistaken for somebody else's, as feet for
    the floor. Where the sensor sees the wall, there is no limb.

    Args:
        own: (N,) metres, depths of points around the joint that may be the person's.
        others: (M,) metres, those of all others.
        unseen: whether the pixel lies outside of the cloud's, or the puppet is sure where these are blank.
        depth: of the trunk, metres, NaN where unknown.
    """
    if not np.isfinite(depth):
        return False
    if unseen:
        return True
    seen = np.concatenate([own, others])
    return len(seen) >= MIN_POINTS and bool(seen.max() < depth + MAX_LIMB_DEPTH_M)


@njit(cache=True, nogil=True)
def _find_surfaces(depth: F64) -> F64:
    """Return the depths (K,) of the surfaces to which depths (N,) belong, the one with the most points first."""
    if len(depth) < MIN_POINTS:
        return np.empty(0)
    ordered = np.sort(depth)
    ends = np.append(np.flatnonzero(np.diff(ordered) > SURFACE_GAP_M) + 1, len(ordered))
    size = np.diff(np.append(np.zeros(1, np.int64), ends))
    chosen = np.argsort(-size, kind="mergesort")
    chosen = chosen[size[chosen] >= max(float(MIN_POINTS), MIN_SURFACE_SHARE * len(ordered))][:MAX_SURFACES]
    if not len(chosen):
        return np.full(1, np.median(ordered))
    found = np.empty(len(chosen))
    for k, group in enumerate(chosen):
        found[k] = np.median(ordered[ends[group] - size[group] : ends[group]])
    return found


def _find_missed(samples: Mapping[int, F64], depth: float) -> I64:
    """Return the joints that have too few points around them near the trunk's `depth`."""
    return np.array(
        [
            joint
            for joint, values in samples.items()
            if np.count_nonzero(np.abs(values - depth) < MAX_LIMB_DEPTH_M) < MIN_POINTS
        ],
        dtype=np.int64,
    )


def _collect_samples(
    puppet: PuppetJoints, cloud: SeenCloud, usable: Bools, known: I64, factor: float = 1.0
) -> tuple[dict[int, F64], dict[int, F64]]:
    """Return for the `known` joints the depths, in metres, of the `usable` (N,) points around each, and of the others.

    They are within `factor` of the usual radius.
    """
    if not len(known):
        return {}, {}
    joint, row = _find_around(puppet.pixels[known], cloud.pixels, cloud.depth, factor * cloud.camera.focal)
    own, depth = usable[row], cloud.depth[row]
    return (
        {int(number): depth[(joint == k) & own] for k, number in enumerate(known)},
        {int(number): depth[(joint == k) & ~own] for k, number in enumerate(known)},
    )


@njit(cache=True, nogil=True)
def _find_around(joints, pixels, depth, focal):  # type: ignore[no-untyped-def]
    """Return the joint and the row of every pair of one of `joints` (K, 2) and one of the `pixels` (N, 2) around it."""
    found_joint, found_row, count = np.empty(1024, np.int64), np.empty(1024, np.int64), 0
    low_x, high_x = joints[:, 0].min(), joints[:, 0].max()
    low_y, high_y = joints[:, 1].min(), joints[:, 1].max()
    reach = RADIUS_M * focal
    for row in range(len(pixels)):
        x, y, far = pixels[row, 0], pixels[row, 1], max(depth[row], 1e-3)
        aside = max(max(low_x - x, x - high_x), max(low_y - y, y - high_y))
        # Not so for points that are not seen, whose pixels are NaN.
        if not (aside < MIN_RADIUS_PX or aside * far < reach):
            continue
        radius = max(MIN_RADIUS_PX, reach / far)
        for k in range(len(joints)):
            if abs(x - joints[k, 0]) < radius and abs(y - joints[k, 1]) < radius:
                if count == len(found_row):
                    found_joint = np.append(found_joint, np.empty(count, np.int64))
                    found_row = np.append(found_row, np.empty(count, np.int64))
                found_joint[count], found_row[count] = k, row
                count += 1
    return found_joint[:count], found_row[:count]


def _find_likely_depth(
    model: StitchedPuppet, puppet: PuppetJoints, samples: Mapping[int, F64], rays: F64, axis: F64
) -> float:
    """Return the depth, metres, at which most joints have a surface, and that the size in the image makes likely.

    Who stands behind a counter is neither on it, though the hips and knees are seen there, nor at the wall, though that
    is beside the shoulders. Joints count by their squared confidence. NaN where no joint has a surface.
    """
    surfaces = {joint: _find_surfaces(values) for joint, values in samples.items()}
    places = np.concatenate([np.empty(0), *surfaces.values()])
    if not len(places):
        return float("nan")
    votes = np.zeros(len(places))
    for joint, own in surfaces.items():
        near = (np.abs(places[:, None] - own) < MAX_TRUNK_DEPTH_M).any(axis=1)
        votes += np.where(near, puppet.confidence[joint] ** 2, 0.0)
    sure = puppet.known & (puppet.confidence >= SIZE_CONFIDENCE)
    distance = measure_distance_by_size(model, rays, sure, MIN_SIZE_BONES)
    if np.isfinite(distance):
        apparent = distance * float(np.median(rays[sure] @ axis))
        votes *= np.exp(-0.5 * (np.log(places / apparent) / SIZE_DEVIATION) ** 2)
    return float(places[votes.argmax()])


def _find_trunk_depth(
    puppet: PuppetJoints, samples: Mapping[int, F64], trunk: list[int], expected: F64, likely: float
) -> float:
    """Return the median depth of the trunk, of all joints where the trunk has none, or NaN.

    Joints count by their squared confidence, and where the cloud is near the `expected` depths (J,) m of the trunk's
    joints, NaN where there is none; near the `likely` one where most have none.
    """
    known_before = np.count_nonzero(np.isfinite(expected)) >= MIN_EXPECTED
    middle = float(np.nanmean(expected)) if known_before else likely
    for joints in (trunk, list(samples)):
        known = {joint: samples[joint] for joint in joints if len(samples.get(joint, ())) >= MIN_POINTS}
        near = {joint: values[np.abs(values - middle) < MAX_TRUNK_DEPTH_M] for joint, values in known.items()}
        known = {joint: values for joint, values in near.items() if len(values) >= MIN_POINTS} or known
        if known:
            depth = np.array([_find_median(values) for values in known.values()])
            return _find_weighted_median(depth, puppet.confidence[list(known)] ** 2)
    return float("nan")


@njit(cache=True, nogil=True)
def _find_median(values: F64) -> float:
    """Return the median of values (N,), in a tenth of NumPy's time for as few."""
    return float(np.median(values))


def _find_weighted_median(values: F64, weight: F64) -> float:
    """Return the least of the values (N,) up to which lies half of the weight (N,), or more."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _kind(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")
