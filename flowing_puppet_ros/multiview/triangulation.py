# SPDX-License-Identifier: Apache-2.0
"""Triangulates joints from their pixels in several calibrated cameras, without the views that do not agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from flowing_puppet_ros.arrays import F64, I64, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.settings import Settings, setting

_GAUSS_NEWTON_STEPS = 8  # from the best proposal of two views
# What is known beforehand decides between proposals that views support alike; 1 is a view with full confidence.
_PLACE_WEIGHT = 0.8  # of the place where a joint is expected
_BONE_WEIGHT, _BONE_LOG = 0.6, 0.2  # of each bone of a joint, and the relative error from which it has another length
_PENALTY_ALLOWED = 0.25  # before a joint is less sure


@dataclass(frozen=True)
class TriangulationSettings(Settings):
    """When views agree on a joint."""

    max_ray_distance: float = setting(
        0.06, "maximum distance between a joint and its rays for the views to agree", unit="m", low=0.001, high=1.0
    )
    min_confidence: float = setting(0.1, "minimum confidence of a detection to be used", low=0.0, high=1.0)
    min_angle: float = setting(
        4.0, "minimum angle between two rays that place a joint", unit="degrees", low=0.1, high=60.0, advanced=True
    )


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What is known of a person before the views are asked; it decides where they contradict one another.

    Attributes:
        joints: (J, 3) m where the joints are expected, NaN where unknown.
        tolerance: (J,) m by which they may have moved meanwhile.
        bones: (B, 2) places of the joints at the ends of each bone.
        lengths: (B,) m of the bones, NaN where unknown.
    """

    joints: F64
    tolerance: F64
    bones: I64 = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    lengths: F64 = field(default_factory=lambda: np.zeros(0))

    def penalise_places(self, points: F64) -> F64:
        """Return the penalties (..., J), up to _PLACE_WEIGHT, of points (..., J, 3) away from the expected ones."""
        distance = np.linalg.norm(points - self.joints, axis=-1)
        return _PLACE_WEIGHT * np.minimum((np.nan_to_num(distance) / self.tolerance) ** 2, 1.0)

    def penalise_bones(self, points: F64, placed: F64) -> F64:
        """Return the penalties (..., J) of points (..., J, 3) by the lengths of their bones to `placed` (J, 3).

        Up to _BONE_WEIGHT for each bone.
        """
        penalty = np.zeros(points.shape[:-1])
        for end, other in ((0, 1), (1, 0)):
            near, far = self.bones[:, end], self.bones[:, other]
            length = np.linalg.norm(points[..., near, :] - placed[far], axis=-1)
            error = np.log(np.maximum(length, 1e-3) / self.lengths)
            each = _BONE_WEIGHT * np.minimum((np.nan_to_num(error) / _BONE_LOG) ** 2, 1.0)
            penalty = penalty + each @ np.eye(penalty.shape[-1])[near]
        return penalty


def triangulate(
    cameras: Sequence[Camera],
    points: ArrayLike,
    confidence: ArrayLike,
    settings: TriangulationSettings | None = None,
) -> tuple[F64, F64]:
    """Triangulate joints seen by several cameras.

    Every pair of views proposes a point; the proposal that most views agree with is refined by iteratively reweighted
    Gauss-Newton on the reprojection error, expressed in metres at the joint's depth, so that the same settings serve
    every image size.

    Args:
        cameras: C cameras.
        points: (C, J, 2) pixels, NaN where unseen.
        confidence: (C, J) in [0, 1].
        settings: when views agree.

    Returns:
        World points (J, 3) in metres and confidences (J,) in [0, 1]: the mean confidence of the agreeing views times
        their share of the joint's total confidence. NaN and 0 where fewer than two views agree.

    Raises:
        InputError: with fewer than two cameras, or arrays of other shapes.
    """
    pixels, weights = _check_inputs(len(cameras), points, confidence)
    plane = np.stack([camera.undistort(xy) for camera, xy in zip(cameras, pixels, strict=True)])
    return triangulate_plane(cameras, plane, weights, settings or TriangulationSettings())


def triangulate_plane(
    cameras: Sequence[Camera],
    plane: F64,
    weights: F64,
    settings: TriangulationSettings,
    expected: Expectation | None = None,
) -> tuple[F64, F64]:
    """Triangulate as `triangulate` does, from points (C, J, 2) on the undistorted image planes; NaN where unseen.

    With what is `expected` of the person, a joint on which as many views agree elsewhere is placed where it may be. One
    that is neither where it was expected nor has bones of the right lengths has less confidence.
    """
    known = np.isfinite(plane).all(axis=-1) & (weights >= settings.min_confidence) & (weights > 0)
    weights = np.where(known, weights, 0.0)
    plane = np.where(known[..., None], plane, 0.0)

    proposals = _propose_from_pairs(cameras, plane, known, settings)
    cost = np.stack([_robust_cost(cameras, plane, weights, p, settings.max_ray_distance) for p in proposals])
    if expected is not None:
        cost = cost + expected.penalise_places(proposals)
    best = _choose(proposals, cost)
    if expected is not None:
        best = _choose(proposals, cost + expected.penalise_bones(proposals, best))
    for _ in range(_GAUSS_NEWTON_STEPS):
        best = _gauss_newton_step(cameras, plane, weights, best, settings.max_ray_distance)

    error = _reprojection_errors(cameras, plane, best)[0]
    agrees = known & (np.nan_to_num(error, nan=np.inf) < settings.max_ray_distance)
    agreeing, total = np.where(agrees, weights, 0.0).sum(axis=0), weights.sum(axis=0)
    count = agrees.sum(axis=0)
    placed = count >= 2
    result = np.where(placed[:, None], best, np.nan)
    confidence = np.where(placed, agreeing * agreeing / np.maximum(count * total, 1e-12), 0.0)
    if expected is not None:
        penalty = expected.penalise_places(result) + expected.penalise_bones(result, result)
        confidence = confidence * np.clip(1 + _PENALTY_ALLOWED - penalty, 0.0, 1.0)
    return result, confidence


def _choose(proposals: F64, cost: F64) -> F64:
    """Return the cheapest of the proposals (P, J, 3) for each joint by its cost (P, J)."""
    return np.asarray(proposals[cost.argmin(axis=0), np.arange(proposals.shape[1])])


def _check_inputs(cameras: int, points: ArrayLike, confidence: ArrayLike) -> tuple[F64, F64]:
    pixels, weights = np.asarray(points, np.float64), np.asarray(confidence, np.float64)
    if cameras < 2:
        raise InputError(f"triangulation needs at least 2 cameras, got {cameras}")
    if pixels.ndim != 3 or pixels.shape[0] != cameras or pixels.shape[2] != 2 or weights.shape != pixels.shape[:2]:
        raise InputError(
            f"triangulation with {cameras} cameras needs points ({cameras}, J, 2) and confidence ({cameras}, J), "
            f"got {pixels.shape} and {weights.shape}"
        )
    return pixels, np.clip(np.nan_to_num(weights), 0.0, 1.0)


def _propose_from_pairs(cameras: Sequence[Camera], plane: F64, known: Bools, settings: TriangulationSettings) -> F64:
    """Return the midpoints (pairs, J, 3) of the shortest segments between each two rays; NaN where unusable."""
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


def _reprojection_errors(cameras: Sequence[Camera], plane: F64, points: F64) -> tuple[F64, F64, F64]:
    """Return distances (C, J) and residuals (C, J, 2) in metres at the points' depth, and projections (C, J, 2).

    Projections are on the image plane at depth 1; all are NaN for points (J, 3) behind a camera.
    """
    local = np.stack([camera.to_camera(points) for camera in cameras])
    depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
    seen = local[..., :2] / depth
    residual = (seen - plane) * depth
    return np.linalg.norm(residual, axis=-1), residual, seen


def _robust_cost(cameras: Sequence[Camera], plane: F64, weights: F64, points: F64, agreement: float) -> F64:
    """Return the truncated quadratic cost (J,) of points (J, 3) over the views; infinite for points that are NaN."""
    error = np.nan_to_num(_reprojection_errors(cameras, plane, points)[0], nan=np.inf)
    cost = (weights * np.minimum((error / agreement) ** 2, 1.0)).sum(axis=0)
    return np.where(np.isfinite(points).all(axis=-1), cost, np.inf)


def _gauss_newton_step(cameras: Sequence[Camera], plane: F64, weights: F64, points: F64, agreement: float) -> F64:
    """Return points (J, 3) after one Gauss-Newton step on the Geman-McClure cost, with fixed depth in each view."""
    error, residual, seen = _reprojection_errors(cameras, plane, points)
    scale = 0.5 * agreement
    weight = weights / (1 + (error / scale) ** 2) ** 2
    weight = np.where(np.isfinite(weight), weight, 0.0)
    rotation = np.stack([camera.rotation for camera in cameras])
    jacobian = rotation[:, None, :2, :] - np.nan_to_num(seen)[..., :, None] * rotation[:, None, 2:, :]
    normal = np.einsum("cj,cjik,cjil->jkl", weight, jacobian, jacobian)
    gradient = np.einsum("cj,cjik,cji->jk", weight, jacobian, np.nan_to_num(residual))
    damping = 1e-9 * np.eye(3)
    return points - np.linalg.solve(normal + damping, gradient[..., None])[..., 0]
