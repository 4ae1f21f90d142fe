# SPDX-License-Identifier: Apache-2.0
"""The term that fits a body's rim to the outlines of silhouettes, as one quadratic per vertex.

A visual hull of few cameras is much larger than the body where no camera sees it in profile; a body fitted to the
silhouettes has no such bias. There are two residuals, both in metres at the surface's depth. A vertex that projects
outside a silhouette is too far out by the signed distance; and the body's rim, the curve where the surface turns away
from the camera, must pass through every point of the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import ndimage

from flowing_puppet_ros.arrays import F64, I32, I64, U8, Bools
from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic, geman_mcclure
from flowing_puppet_ros.body.cloud.mesh_geometry import sum_groups, vertex_normals
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.distance_transform import signed_distance

_SMOOTHING_PX = 1.0  # turns the outline's pixel steps into directions
_OUTLINE_STEP_PX = 4  # one in so many outline pixels is used
_DIRECTION_COST_PX = 8.0  # by which a match may be farther away when its direction is one radian better
_MIN_COSINE = 0.3  # between the directions of the outline and of the rim


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """One camera's silhouette, prepared for matching.

    Attributes:
        camera: at the mask's size.
        mask: (h, w) bool.
        distance: (h, w) signed distance in pixels, positive outside.
        slope: (h, w, 2) unit gradient of `distance`.
        points: (K, 2) pixels on the outline, without the image's border.
        normals: (K, 2) outward directions at `points`.
    """

    camera: Camera
    mask: Bools
    distance: F64
    slope: F64
    points: F64
    normals: F64

    @classmethod
    def of(cls, camera: Camera, mask: U8) -> Outline:
        """Prepare a mask (h, w) uint8, positive on the body; InputError when it is empty or full."""
        inside = mask > 0
        if inside.all() or not inside.any():
            raise InputError(f"a mask of {mask.shape[1]} x {mask.shape[0]} pixels is empty or full: it has no outline")
        signed = signed_distance(mask)
        distance = ndimage.gaussian_filter(signed, _SMOOTHING_PX, mode="nearest")
        slope = np.stack(np.gradient(distance)[::-1], axis=-1)
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)
        edge = inside & (signed >= -0.5)
        edge[:2] = edge[-2:] = False
        edge[:, :2] = edge[:, -2:] = False
        rows, columns = (side[::_OUTLINE_STEP_PX] for side in np.nonzero(edge))
        normals = slope[rows, columns]
        points = np.stack([columns, rows], axis=-1) - distance[rows, columns, None] * normals
        return cls(camera.resize(mask.shape[::-1]), inside, distance, slope, points, normals)


def mesh_edges(faces: I32) -> I64:
    """Return the edges (E, 2) of a closed triangle mesh (F, 3), each once."""
    corners = np.asarray(faces, np.int64)
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


class RimTerm:
    """The term of a mesh with fixed faces on outlines, a `SurfaceTerm` of `body.refine.gauss_newton`."""

    def __init__(self, outlines: Sequence[Outline], faces: I32, edges: I64, strength: float = 1.0) -> None:
        """Match with `outlines`; `faces` (F, 3) face outwards and `edges` (E, 2) are theirs."""
        self._outlines, self._faces, self._edges, self._strength = outlines, faces, edges, strength

    def scale(self, strength: float) -> RimTerm:
        """Return the same term with `strength` times the weight."""
        return RimTerm(self._outlines, self._faces, self._edges, strength * self._strength)

    def __call__(self, vertices: F64, sigma: float) -> VertexQuadratic:
        """Match vertices (V, 3) and return the quadratic that attracts them, with `geman_mcclure` of width `sigma` m.

        In every view all vertices have a total weight of 1, of which only those outside count, and so have the points
        of the outline; the result is the mean over the views, times the strength.
        """
        normals = vertex_normals(vertices, self._faces)
        terms = [
            term
            for outline in self._outlines
            for term in (
                _match_outside(vertices, outline, sigma),
                *_match_outline(vertices, normals, self._edges, outline, sigma),
            )
        ]
        vertex, direction, gap, weight = (np.concatenate(column) for column in zip(*terms, strict=True))
        weight = weight * self._strength / len(self._outlines)
        count = len(vertices)
        outer = weight[:, None, None] * direction[:, :, None] * direction[:, None, :]
        vector = (weight * gap)[:, None] * direction
        return VertexQuadratic(
            sum_groups(outer.reshape(-1, 9), vertex, count).reshape(-1, 3, 3), sum_groups(vector, vertex, count)
        )


Term = tuple[I64, F64, F64, F64]
"""Vertices (N,), world directions (N, 3) along which they change the residual, residuals (N,) m, weights (N,)."""


def measure_outside(vertices: F64, outline: Outline) -> tuple[I64, F64, F64]:
    """Return the vertices (N,), of (V, 3) in metres, that the image shows, and how far outside the silhouette they are.

    The latter is the signed distance (N,) in metres at the vertex's depth and its direction (N, 2) in the image.
    """
    pixels, depth = outline.camera.project(vertices)
    height, width = outline.distance.shape
    cell = np.rint(np.nan_to_num(pixels, nan=-1e6)).astype(np.int64)
    seen = np.flatnonzero((cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height))
    cell, pixel = cell[seen], pixels[seen]
    slope = outline.slope[cell[:, 1], cell[:, 0]]
    distance = outline.distance[cell[:, 1], cell[:, 0]] + ((pixel - cell) * slope).sum(axis=1)
    return seen, distance * depth[seen] / outline.camera.focal, slope


def _match_outside(vertices: F64, outline: Outline, sigma: float) -> Term:
    seen, distance, slope = measure_outside(vertices, outline)
    outside = distance > 0
    chosen, gap = seen[outside], distance[outside]
    weight = geman_mcclure(gap**2, sigma**2) / len(vertices)
    return chosen, _world_direction(outline.camera, vertices[chosen], slope[outside]), gap, weight


def _match_outline(vertices: F64, normals: F64, edges: I64, outline: Outline, sigma: float) -> tuple[Term, Term]:
    """Match every point of the outline with the nearest point of the rim, shared between the ends of the rim's edge.

    A squared weighted mean is at most the weighted mean of the squares, with the same slope, so each of the two ends
    may be attracted independently.
    """
    camera = outline.camera
    first, second, share = _find_rim(vertices, normals, camera.centre, edges)
    rim = vertices[first] + share[:, None] * (vertices[second] - vertices[first])
    normal = normals[first] + share[:, None] * (normals[second] - normals[first])
    pixels, depth = camera.project(rim)
    rim_direction = (normal @ camera.rotation.T)[:, :2]
    rim_direction /= np.maximum(np.linalg.norm(rim_direction, axis=1, keepdims=True), 1e-9)
    nearest = _find_nearest(
        outline.points, outline.normals, np.ascontiguousarray(pixels), rim_direction, _DIRECTION_COST_PX**2, _MIN_COSINE
    )
    matched = np.flatnonzero(nearest >= 0)
    nearest, point, direction = nearest[matched], outline.points[matched], outline.normals[matched]
    offset = pixels[nearest] - point
    metres = depth[nearest] / camera.focal
    weight = geman_mcclure((np.linalg.norm(offset, axis=1) * metres) ** 2, sigma**2) / max(len(outline.points), 1)
    gap = (offset * direction).sum(axis=1) * metres
    world = _world_direction(camera, rim[nearest], direction)
    share = share[nearest]
    return (
        (first[nearest], world, gap, weight * (1 - share)),
        (second[nearest], world, gap, weight * share),
    )


@njit(cache=True, nogil=True)
def _find_rim(vertices, normals, eye, edges):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return both ends of the edges (E, 2) that the rim crosses, seen from `eye` (3,), and where, 0 to 1."""
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


@njit(cache=True, nogil=True)
def _find_nearest(points, directions, rim, rim_directions, direction_cost, min_cosine):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return for every outline point the index of the nearest rim point; -1 where their directions disagree."""
    nearest = np.full(len(points), -1)
    for i in range(len(points)):
        best, at = np.inf, -1
        for j in range(len(rim)):
            x, y = rim[j, 0] - points[i, 0], rim[j, 1] - points[i, 1]
            cost = x * x + y * y
            if not cost < best:
                continue
            u, v = rim_directions[j, 0] - directions[i, 0], rim_directions[j, 1] - directions[i, 1]
            cost += direction_cost * (u * u + v * v)
            if cost < best:
                best, at = cost, j
        if at >= 0:
            cosine = rim_directions[at, 0] * directions[i, 0] + rim_directions[at, 1] * directions[i, 1]
            if cosine > min_cosine:
                nearest[i] = at
    return nearest


def _world_direction(camera: Camera, points: F64, direction: F64) -> F64:
    """Return the gradients (N, 3) at world points (N, 3) along image directions (N, 2), in metres at their depth."""
    local = camera.to_camera(points)
    plane = local[:, :2] / local[:, 2:]
    return direction @ camera.rotation[:2] - (direction * plane).sum(axis=1)[:, None] * camera.rotation[2]
