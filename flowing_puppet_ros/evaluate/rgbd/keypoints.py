# SPDX-License-Identifier: Apache-2.0
"""Keypoints of synthetic people as a network would give them: noisy pixels, less confident where something hides them.

A joint counts as visible where the surface seen at its pixel is the person's own and not much nearer than the joint
lies beneath the skin. A joint that the person's own body hides, or that somebody else hides, is still guessed, less
precisely and less surely; what lies outside the image is not given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.evaluate.rgbd.rendering import RenderedView
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.pose_networks import BlazePose
from flowing_puppet_ros.image.networks.poses import as_pose
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.multiview.camera import Camera

LIMB_JOINTS = tuple(
    f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
"""The 12 joints of the limbs of COCO's people."""

BENEATH_SKIN_M = {"shoulder": 0.06, "elbow": 0.04, "wrist": 0.025, "hip": 0.10, "knee": 0.055, "ankle": 0.03}
HIDING_DEPTH_M = 0.06  # by which a surface is nearer still, before it hides the joint
VISIBLE_CONFIDENCE, HIDDEN_CONFIDENCE = (0.7, 0.95), (0.2, 0.55)  # ranges, from which they are drawn
HIDDEN_NOISE_FACTOR = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class SeenKeypoints:
    """The keypoints of one person in one image, in the order of LIMB_JOINTS.

    Attributes:
        pixels: (12, 2), NaN for those that are not given.
        confidence: (12,) 0 to 1, 0 for those that are not given.
        visible: (12,) bool, the truth: nothing hides the joint.
        in_view: (12,) bool, the truth: inside the image, and nothing but the person's own body hides it.
        mask: where a network says that the person is, None without one.
    """

    pixels: F64
    confidence: F64
    visible: np.ndarray
    in_view: np.ndarray
    mask: PersonMask | None = None


def find_visible(joints: F64, camera: Camera, view: RenderedView, person: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which of LIMB_JOINTS (12, 3) m, in the world, are visible and which are in view, see `SeenKeypoints`."""
    pixels, depth = camera.project(joints)
    width, height = camera.size
    inside = (
        np.isfinite(pixels).all(axis=1)
        & (pixels > -0.5).all(axis=1)
        & (pixels < (width - 0.5, height - 0.5)).all(axis=1)
    )
    column, row = np.where(inside[:, None], np.rint(np.nan_to_num(pixels)), 0).astype(np.int64).T
    beneath = np.array([BENEATH_SKIN_M[name.partition("_")[2]] for name in LIMB_JOINTS])
    seen, owner = view.depth[row, column], view.person[row, column]
    nearer = depth - beneath - seen > HIDING_DEPTH_M
    return inside & ~nearer, inside & (~nearer | (owner == person))


def draw_keypoints(
    rng: np.random.Generator, joints: F64, camera: Camera, visible: np.ndarray, in_view: np.ndarray, noise: float
) -> SeenKeypoints:
    """Draw the keypoints of LIMB_JOINTS (12, 3) m, in the world; `noise` px is their standard deviation per axis."""
    pixels = camera.project(joints)[0]
    deviation = noise * np.where(visible, 1.0, HIDDEN_NOISE_FACTOR)
    pixels = pixels + deviation[:, None] * rng.standard_normal(pixels.shape)
    low, high = np.where(visible[:, None], VISIBLE_CONFIDENCE, HIDDEN_CONFIDENCE).T
    confidence = low + (high - low) * rng.random(len(pixels))
    width, height = camera.size
    given = (
        np.isfinite(pixels).all(axis=1)
        & (pixels > -0.5).all(axis=1)
        & (pixels < (width - 0.5, height - 0.5)).all(axis=1)
    )
    return SeenKeypoints(np.where(given[:, None], pixels, np.nan), np.where(given, confidence, 0.0), visible, in_view)


def segment_person(network: BlazePose, rgb: U8, person: SeenKeypoints) -> SeenKeypoints:
    """Return the keypoints of a person in an image (H, W, 3) with the mask that a network finds where they are."""
    pose = as_pose(Keypoints(LIMB_JOINTS, person.pixels, person.confidence))
    return person if pose is None else replace(person, mask=network.locate(rgb, pose).mask)
