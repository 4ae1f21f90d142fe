# SPDX-License-Identifier: Apache-2.0
"""Joints that a camera's tracker has put on somebody else: they do not count for the person whose view it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.view import CalibratedView

_NEAR_OTHER_M = 0.12  # from a ray to a joint of somebody else, of any name
_FAR_FROM_OWN_M = 0.20  # from the same ray to where the joint is expected


def doubt_joints_on_others(view: CalibratedView, own: F64, others: Sequence[F64]) -> CalibratedView:
    """Return the view without the joints that lie on one of `others` and not where `own` is expected.

    Joints are (J, 3) m, NaN where unknown.
    """
    if not others:
        return view
    distance = view.measure_distances(own)
    suspicious = ~(distance < _FAR_FROM_OWN_M) & np.isfinite(view.plane).all(axis=1)
    if not suspicious.any():
        return view
    nearest = np.full(len(distance), np.inf)
    for joints in others:
        local = view.camera.to_camera(joints[np.isfinite(joints).all(axis=1)])
        local = local[local[:, 2] > 0]
        if len(local):
            offset = local[None, :, :2] - view.plane[:, None] * local[None, :, 2:]
            nearest = np.minimum(nearest, np.nan_to_num(np.linalg.norm(offset, axis=2), nan=np.inf).min(axis=1))
    doubted = suspicious & (nearest < _NEAR_OTHER_M) & (nearest < distance)
    return replace(view, weight=np.where(doubted, 0.0, view.weight)) if doubted.any() else view
