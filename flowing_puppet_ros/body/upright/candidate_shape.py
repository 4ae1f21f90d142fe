# SPDX-License-Identifier: Apache-2.0
"""What a candidate and its surroundings look like, in numbers that mean the same for every scanner and range."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights

SLICES_M = (0.15, 0.6, 1.0, 1.4, 2.0)  # heights over the floor between which a candidate is measured
RING_M, MAX_RADIUS_M = 0.5, 0.95  # of the surroundings
RING_HEIGHTS_M = (0.12, 0.7, 1.3, 2.2)
OVERHEAD_M = 0.6  # over the top, of what is over a candidate's head
SHAPE_NAMES = (
    "top", "lowest", "longer", "shorter", "flatness", "whole", "share_inside", "overhead", "head_width", "head_share",
    *(f"width_{k}" for k in range(len(SLICES_M) - 1)), *(f"depth_{k}" for k in range(len(SLICES_M) - 1)),
    *(f"share_{k}" for k in range(len(SLICES_M) - 1)), *(f"ring_{k}" for k in range(len(RING_HEIGHTS_M) - 1)),
)  # fmt: skip


def describe_candidates(candidates: list[Candidate], scene: SceneHeights, viewpoint: np.ndarray) -> np.ndarray:
    """Return the numbers (C, len(SHAPE_NAMES)) of candidates in a scene seen from `viewpoint` (3,) m."""
    if not candidates:
        return np.empty((0, len(SHAPE_NAMES)))
    tree = cKDTree(scene.points[:, :2])
    return np.stack([_describe(candidate, scene, tree, viewpoint) for candidate in candidates])


def _describe(candidate: Candidate, scene: SceneHeights, tree: cKDTree, viewpoint: np.ndarray) -> np.ndarray:
    points, height = scene.points[candidate.rows, :2], scene.height[candidate.rows]
    middle = np.median(points, axis=0)
    ahead = middle - viewpoint[:2]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    depth, across = (points - middle) @ ahead, (points - middle) @ np.array([-ahead[1], ahead[0]])
    centred = points - points.mean(axis=0)
    longer, shorter = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(points))[::-1], 0.0))
    near = np.array(tree.query_ball_point(middle, MAX_RADIUS_M), dtype=np.int64)
    around = scene.height[near]
    away = np.hypot(*(scene.points[near, :2] - middle).T)
    column = np.sum((away < RING_M) & (around > SLICES_M[0]) & (around < SLICES_M[-1] + 0.1))
    overhead = np.sum((away < RING_M) & (around > candidate.top + 0.05) & (around < candidate.top + OVERHEAD_M))
    head = height > candidate.top - 0.25
    count = len(points)
    slices = np.digitize(height, SLICES_M) - 1
    widths, depths, shares = [], [], []
    for k in range(len(SLICES_M) - 1):
        own = slices == k
        several = np.sum(own) > 2
        widths.append(float(np.ptp(np.percentile(across[own], (5, 95)))) if several else -0.1)
        depths.append(float(np.ptp(np.percentile(depth[own], (5, 95)))) if several else -0.1)
        shares.append(float(np.mean(own)))
    ring = np.histogram(around[away > RING_M], RING_HEIGHTS_M)[0] / count
    return np.array(
        [
            candidate.top,
            float(height.min()),
            longer,
            shorter,
            shorter / max(longer, 1e-6),
            float(candidate.whole),
            count / max(column, count),
            overhead / count,
            float(np.ptp(across[head])),
            float(np.mean(head)),
            *widths,
            *depths,
            *shares,
            *np.minimum(ring, 5.0),
        ]
    )
