# SPDX-License-Identifier: Apache-2.0
"""What draws a body's surface to the silhouettes themselves, as one quadratic a vertex.

A visual hull of few cameras is much larger than the body where no camera looks from the side; a body fitted to the
silhouettes has no such bias. Two residuals, both in metres at the surface's depth: a vertex that projects outside a
silhouette lies too far out by the signed distance, and every piece of the outline wants the body's rim, the curve where
the surface turns away from the camera, to run through it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from flowing_puppet_ros.arrays import F64, I32, I64, U8, Bools
from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.distance_transform import signed_distance

_SMOOTHING = 1.0  # pixels; turns the outline's pixel steps into directions
_OUTLINE_STEP = 4  # every so many outline pixels count
_TURN_COST = 8.0  # pixels that a match may be farther away when its direction is one radian better
_MIN_COSINE = 0.3  # between the outline's and the rim's direction


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """One camera's silhouette, ready for matching.

    `camera` at the mask's size; `mask` (h,w) bool; `distance` (h,w) signed distance in pixels, positive outside, and
    its unit direction `slope` (h,w,2); `points` (K,2) on the outline with outward directions `normals` (K,2), without
    the image's border.
    """

    camera: Camera
    mask: Bools
    distance: F64
    slope: F64
    points: F64
    normals: F64

    @classmethod
    def of(cls, camera: Camera, mask: U8) -> Outline:
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
        return cls(camera.resized(mask.shape[::-1]), inside, distance, slope, points, normals)


def mesh_edges(faces: I32) -> I64:
    """The edges (E,2) of a closed triangle mesh (F,3), each once."""
    corners = np.asarray(faces, np.int64)
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


class RimTerm:
    """Draws a mesh of fixed faces to outlines; called with the vertices and the kernel's width."""

    def __init__(self, outlines: Sequence[Outline], faces: I32, edges: I64) -> None:
        """Match with `outlines`; `faces` (F,3) are outward and `edges` (E,2) theirs."""
        self._outlines, self._faces, self._edges = outlines, faces, edges

    def __call__(self, vertices: F64, sigma: float) -> VertexQuadratic:
        """Match vertices (V,3) and return what draws them; `sigma` is the Geman-McClure kernel's width in metres.

        In every view the vertices outside weigh 1 in all if all were, and so do the pieces of the outline; the result
        is the views' mean.
        """
        normals = vertex_normals(vertices, self._faces)
        terms = [
            term
            for outline in self._outlines
            for term in (
                _vertices_outside(vertices, outline, sigma),
                *_outline_to_rim(vertices, normals, self._edges, outline, sigma),
            )
        ]
        vertex, direction, gap, weight = (np.concatenate(column) for column in zip(*terms, strict=True))
        weight = weight / len(self._outlines)
        count = len(vertices)
        outer = weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
        vector = (weight * gap)[:, None] * direction
        return VertexQuadratic(
            _sums(vertex, outer.reshape(-1, 9), count).reshape(-1, 3, 3), _sums(vertex, vector, count)
        )


Term = tuple[I64, F64, F64, F64]
"""Vertex (N,), direction in the world (N,3) along which it moves the residual, residual (N,) metres, weight (N,)."""


def distances_outside(vertices: F64, outline: Outline) -> tuple[I64, F64, F64]:
    """Which vertices (V,3) the image shows (N,), and how far they lie outside the silhouette.

    That is the signed distance (N,) in metres at the vertex's depth, and its direction in the image (N,2).
    """
    pixels, depth = outline.camera.project(vertices)
    height, width = outline.distance.shape
    cell = np.rint(np.nan_to_num(pixels, nan=-1e6)).astype(np.int64)
    seen = np.flatnonzero((cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height))
    cell, pixel = cell[seen], pixels[seen]
    slope = outline.slope[cell[:, 1], cell[:, 0]]
    distance = outline.distance[cell[:, 1], cell[:, 0]] + ((pixel - cell) * slope).sum(axis=1)
    return seen, distance * depth[seen] / outline.camera.focal, slope


def _vertices_outside(vertices: F64, outline: Outline, sigma: float) -> Term:
    seen, distance, slope = distances_outside(vertices, outline)
    outside = distance > 0
    chosen, gap = seen[outside], distance[outside]
    weight = _kernel(gap, sigma) / len(vertices)
    return chosen, _world_direction(outline.camera, vertices[chosen], slope[outside]), gap, weight


def _outline_to_rim(vertices: F64, normals: F64, edges: I64, outline: Outline, sigma: float) -> tuple[Term, Term]:
    """Every piece of the outline with the nearest point of the rim, shared between the ends of the rim's edge.

    A squared weighted mean is at most the weighted mean of the squares, with the same slope: so the two ends may be
    drawn each on its own.
    """
    camera = outline.camera
    first, second, share = _crossed(vertices, normals, camera.centre, edges)
    rim = vertices[first] + share[:, None] * (vertices[second] - vertices[first])
    normal = normals[first] + share[:, None] * (normals[second] - normals[first])
    pixels, depth = camera.project(rim)
    turned = (normal @ camera.rotation.T)[:, :2]
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    nearest = _nearest(
        outline.points, outline.normals, np.ascontiguousarray(pixels), turned, _TURN_COST**2, _MIN_COSINE
    )
    found = np.flatnonzero(nearest >= 0)
    nearest, point, direction = nearest[found], outline.points[found], outline.normals[found]
    offset = pixels[nearest] - point
    metres = depth[nearest] / camera.focal
    weight = _kernel(np.linalg.norm(offset, axis=1) * metres, sigma) / max(len(outline.points), 1)
    gap = (offset * direction).sum(axis=1) * metres
    world = _world_direction(camera, rim[nearest], direction)
    share = share[nearest]
    return (
        (first[nearest], world, gap, weight * (1 - share)),
        (second[nearest], world, gap, weight * share),
    )


@njit(cache=True)
def _crossed(vertices, normals, eye, edges):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The ends of the edges (E,2) that the rim crosses, seen from `eye`, and where between them, 0 to 1."""
    facing = np.empty(len(vertices))
    for v in range(len(vertices)):
        facing[v] = 0.0
        for k in range(3):
            facing[v] += normals[v, k] * (vertices[v, k] - eye[k])
    count = 0
    first, second, share = np.empty(len(edges), np.int64), np.empty(len(edges), np.int64), np.empty(len(edges))
    for edge in range(len(edges)):
        a, b = edges[edge, 0], edges[edge, 1]
        if (facing[a] < 0) != (facing[b] < 0):
            first[count], second[count], share[count] = a, b, facing[a] / (facing[a] - facing[b])
            count += 1
    return first[:count], second[:count], share[:count]


@njit(cache=True)
def _nearest(points, directions, rim, rim_directions, turn_cost, min_cosine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """For every outline point the index of the nearest rim point (NaN ones apart); -1 where the directions disagree."""
    nearest = np.full(len(points), -1)
    for i in range(len(points)):
        best, at = np.inf, -1
        for j in range(len(rim)):
            x, y = rim[j, 0] - points[i, 0], rim[j, 1] - points[i, 1]
            cost = x * x + y * y
            if not cost < best:
                continue
            u, v = rim_directions[j, 0] - directions[i, 0], rim_directions[j, 1] - directions[i, 1]
            cost += turn_cost * (u * u + v * v)
            if cost < best:
                best, at = cost, j
        if at >= 0:
            cosine = rim_directions[at, 0] * directions[i, 0] + rim_directions[at, 1] * directions[i, 1]
            if cosine > min_cosine:
                nearest[i] = at
    return nearest


def _world_direction(camera: Camera, points: F64, direction: F64) -> F64:
    """How world points (N,3) move, in metres, along image directions (N,2) at their own depth, as gradients (N,3)."""
    local = camera.to_camera(points)
    plane = local[:, :2] / local[:, 2:]
    return direction @ camera.rotation[:2] - (direction * plane).sum(axis=1)[:, None] * camera.rotation[2]


def _sums(group: I64, values: F64, count: int) -> F64:
    return np.stack([np.bincount(group, column, count) for column in values.T], axis=1)


def _kernel(distance: F64, sigma: float) -> F64:
    return (sigma**2 / (sigma**2 + distance**2)) ** 2
