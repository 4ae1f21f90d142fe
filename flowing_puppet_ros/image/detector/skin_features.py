# SPDX-License-Identifier: Apache-2.0
"""Skin features of a pose: on the face, more than around it, and on the chest.

Rigid filters mistake folds of cloth and window frames for heads and shoulders, and those are hardly ever skin.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evidence.image.region import RegionMap

FACE_RADIUS, SURROUND_RADIUS, CHEST_RADIUS = 0.2, 0.45, 0.3  # units of S
CHEST_OFFSET = 0.5  # units of S, of the chest below the neck
_ANGLES = np.arange(16) * (2 * np.pi / 16)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def skin_features(skin: RegionMap, neck: F64, face: F64, scale: float) -> F64:
    """Return the mean log ratio of skin on the face, its excess over the surroundings, and that on the chest: (3,).

    `neck` and `face` (2,) px of the map, `scale` S in px. Points outside the image count as 0.
    """
    chest = neck + np.array([0.0, CHEST_OFFSET * scale])
    circles = [
        centre + radius * scale * _CIRCLE
        for centre, radius in ((face, FACE_RADIUS), (face, SURROUND_RADIUS), (chest, CHEST_RADIUS))
    ]
    on_face, around, on_chest = skin.mean(np.stack(circles))
    return np.array([on_face, on_face - around, on_chest])
