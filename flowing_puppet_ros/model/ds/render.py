# SPDX-License-Identifier: Apache-2.0
"""Layered drawing of 2D puppets: a fixed depth order of the parts and a label image (thesis, "Flowing Puppets")."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

_FAR_TO_NEAR = ("upper_leg", "lower_leg", "foot", "torso", "head", "upper_arm", "lower_arm", "hand")
SIDEWAYS_HEADING = np.radians(40.0)
"""Heading in radians from which the limbs of the far side are drawn behind the torso."""

_SUBPIXEL_BITS = 4  # fractional bits of the contours that OpenCV fills
_MAX_COORDINATE_PX = 1e5  # contours are clipped here, or OpenCV's fixed-point coordinates would overflow


def depth_order(model: DeformableStructures, view: View = "front", heading: float = 0.0) -> tuple[int, ...]:
    """Return the part indices from far to near: legs, torso, head, right and left upper arms, lower arms, hands.

    From behind, the order is reversed. A person rotated far from the camera, by `heading` radians towards the right of
    the image, has the limbs of the far side behind the torso.
    """
    far_side = "" if abs(heading) < SIDEWAYS_HEADING else "left_" if heading > 0 else "right_"

    def layer(part: int) -> tuple[bool, int, bool]:
        name = model.tree.names[part]
        far = bool(far_side) and name.startswith(far_side)
        return not far, _FAR_TO_NEAR.index(name.removeprefix("right_").removeprefix("left_")), name.startswith("left_")

    order = tuple(sorted(range(len(model.tree)), key=layer))
    return order if view == "front" else order[::-1]


def render_labels(contours: Sequence[Array], order: Sequence[int], shape: tuple[int, int]) -> Array:
    """Draw part labels (H, W) uint8: 0 for the background, otherwise part index + 1 of the nearest part.

    `contours` (K, 2) px per part, `order` part indices from far to near, `shape` (H, W).
    """
    labels = np.zeros(shape, np.uint8)
    for part in order:
        points = np.clip(contours[part], -_MAX_COORDINATE_PX, _MAX_COORDINATE_PX)
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(labels, [fixed], part + 1, shift=_SUBPIXEL_BITS)
    return labels
