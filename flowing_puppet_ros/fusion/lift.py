# SPDX-License-Identifier: Apache-2.0
"""Joints of a puppet lifted into the cloud: the median depth of the person's own points around each, and some more.

Joints lie within the body, behind the surface that a sensor sees, by a distance that depends on the joint. A joint
without points of the person around it has no depth: it counts across the ray only, as do all others in the end
(`JointTargets.rays`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints, trunk_rows
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
PATH_POINTS, PATH_RADIUS_M = 5, 0.02
"""Points around a place on a limb whose median depth is the surface there, and how far they may be."""
BONES = {
    "face": "neck", "belly": "neck", "shoulder": "neck", "hip": "belly", "elbow": "shoulder", "wrist": "elbow",
    "hand": "wrist", "knee": "hip", "ankle": "knee", "foot": "ankle",
}  # fmt: skip
"""The joint from which a limb leads to each joint."""
BONE_STEPS = 8  # between the joints of a limb, at which the surface is looked up
MAX_JUMP_M = 0.09
"""From one step to the next, beyond which the surface along a limb is not that of one limb."""
MAX_TRUNK_DEPTH_M, MAX_LIMB_DEPTH_M = 0.45, 0.8
"""From the trunk's depth, within which the joints of trunk and limbs are."""


_MIDDLE, _ARM = ("neck", "belly"), ("elbow", "wrist", "hand")


@dataclass(frozen=True, slots=True, eq=False)
class LiftedJoints:
    """Joints in the cloud's frame, in the body model's order.

    Attributes:
        points: (J, 3) metres, NaN where there is no depth.
        rays: (J, 3) unit vectors from the camera to the joints, NaN where unknown.
        confidence: (J,) 0 to 1, that of the puppet, 0 without a depth.
        hidden: (J,) whether the joint is probably not on the surface that is seen at its pixel.
        depth: median depth of the trunk in metres along the camera's axis, NaN without any.
        centre: (3,) metres, where the camera is.
    """

    points: F64
    rays: F64
    confidence: F64
    hidden: Bools
    depth: float
    centre: F64

    @property
    def found(self) -> Bools:
        """Which joints (J,) have a depth."""
        return np.isfinite(self.points).all(axis=1)


def lift_joints(model: StitchedPuppet, puppet: PuppetJoints, cloud: SeenCloud, usable: Bools) -> LiftedJoints:
    """Lift the joints of a puppet into a cloud.

    Args:
        model: the body model.
        puppet: joints in the image of the cloud's camera.
        cloud: the cloud with pixels.
        usable: (N,) which points may be the person's.
    """
    rows = np.flatnonzero(cloud.seen & usable)
    rows = rows[_find_near(puppet, cloud, rows)]
    offsets = np.array([BEHIND_SURFACE_M.get(_kind(name), 0.0) for name in model.joint_names])
    samples = _collect_samples(puppet, cloud, rows)
    trunk = trunk_rows(model)
    depth = _find_trunk_depth(puppet, samples, trunk)
    surface = np.full(len(offsets), np.nan)
    for joint, values in samples.items():
        limit = MAX_TRUNK_DEPTH_M if joint in trunk else MAX_LIMB_DEPTH_M
        near = values[np.abs(values - depth) < limit]
        if len(near) >= MIN_POINTS:
            surface[joint] = np.median(near)
    rays = cloud.camera.cast_rays(puppet.pixels)
    axis = cloud.camera.rotation[2]
    along = surface / (rays @ axis) + offsets
    points = cloud.camera.centre + rays * along[:, None]
    found = np.isfinite(points).all(axis=1)
    hidden = puppet.hidden | _find_broken(model, puppet, cloud, rows, surface)
    return LiftedJoints(points, rays, np.where(found, puppet.confidence, 0.0), hidden, depth, cloud.camera.centre)


def _find_near(puppet: PuppetJoints, cloud: SeenCloud, rows: np.ndarray) -> Bools:
    """Return which of the `rows` (N,) of a cloud may lie around a joint of a puppet, or on the way to one."""
    if not puppet.known.any() or not len(rows):
        return np.zeros(len(rows), dtype=bool)
    known = puppet.pixels[puppet.known]
    outside = np.maximum(known.min(axis=0) - cloud.pixels[rows], cloud.pixels[rows] - known.max(axis=0)).max(axis=1)
    depth = np.maximum(cloud.depth[rows], 1e-3)
    around = outside < np.maximum(MIN_RADIUS_PX, RADIUS_M * cloud.camera.focal / depth)
    if not around.any():
        return around
    return around | (outside < PATH_RADIUS_M * cloud.camera.focal / depth[around].min() + MIN_RADIUS_PX)


def _find_broken(
    model: StitchedPuppet, puppet: PuppetJoints, cloud: SeenCloud, rows: np.ndarray, surface: F64
) -> Bools:
    """Return the joints (J,) on the way to which the surface along the limb breaks off.

    Along a limb that is seen the surface goes on. Where it falls back, the pixel has missed the limb, and what is seen
    there is a neighbour or a wall. Where it jumps forward, something else stands before the limb, unless it is an arm:
    a hand that points at the camera is much nearer than the elbow beside it.
    """
    broken = np.zeros(len(model.joint_names), dtype=bool)
    if not len(rows):
        return broken
    tree = cKDTree(cloud.pixels[rows])
    depth = cloud.depth[rows]
    share = np.linspace(0, 1, BONE_STEPS + 1)[:, None]
    for joint, name in enumerate(model.joint_names):
        kind = _kind(name)
        above = BONES.get(kind, "")
        if not above or not np.isfinite(surface[joint]):
            continue
        start = model.joint_names.index(above if above in _MIDDLE else name.replace(kind, above))
        if not (puppet.known[start] and np.isfinite(surface[start])):
            continue
        path = puppet.pixels[start] + share * (puppet.pixels[joint] - puppet.pixels[start])
        radius = PATH_RADIUS_M * cloud.camera.focal / surface[joint] + MIN_RADIUS_PX
        near, index = tree.query(path, k=PATH_POINTS, distance_upper_bound=radius)
        found = np.isfinite(near).all(axis=1)
        along = np.median(depth[index[found]], axis=1)
        jumps = np.diff(along)
        broken[joint] = bool((jumps > MAX_JUMP_M).any() or (kind not in _ARM and (jumps < -MAX_JUMP_M).any()))
    return broken


def _collect_samples(puppet: PuppetJoints, cloud: SeenCloud, rows: np.ndarray) -> dict[int, F64]:
    """Return for every known joint the depths, in metres, of the points around it."""
    pixels, depth = cloud.pixels[rows], cloud.depth[rows]
    radius = np.maximum(MIN_RADIUS_PX, RADIUS_M * cloud.camera.focal / np.maximum(depth, 1e-3))
    found = {}
    for joint in np.flatnonzero(puppet.known):
        x, y = puppet.pixels[joint]
        near = (np.abs(pixels[:, 0] - x) < radius) & (np.abs(pixels[:, 1] - y) < radius)
        found[int(joint)] = depth[near]
    return found


def _find_trunk_depth(puppet: PuppetJoints, samples: dict[int, F64], trunk: list[int]) -> float:
    """Return the median depth of the trunk, of all joints where the trunk has none, or NaN."""
    for joints in (trunk, list(samples)):
        medians = [np.median(samples[joint]) for joint in joints if len(samples.get(joint, ())) >= MIN_POINTS]
        if medians:
            return float(np.median(medians))
    return float("nan")


def _kind(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")
