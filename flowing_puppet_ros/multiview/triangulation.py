# SPDX-License-Identifier: Apache-2.0
"""Joints in space from their pixels in several calibrated cameras, with wrong views found and left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.settings import Settings, setting

_REFINEMENTS = 8


@dataclass(frozen=True)
class TriangulationSettings(Settings):
    """When views agree on a joint."""

    agreement: float = setting(
        0.06, "largest distance of a joint's rays at the joint for its views to agree", unit="m", low=0.001, high=1.0
    )
    min_confidence: float = setting(0.1, "detections below this confidence are left out", low=0.0, high=1.0)
    min_angle: float = setting(
        4.0, "smallest angle between two rays that may place a joint", unit="degrees", low=0.1, high=60.0
    )


def triangulate(
    cameras: Sequence[Camera],
    points: ArrayLike,
    confidence: ArrayLike,
    settings: TriangulationSettings | None = None,
) -> tuple[F64, F64]:
    """Place joints seen by several cameras.

    `points` (C,J,2) pixels, NaN where unseen; `confidence` (C,J) in [0,1]. Returns world points (J,3) in metres and
    confidences (J,) in [0,1]; NaN and 0 where fewer than two views agree. Every pair of views proposes a point; the
    proposal that most views agree with is refined by iteratively reweighted Gauss-Newton on the reprojection error,
    expressed in metres at the joint's depth, so that the same settings serve every image size. The confidence is the
    mean confidence of the agreeing views times their share of all confidence spent on the joint.
    """
    settings = settings or TriangulationSettings()
    pixels, weights = _checked(len(cameras), points, confidence)
    plane = np.stack([camera.undistort(xy) for camera, xy in zip(cameras, pixels, strict=True)])
    known = np.isfinite(plane).all(axis=-1) & (weights >= settings.min_confidence) & (weights > 0)
    weights = np.where(known, weights, 0.0)
    plane = np.where(known[..., None], plane, 0.0)

    proposals = _pair_proposals(cameras, plane, known, settings)
    cost = np.stack([_cost(cameras, plane, weights, p, settings.agreement) for p in proposals])
    best = proposals[cost.argmin(axis=0), np.arange(pixels.shape[1])]
    for _ in range(_REFINEMENTS):
        best = _gauss_newton_step(cameras, plane, weights, best, settings.agreement)

    error = _errors(cameras, plane, best)[0]
    agrees = known & (np.nan_to_num(error, nan=np.inf) < settings.agreement)
    kept, spent = np.where(agrees, weights, 0.0).sum(axis=0), weights.sum(axis=0)
    count = agrees.sum(axis=0)
    placed = count >= 2
    result = np.where(placed[:, None], best, np.nan)
    return result, np.where(placed, kept * kept / np.maximum(count * spent, 1e-12), 0.0)


def _checked(cameras: int, points: ArrayLike, confidence: ArrayLike) -> tuple[F64, F64]:
    pixels, weights = np.asarray(points, np.float64), np.asarray(confidence, np.float64)
    if cameras < 2:
        raise InputError(f"triangulation needs at least 2 cameras, got {cameras}")
    if pixels.ndim != 3 or pixels.shape[0] != cameras or pixels.shape[2] != 2 or weights.shape != pixels.shape[:2]:
        raise InputError(
            f"triangulation with {cameras} cameras needs points ({cameras}, J, 2) and confidence ({cameras}, J), "
            f"got {pixels.shape} and {weights.shape}"
        )
    return pixels, np.clip(np.nan_to_num(weights), 0.0, 1.0)


def _pair_proposals(cameras: Sequence[Camera], plane: F64, known: Bools, settings: TriangulationSettings) -> F64:
    """Midpoints (pairs, J, 3) of the shortest segments between the rays of every two views; NaN where unusable."""
    ones = np.ones((*plane.shape[:-1], 1))
    rotation = np.stack([camera.rotation for camera in cameras])
    direction = np.concatenate([plane, ones], axis=-1) @ rotation
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    centre = [camera.centre for camera in cameras]
    proposals = []
    for a, b in combinations(range(len(cameras)), 2):
        u, v, base = direction[a], direction[b], centre[b] - centre[a]
        cosine = (u * v).sum(axis=-1)
        sine2 = 1 - cosine * cosine
        usable = known[a] & known[b] & (sine2 > np.sin(np.radians(settings.min_angle)) ** 2)
        sine2 = np.where(usable, sine2, np.nan)
        along_u = (u @ base - cosine * (v @ base)) / sine2
        along_v = (cosine * (u @ base) - v @ base) / sine2
        middle = 0.5 * (centre[a] + along_u[:, None] * u + centre[b] + along_v[:, None] * v)
        ahead = (along_u > 0) & (along_v > 0)
        proposals.append(np.where(ahead[:, None], middle, np.nan))
    return np.stack(proposals)


def _errors(cameras: Sequence[Camera], plane: F64, points: F64) -> tuple[F64, F64, F64]:
    """Distances (C,J) and residuals (C,J,2) in metres at the points' depth, image plane (C,J,2); NaN when behind."""
    local = np.stack([camera.to_camera(points) for camera in cameras])
    depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
    seen = local[..., :2] / depth
    residual = (seen - plane) * depth
    return np.linalg.norm(residual, axis=-1), residual, seen


def _cost(cameras: Sequence[Camera], plane: F64, weights: F64, points: F64, agreement: float) -> F64:
    """Truncated quadratic cost (J,) of points (J,3) over the views; infinite for a point that is NaN."""
    error = np.nan_to_num(_errors(cameras, plane, points)[0], nan=np.inf)
    cost = (weights * np.minimum((error / agreement) ** 2, 1.0)).sum(axis=0)
    return np.where(np.isfinite(points).all(axis=-1), cost, np.inf)


def _gauss_newton_step(cameras: Sequence[Camera], plane: F64, weights: F64, points: F64, agreement: float) -> F64:
    """One step (J,3) down the Geman-McClure cost of the reprojection errors, the depth of each view held."""
    error, residual, seen = _errors(cameras, plane, points)
    scale = 0.5 * agreement
    weight = weights / (1 + (error / scale) ** 2) ** 2
    weight = np.where(np.isfinite(weight), weight, 0.0)
    rotation = np.stack([camera.rotation for camera in cameras])
    jacobian = rotation[:, None, :2, :] - np.nan_to_num(seen)[..., :, None] * rotation[:, None, 2:, :]
    normal = np.einsum("cj,cjik,cjil->jkl", weight, jacobian, jacobian)
    gradient = np.einsum("cj,cjik,cji->jk", weight, jacobian, np.nan_to_num(residual))
    damping = 1e-9 * np.eye(3)
    return points - np.linalg.solve(normal + damping, gradient[..., None])[..., 0]
