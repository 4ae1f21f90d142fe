# SPDX-License-Identifier: Apache-2.0
"""Silhouettes and triangulated joints of drawn people, with the errors that segmented images and networks have."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from flowing_puppet_ros.arrays import U8, Bools
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame
from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.distance_transform import signed_distance
from flowing_puppet_ros.multiview.triangulation import triangulate

MASK_SIDE_PX = 480  # longest side, as the visual hull segments by default
FRINGE_M, FRINGE_LENGTH_M = 0.015, 0.05
"""Standard deviation of the outline's displacement, and the length along it within which the displacement is alike."""
POCKET_M = 0.02  # gaps of twice that are filled
LOST_PATCH_SHARE, LOST_PATCH_M = 0.25, 0.08
"""Share of silhouettes that lack a patch at the outline, and its radius."""
MIN_MASK_PX = 200
MIN_KEYPOINTS = 6


def draw_people(frames: Sequence[RgbdFrame], rng: np.random.Generator) -> list[SilhouettePerson]:
    """Return what the colour cameras of one moment show of everybody whom two of them see, as p0, p1, ... by number."""
    found = []
    for person in range(len(frames[0].bodies)):
        views = {}
        for number, frame in enumerate(frames):
            view = _draw_mask(frame, person, rng)
            if view is not None and np.isfinite(frame.keypoints[person].pixels).all(axis=1).sum() >= MIN_KEYPOINTS:
                views[f"camera {number}"] = view
        if len(views) < 2:
            continue
        seen = [frame.keypoints[person] for frame in frames]
        points, confidence = triangulate(
            [frame.cameras.colour for frame in frames],
            np.stack([each.pixels for each in seen]),
            np.stack([each.confidence for each in seen]),
        )
        joints = {
            name: (float(x), float(y), float(z), float(sure))
            for name, (x, y, z), sure in zip(LIMB_JOINTS, points, confidence, strict=True)
        }
        found.append(SilhouettePerson(f"p{person}", views, joints))
    return found


def _draw_mask(frame: RgbdFrame, person: int, rng: np.random.Generator) -> tuple[Camera, U8] | None:
    """Return the camera and mask of what an image shows of a person, None for too little; depth is registered to it."""
    own = frame.person == person
    camera = frame.cameras.depth.scale(MASK_SIDE_PX / max(frame.cameras.depth.size))
    small = cv2.resize(own.astype(np.uint8), camera.size, interpolation=cv2.INTER_AREA) > 0
    if np.count_nonzero(small) < MIN_MASK_PX:
        return None
    per_metre = camera.focal / float(np.median(frame.true_depth[own]))
    return camera, _roughen(small, per_metre, rng)


def _roughen(mask: Bools, per_metre: float, rng: np.random.Generator) -> U8:
    size = 2 * round(POCKET_M * per_metre) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disc)
    noise = gaussian_filter(rng.standard_normal(mask.shape), FRINGE_LENGTH_M * per_metre)
    rough = signed_distance(closed) < FRINGE_M * per_metre * noise / noise.std()
    if rng.random() < LOST_PATCH_SHARE:
        edge = np.flatnonzero(rough & (signed_distance(closed) > -1.5))
        row, column = np.unravel_index(edge[rng.integers(len(edge))], mask.shape)
        rows, columns = np.indices(mask.shape)
        rough &= (rows - row) ** 2 + (columns - column) ** 2 > (LOST_PATCH_M * per_metre) ** 2
    return 255 * rough.astype(np.uint8)
