# SPDX-License-Identifier: Apache-2.0
"""Joints that count less in a view: put on somebody else by the camera's tracker, or hidden by somebody else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.view import CalibratedView

_NEAR_OTHER_M = 0.12  # from a ray to a joint of somebody else, of any name
_FAR_FROM_OWN_M = 0.20  # from the same ray to where the joint is expected
_IN_FRONT_M = 0.25  # of a joint, for somebody else to hide it
_LIMB_RADIUS_M = 0.12  # of limbs and trunk between their joints
_HIDDEN_SHARE = 0.25  # of the confidence that a hidden joint keeps
_SAMPLES = np.linspace(0.0, 1.0, 5)[:, None, None]  # along a bone


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


def doubt_hidden_joints(
    view: CalibratedView, own: F64, others: Sequence[F64], bones: Sequence[tuple[int, int]]
) -> CalibratedView:
    """Return the view with less confidence in the joints `own` (J, 3) m before which somebody else's limb or trunk is.

    `others` are their joints (J, 3) m, NaN where unknown, and `bones` the pairs of joints between which limbs are.
    """
    if not (others and len(bones)):
        return view
    local = view.camera.to_camera(own)
    first, second = np.array(bones).T
    ends = [view.camera.to_camera(joints) for joints in others]
    limbs = np.concatenate([(each[first] + _SAMPLES * (each[second] - each[first])).reshape(-1, 3) for each in ends])
    limbs = limbs[np.isfinite(limbs).all(axis=1)]
    limbs = limbs[limbs[:, 2] > 0]
    # Where the ray to each joint passes at the depth of each point of a limb.
    ray = local[:, None, :2] / np.where(local[:, 2:] > 0, local[:, 2:], np.nan)[:, None]
    aside = np.linalg.norm(ray * limbs[None, :, 2:] - limbs[None, :, :2], axis=2)
    hidden = ((aside < _LIMB_RADIUS_M) & (limbs[None, :, 2] < local[:, None, 2] - _IN_FRONT_M)).any(axis=1)
    return replace(view, weight=np.where(hidden, _HIDDEN_SHARE * view.weight, view.weight)) if hidden.any() else view
