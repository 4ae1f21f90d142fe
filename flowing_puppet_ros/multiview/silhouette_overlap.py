# SPDX-License-Identifier: Apache-2.0
"""Measures how well a body's rendered silhouettes agree with the observed ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F64, I32, Bools
from flowing_puppet_ros.body.cloud.correspondence import geman_mcclure
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.distance_transform import signed_distance
from flowing_puppet_ros.multiview.rim_term import Outline, measure_outside


def render_mask(camera: Camera, vertices: F64, faces: I32) -> Bools:
    """Return the pixels (h, w) of `camera` that a mesh of `vertices` (V, 3) in metres and `faces` (F, 3) covers.

    Pixels count by their centres; faces with a corner that the lens cannot show are left out.
    """
    width, height = camera.size
    mask = np.zeros((height, width), np.bool_)
    pixels, _ = camera.project(vertices)
    _fill(mask, np.ascontiguousarray(pixels), faces)
    return mask


@njit(cache=True, nogil=True)
def _fill(mask, pixels, faces):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the pixels of `mask` inside or on any triangle; each row is one run between the triangle's edges."""
    height, width = mask.shape
    for face in range(len(faces)):
        a, b, c = pixels[faces[face, 0]], pixels[faces[face, 1]], pixels[faces[face, 2]]
        low, high = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        if not np.isfinite(a[0] + a[1] + b[0] + b[1] + c[0] + c[1]):
            continue
        for y in range(max(0, int(np.ceil(low))), min(height - 1, int(np.floor(high))) + 1):
            left, right = np.inf, -np.inf
            for p, q in ((a, b), (b, c), (c, a)):
                if (p[1] <= y <= q[1]) or (q[1] <= y <= p[1]):
                    if p[1] == q[1]:
                        left, right = min(left, p[0], q[0]), max(right, p[0], q[0])
                    else:
                        x = p[0] + (y - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
                        left, right = min(left, x), max(right, x)
            for x in range(int(np.ceil(max(left, 0.0))), int(np.floor(min(right, width - 1.0))) + 1):
                mask[y, x] = True


def silhouette_iou(first: Bools, second: Bools) -> float:
    """Return the intersection over union of two masks (h, w), 0 to 1; 0 when both are empty."""
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 0.0


def measure_outline_gap(rendered: Bools, outline: Outline, depth: float) -> tuple[float, float]:
    """Return the mean distance and the mean squared distance between the outlines of a rendered mask (h, w) and a mask.

    Over both directions, in metres at `depth` metres from the camera; NaN when either outline is not in the image.
    """
    signed = signed_distance(rendered.astype(np.uint8))
    edge = rendered & (signed > -0.7)
    edge[0] = edge[-1] = edge[:, 0] = edge[:, -1] = False
    if not edge.any() or not len(outline.points):
        return np.nan, np.nan
    # A pixel on the edge lies half a pixel inside the outline.
    to_outline = np.abs(outline.distance[edge] + 0.5)
    column, row = np.clip(np.rint(outline.points).astype(int), 0, np.array(rendered.shape[::-1]) - 1).T
    to_edge = np.abs(signed[row, column])
    metres = depth / outline.camera.focal
    return (
        float(to_outline.mean() + to_edge.mean()) / 2 * metres,
        float((to_outline**2).mean() + (to_edge**2).mean()) / 2 * metres**2,
    )


def measure_shares_inside(vertices: F64, outlines: Sequence[Outline], sigma: float) -> F64:
    """Return how far each vertex (V,) lies inside the silhouettes, 0 to 1: the mean over the views that show it.

    Outside it is the `geman_mcclure` weight of the distance, of width `sigma` metres; 0 where no view shows the vertex.
    """
    total, views = np.zeros(len(vertices)), np.zeros(len(vertices))
    for outline in outlines:
        seen, distance, _ = measure_outside(vertices, outline)
        total[seen] += geman_mcclure(np.maximum(distance, 0) ** 2, sigma**2)
        views[seen] += 1
    return total / np.maximum(views, 1)
