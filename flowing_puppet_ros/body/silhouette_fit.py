# SPDX-License-Identifier: Apache-2.0
"""What draws a body's surface to the silhouettes themselves, as one quadratic a vertex.

A visual hull of few cameras is much larger than the body where no camera looks from the side; a body fitted to the
silhouettes has no such bias. Two residuals, both in metres at the vertex's depth: a vertex that projects outside a
silhouette lies too far out by the signed distance, and every piece of the outline wants a vertex of the body's rim,
where the surface turns away from the camera, to lie on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.camera import Camera
from flowing_puppet_ros.body.correspondence import Quadratic
from flowing_puppet_ros.body.geometry import vertex_normals
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.distance import signed_distance

Floats = NDArray[np.float64]

_SMOOTHING = 1.0  # pixels; turns the outline's pixel steps into directions
_OUTLINE_STEP = 2  # every so many outline pixels count
_RIM = 0.35  # cosine between surface normal and ray below which a vertex is on the rim
_TURN_COST = 8.0  # pixels that a match may be farther away when its direction is one radian better
_MIN_COSINE = 0.3  # between the outline's and the rim vertex's direction


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """One camera's silhouette, ready for matching.

    `camera` at the mask's size; `distance` (h,w) signed distance in pixels, positive outside, and its unit direction
    `slope` (h,w,2); `points` (K,2) on the outline with outward directions `normals` (K,2), without the image's border.
    """

    camera: Camera
    distance: Floats
    slope: Floats
    points: Floats
    normals: Floats

    @classmethod
    def of(cls, camera: Camera, mask: NDArray[np.uint8]) -> Outline:
        """Prepare a mask (h,w) uint8, positive on the body; InputError when it is empty or full."""
        inside = mask > 0
        if inside.all() or not inside.any():
            raise InputError(f"a mask of {mask.shape[1]} x {mask.shape[0]} pixels is empty or full: it has no outline")
        signed = signed_distance(mask)
        distance = ndimage.gaussian_filter(signed, _SMOOTHING, mode="nearest")
        slope = np.stack(np.gradient(distance)[::-1], axis=-1)
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)
        edge = inside & (signed >= -0.5)
        edge[:2] = edge[-2:] = False
        edge[:, :2] = edge[:, -2:] = False
        rows, columns = (side[::_OUTLINE_STEP] for side in np.nonzero(edge))
        normals = slope[rows, columns]
        points = np.stack([columns, rows], axis=-1) - distance[rows, columns, None] * normals
        return cls(camera.resized(mask.shape[::-1]), distance, slope, points, normals)


def attract_to_outlines(
    vertices: Floats, faces: NDArray[np.int32], outlines: Sequence[Outline], sigma: float
) -> Quadratic:
    """Match a body with silhouettes and return what draws its vertices (V,3) to them.

    `faces` (F,3) are outward, `sigma` is the width in metres of the Geman-McClure kernel. In every view the vertices
    outside weigh 1 in all if all were, and so do the pieces of the outline; the result is the views' mean.
    """
    normals = vertex_normals(vertices, faces)
    terms = [
        term
        for outline in outlines
        for term in (_vertices_outside(vertices, outline, sigma), _rim_to_outline(vertices, normals, outline, sigma))
    ]
    vertex, direction, gap, weight = (np.concatenate(column) for column in zip(*terms, strict=True))
    weight = weight / len(outlines)
    count = len(vertices)
    outer = weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
    vector = (weight * gap)[:, None] * direction
    return Quadratic(
        np.stack([np.bincount(vertex, column, count) for column in outer.reshape(-1, 9).T], axis=1).reshape(-1, 3, 3),
        np.stack([np.bincount(vertex, column, count) for column in vector.T], axis=1),
    )


Term = tuple[NDArray[np.int64], Floats, Floats, Floats]
"""Vertex (N,), direction in the world (N,3) along which it moves the residual, residual (N,) metres, weight (N,)."""


def _vertices_outside(vertices: Floats, outline: Outline, sigma: float) -> Term:
    pixels, depth = outline.camera.project(vertices)
    height, width = outline.distance.shape
    cell = np.rint(np.nan_to_num(pixels, nan=-1e6)).astype(np.int64)
    seen = np.flatnonzero((cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height))
    cell, pixel = cell[seen], pixels[seen]
    slope = outline.slope[cell[:, 1], cell[:, 0]]
    distance = outline.distance[cell[:, 1], cell[:, 0]] + ((pixel - cell) * slope).sum(axis=1)
    outside = distance > 0
    chosen = seen[outside]
    gap = distance[outside] * depth[chosen] / outline.camera.focal
    weight = _kernel(gap, sigma) / len(vertices)
    return chosen, _world_direction(outline.camera, vertices[chosen], slope[outside]), gap, weight


def _rim_to_outline(vertices: Floats, normals: Floats, outline: Outline, sigma: float) -> Term:
    camera = outline.camera
    ray = vertices - camera.centre
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    pixels, depth = camera.project(vertices)
    rim = np.flatnonzero((np.abs((normals * ray).sum(axis=1)) < _RIM) & (depth > 0))
    if len(rim) == 0 or len(outline.points) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    facing = (normals[rim] @ camera.rotation.T)[:, :2]
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
    tree = cKDTree(np.hstack([pixels[rim], _TURN_COST * facing]))
    nearest = tree.query(np.hstack([outline.points, _TURN_COST * outline.normals]))[1]
    agree = (facing[nearest] * outline.normals).sum(axis=1) > _MIN_COSINE
    chosen, normal = rim[nearest[agree]], outline.normals[agree]
    offset = pixels[chosen] - outline.points[agree]
    metres = depth[chosen] / camera.focal
    weight = _kernel(np.linalg.norm(offset, axis=1) * metres, sigma) / len(outline.points)
    gap = (offset * normal).sum(axis=1) * metres
    return chosen, _world_direction(camera, vertices[chosen], normal), gap, weight


def _world_direction(camera: Camera, points: Floats, direction: Floats) -> Floats:
    """How world points (N,3) move, in metres, along image directions (N,2) at their own depth, as gradients (N,3)."""
    local = camera.to_camera(points)
    plane = local[:, :2] / local[:, 2:]
    return direction @ camera.rotation[:2] - (direction * plane).sum(axis=1)[:, None] * camera.rotation[2]


def _kernel(distance: Floats, sigma: float) -> Floats:
    return (sigma**2 / (sigma**2 + distance**2)) ** 2
