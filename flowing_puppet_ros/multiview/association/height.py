# SPDX-License-Identifier: Apache-2.0
"""How tall people are, from the lengths of their legs and trunks; it tells a wrong unit and which way is up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64

_SHARE_OF_HEIGHT = 0.246 + 0.245 + 0.288
"""Shank, thigh and trunk from hip to shoulder in a person's height (Drillis and Contini 1966)."""
_CHAIN = (("ankle", "knee"), ("knee", "hip"), ("hip", "shoulder"))


def measure_height(names: Sequence[str], joints: F64) -> float:
    """Return the height (m) of a person whose joints (T, J, 3), called `names`, are known at T instants; NaN if not.

    Median lengths over both sides and all instants, so bent legs do not matter.
    """
    place = {name: index for index, name in enumerate(names)}
    total = 0.0
    for low, high in _CHAIN:
        lengths = [
            np.linalg.norm(joints[:, place[f"{side}_{low}"]] - joints[:, place[f"{side}_{high}"]], axis=1)
            for side in ("left", "right")
            if f"{side}_{low}" in place and f"{side}_{high}" in place
        ]
        known = np.concatenate(lengths) if lengths else np.zeros(0)
        known = known[np.isfinite(known)]
        if not len(known):
            return float("nan")
        total += float(np.median(known))
    return total / _SHARE_OF_HEIGHT


def find_up(names: Sequence[str], joints: F64) -> F64:
    """Return the unit direction (3,) from people's ankles to their shoulders, joints (T, J, 3); NaN if unknown."""
    ankles = [index for index, name in enumerate(names) if name.endswith("ankle")]
    shoulders = [index for index, name in enumerate(names) if name.endswith("shoulder")]
    upward = joints[:, shoulders].mean(axis=1) - joints[:, ankles].mean(axis=1)
    upward = upward[np.isfinite(upward).all(axis=1)]
    if not len(upward):
        return np.full(3, np.nan)
    mean = np.median(upward / np.linalg.norm(upward, axis=1, keepdims=True), axis=0)
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-9))
