# SPDX-License-Identifier: Apache-2.0
"""Smoothing of joints over time along the optical flow: it keeps motion, and removes only what the flow contradicts.

For every joint the positions x_t minimise

    sum_t c_t rho(x_t - p_t; a) + lambda sum_t w_t rho(x_{t+1} - x_t - f_t; b)

with the detected positions p_t of confidence c_t, the flow f_t there, its forward-backward agreement w_t and Huber's
rho of widths a and b: a tridiagonal system per joint, solved by iterative reweighting. Smoothing without the flow
trades jitter for error.
"""

from __future__ import annotations

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, F64
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.settings import SmoothingSettings

REWEIGHTINGS = 6  # iterations of the robust fit
DISAGREEMENT_PX = 2.0  # on the flow's grid; a flow with this forward-backward error counts half
_START_WEIGHT = 1e-6  # keeps joints with neither detection nor flow at their start


def flow_at_joints(flow: FlowPair, grid: ImageScale, before: F64, after: F64) -> tuple[F64, F64]:
    """Return the motion (J, 2) px of joints at `before` (J, 2) px in one image and `after` in the next, and its trust.

    The motion is the mean of the forward flow at `before` and the reversed backward flow at `after`. The trust (J,) is
    in [0, 1], 0 where a position or its flow is unknown. `flow` is on the working grid of `grid`.
    """
    forth, back = (sample_flow(field, grid.to_work(at)) for field, at in zip(flow, (before, after), strict=True))
    motion = 0.5 * (forth - back)
    known = np.isfinite(motion).all(axis=1)
    gap = np.where(known, ((forth + back) ** 2).sum(axis=1), np.inf)
    return np.where(known[:, None], motion, 0.0) / grid.factor, 1 / (1 + gap / DISAGREEMENT_PX**2)


def smooth_joints(
    places: F64, confidence: F64, motion: F64, trust: F64, start: F64, scale: float,
    settings: SmoothingSettings,
) -> F64:  # fmt: skip
    """Smooth joints over T images.

    Args:
        places: (T, J, 2) px, detected; NaN where unknown.
        confidence: (T, J) of the detections.
        motion: (T-1, J, 2) px from image to image.
        trust: (T-1, J) in [0, 1].
        start: (T, J, 2) px, positions of joints with neither detection nor flow.
        scale: px/m, converts the settings' widths to pixels.
        settings: weights and widths.
    """
    seen = np.isfinite(places).all(axis=2)
    target = np.where(seen[..., None], places, start)
    hold = np.where(seen, np.clip(confidence, 0.0, 1.0), 0.0)
    tie = settings.flow_weight * trust
    near, along = np.ones_like(hold), np.ones_like(tie)
    joints = target
    for _ in range(REWEIGHTINGS):
        joints = np.stack(
            [_solve_chain(target[:, j], hold[:, j] * near[:, j] + _START_WEIGHT, motion[:, j], tie[:, j] * along[:, j])
             for j in range(places.shape[1])], axis=1,
        )  # fmt: skip
        near = _huber_weights(np.linalg.norm(joints - target, axis=2), settings.detection_width * scale)
        along = _huber_weights(np.linalg.norm(np.diff(joints, axis=0) - motion, axis=2), settings.flow_width * scale)
    return joints


def _solve_chain(target: F64, hold: F64, motion: F64, tie: F64) -> F64:
    """Return the positions (T, 2) of one joint that minimise hold |x - target|^2 + tie |x' - x - motion|^2."""
    from scipy.linalg import solveh_banded  # loaded here: only recordings are smoothed

    bands = np.zeros((2, len(hold)))
    bands[1] = hold
    bands[1, :-1] += tie
    bands[1, 1:] += tie
    bands[0, 1:] = -tie
    right = hold[:, None] * target
    right[1:] += tie[:, None] * motion
    right[:-1] -= tie[:, None] * motion
    return np.asarray(solveh_banded(bands, right), dtype=np.float64)


def _huber_weights(distance: F64, width: float) -> F64:
    return np.minimum(1.0, width / np.maximum(distance, 1e-9))


def sample_flow(field: F32, points: F64) -> F64:
    """Interpolate the flow `field` (h, w, 2) at `points` (J, 2) of its grid; NaN outside."""
    height, width = field.shape[:2]
    inside = ((points >= -0.5) & (points <= np.array([width, height]) - 0.5)).all(axis=1)
    at = np.where(inside[:, None], points, 0.0).astype(np.float32)
    found = [
        cv2.remap(np.ascontiguousarray(field[:, :, k]), at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REPLICATE)[0]
        for k in (0, 1)
    ]  # fmt: skip
    return np.where(inside[:, None], np.stack(found, axis=1), np.nan)
