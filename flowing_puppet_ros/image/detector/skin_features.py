# SPDX-License-Identifier: Apache-2.0
"""How much of a pose is skin: on the face, more than around it, and on the chest.

Rigid filters take folds of cloth and window frames for heads and shoulders; hardly ever are those skin.
"""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evidence.image.region import RegionMap

FACE, AROUND, CHEST, CHEST_BELOW = 0.2, 0.45, 0.3, 0.5  # units of S; the chest lies below the neck
_TURNS = np.arange(16) * (2 * np.pi / 16)
_CIRCLE = np.stack([np.cos(_TURNS), np.sin(_TURNS)], axis=1)


def skin_features(skin: RegionMap, neck: F64, face: F64, scale: float) -> F64:
    """Mean log ratio of skin on the face, how much it exceeds that around it, and that on the chest: (3,).

    `neck` and `face` (2,) px of the map, `scale` S in px. 0 where the image ends.
    """
    chest = neck + np.array([0.0, CHEST_BELOW * scale])
    circles = [centre + radius * scale * _CIRCLE for centre, radius in ((face, FACE), (face, AROUND), (chest, CHEST))]
    on_face, around, on_chest = skin.mean(np.stack(circles))
    return np.array([on_face, on_face - around, on_chest])
