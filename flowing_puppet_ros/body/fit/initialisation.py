# SPDX-License-Identifier: Apache-2.0
"""Starts of a fit: bodies sampled with unknown yaw, bodies placed on given joints, and bodies with opposite heading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

# The joint at the far end of every part, which gives its direction.
FAR_JOINT = {
    "shoulder": "shoulder",
    "upper_arm": "elbow",
    "lower_arm": "wrist",
    "hand": "hand",
    "upper_leg": "knee",
    "lower_leg": "ankle",
    "foot": "toe",
}
# Joints that the torso determines, by which it is aligned.
TRUNK_JOINTS = (
    "neck",
    "belly",
    "pelvis",
    "right_shoulder",
    "left_shoulder",
    "right_hip",
    "left_hip",
    "face",
    "nose",
    "head_top",
)
MIN_JOINTS = 4  # known to the model and finite
START_WEIGHT = 0.1  # factor of the targets' weights
# Second singular value of centred joints, below which they lie on a line.
MIN_OFF_LINE_M = 0.05
# Without a cloud, targets and priors must place the whole body.
JOINTS_ONLY = RefineWeights(
    stitch=1.0, pose=1e-5, shape=3e-5, pairwise=1e-5, sigma_start=0.4, sigma_end=0.08, iterations=15
)


def make_joint_targets(model: StitchedPuppet, initial: Mapping[str, tuple[float, float, float, float]]) -> JointTargets:
    """Turn named joints (x, y, z in metres, confidence 0 to 1) into targets weighted by confidence.

    Unknown names and joints with NaN are left out.

    Raises:
        InputError: when fewer than four joints remain or all lie on a line, which does not determine a body.
    """
    points, weight = np.zeros((len(model.joint_names), 3)), np.zeros(len(model.joint_names))
    for name, values in initial.items():
        if name in model.joint_names and np.all(np.isfinite(values)) and values[3] > 0:
            points[model.joint_names.index(name)] = values[:3]
            weight[model.joint_names.index(name)] = min(float(values[3]), 1.0)
    if np.count_nonzero(weight) < MIN_JOINTS:
        raise InputError(
            f"only {np.count_nonzero(weight)} of the {len(initial)} initial joints are finite joints of the body model,"
            f" and a start needs {MIN_JOINTS}; give more joints or none"
        )
    if not _span_a_plane(points[weight > 0]):
        raise InputError("the initial joints lie on a line, so the body's heading is unknown; give more joints or none")
    return JointTargets(points, weight)


def body_from_joints(
    model: StitchedPuppet, refiner: GaussNewton, targets: JointTargets, steps: int = JOINTS_ONLY.iterations
) -> BodyState:
    """Place all parts so that the model's joints lie on the targets, in so many `steps` of Gauss-Newton.

    The trunk is aligned by Procrustes, every other part takes the shortest rotation towards its far joint, and
    Gauss-Newton without a cloud adjusts lengths, twists and bends. Parts without targets follow their parents.
    """
    rest = model.rest_state()
    template = model.joints(model.vertices(rest))
    start = _align_trunk(model, rest, template, targets)
    for part in range(1, len(model.tree)):
        _attach(model, start, part, rest, template, targets)
    return refiner.run(start, None, targets.scale(START_WEIGHT), replace(JOINTS_ONLY, iterations=steps))


def _span_a_plane(points: np.ndarray) -> bool:
    """Return whether points (K, 3) in metres are far enough from a common line to give a body's heading."""
    return len(points) >= 3 and float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]) > MIN_OFF_LINE_M


def _align_trunk(model: StitchedPuppet, rest: BodyState, template: np.ndarray, targets: JointTargets) -> BodyState:
    """Return `rest`, with joints `template` (J, 3), moved rigidly so that its trunk's joints lie on the targets."""
    known = targets.weight > 0
    trunk = known & np.array([name in TRUNK_JOINTS for name in model.joint_names])
    used = trunk if _span_a_plane(targets.points[trunk]) else known
    rotation, center = so3.procrustes(template[used], targets.points[used], targets.weight[used])
    return BodyState(rest.center @ rotation.T + center, rotation @ rest.rotation, rest.pose.copy(), rest.shape.copy())


def _attach(
    model: StitchedPuppet, state: BodyState, part: int, rest: BodyState, template: np.ndarray, targets: JointTargets
) -> None:
    """Attach a part to its parent, in place, and rotate it towards the target of its far joint."""
    parent, name = model.tree.parents[part], model.tree.names[part]
    interface = model.interfaces[part - 1]
    above = model.part_mesh(
        parent, state.center[parent], state.rotation[parent], state.pose[parent], state.shape[parent]
    )
    near = above[interface.parent_index].mean(axis=0)
    own_near = model.local_vertices(part, state.pose[part], state.shape[part])[interface.child_index].mean(axis=0)
    rotation = state.rotation[parent] @ rest.rotation[parent].T @ rest.rotation[part]
    side, _, kind = name.partition("_")
    far = f"{side}_{FAR_JOINT[kind]}" if kind else "face"
    joint = model.joint_names.index(far) if far in model.joint_names else -1
    if joint >= 0 and targets.weight[joint] > 0:
        own_far = (template[joint] - rest.center[part]) @ rest.rotation[part]
        rotation = _shortest_rotation(rotation @ (own_far - own_near), targets.points[joint] - near) @ rotation
    state.rotation[part] = rotation
    state.center[part] = near - rotation @ own_near


def _shortest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by the smallest angle that takes the direction of a (3,) to that of b (3,)."""
    a, b = a / max(np.linalg.norm(a), 1e-12), b / max(np.linalg.norm(b), 1e-12)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
    return so3.exp(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))


def sample_bodies(model: StitchedPuppet, center: np.ndarray, count: int, rng: np.random.Generator) -> list[BodyState]:
    """Sample upright bodies of mean shape with the torso at `center` (3,) and uniformly random yaw.

    The yaws are spread evenly with one random offset, so that no quarter of the circle is left out.
    """
    bodies = []
    yaws = 2 * np.pi * (rng.random() + rng.permutation(count)) / count
    for yaw in yaws:
        body = model.sample(rng, shape_scale=0.0)
        rotation = so3.exp(np.array([0.0, 0.0, yaw]))
        centers = (body.center - body.center[0]) @ rotation.T + center
        bodies.append(BodyState(centers, rotation @ body.rotation, body.pose, body.shape))
    return bodies


def flip_heading(model: StitchedPuppet, state: BodyState) -> BodyState:
    """Return the body with the opposite heading, its left limbs in place of the right ones and vice versa.

    Every part is rotated by half a turn about the vertical through its centre; deformations are reset.
    """
    mirror = list(model.tree.mirror)
    half = np.diag([-1.0, -1.0, 1.0])
    rotation = state.rotation[mirror] @ half
    return BodyState(state.center[mirror], rotation, np.zeros_like(state.pose), state.shape[mirror])
