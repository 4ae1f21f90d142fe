# SPDX-License-Identifier: Apache-2.0
"""Meshes rendered as a calibrated camera with a lens sees them: exact depth, whose surface it is, and a drawn colour.

Every pixel is one ray, so the lens model is exact. Metres; the camera's `rotation` and `translation` place it.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.extras import import_extra
from flowing_puppet_ros.multiview.camera import Camera

AMBIENT, HEADLIGHT, SKYLIGHT = 0.35, 0.45, 0.25  # shares of the light
SKY = (160, 175, 190)  # RGB where no ray ends
NOBODY = -1


@dataclass(frozen=True, slots=True, eq=False)
class PaintedMesh:
    """A mesh: `vertices` (V, 3) m, `triangles` (F, 3), `colours` (V, 3) RGB, and the person it is, or NOBODY."""

    vertices: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray
    person: int = NOBODY


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What a camera sees.

    Attributes:
        depth: (H, W) metres along the optical axis, infinite where nothing is.
        cosine: (H, W) of the angle between ray and surface normal.
        person: (H, W) index of the person seen, NOBODY for everything else.
        rgb: (H, W, 3) drawn colours.
    """

    depth: F64
    cosine: F64
    person: np.ndarray
    rgb: U8


class RayCamera:
    """A camera with the directions of its pixels' rays, which only depend on the lens and are kept."""

    def __init__(self, camera: Camera) -> None:
        width, height = camera.size
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        self.camera = camera
        plane = camera.undistort(np.stack([u, v], axis=-1))
        # A lens that shows what its model cannot invert has no ray there: it looks at the point straight ahead.
        self._rays = np.concatenate([np.nan_to_num(plane), np.ones((height, width, 1))], axis=-1)
        self._has_ray = np.isfinite(plane).all(axis=-1)

    def place(self, camera: Camera) -> RayCamera:
        """Return the rays of the same camera at another place."""
        placed = copy(self)
        placed.camera = camera
        return placed

    def render(self, meshes: Sequence[PaintedMesh]) -> RenderedView:
        """Render `meshes`; the result only depends on them and the camera."""
        o3d = import_extra("open3d", "scans", "synthetic depth images")

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for mesh in meshes:
            scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.vertices, dtype=np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.triangles, dtype=np.uint32)),
            )
        # The rays are as long as to depth 1, so that the distance is the depth.
        rays = (self._rays @ self.camera.rotation).reshape(-1, 3)
        origin = np.broadcast_to(self.camera.centre, rays.shape)
        hits = scene.cast_rays(
            o3d.core.Tensor.from_numpy(np.concatenate([origin, rays], axis=1, dtype=np.float32)), nthreads=1
        )
        depth = hits["t_hit"].numpy().astype(np.float64)
        depth[~self._has_ray.ravel()] = np.inf
        hit = np.flatnonzero(np.isfinite(depth))
        mesh_of = hits["geometry_ids"].numpy()[hit].astype(np.int64)
        triangle, uv = hits["primitive_ids"].numpy()[hit].astype(np.int64), hits["primitive_uvs"].numpy()[hit]
        person, cosine = np.full(len(depth), NOBODY), np.ones(len(depth))
        rgb = np.empty((len(depth), 3), dtype=np.uint8)
        rgb[:] = SKY
        for number, mesh in enumerate(meshes):
            chosen = mesh_of == number
            pixels = hit[chosen]
            person[pixels] = mesh.person
            cosine[pixels], rgb[pixels] = _shade(mesh, triangle[chosen], uv[chosen], rays[pixels])
        shape = (self.camera.size[1], self.camera.size[0])
        return RenderedView(
            depth.reshape(shape), cosine.reshape(shape), person.reshape(shape), rgb.reshape((*shape, 3))
        )


def _shade(mesh: PaintedMesh, triangle: np.ndarray, uv: np.ndarray, rays: np.ndarray) -> tuple[F64, U8]:
    """Return the cosines (N,) of the rays (N, 3) with the surface, and the lit colours (N, 3) where they end."""
    corners = mesh.triangles[triangle]
    weight = np.stack([1 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)[:, :, None]
    a, b, c = (mesh.vertices[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    cosine = np.abs((normal * rays).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    smooth = (_vertex_normals(mesh)[corners] * weight).sum(axis=1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    toward = np.maximum(-(smooth * rays).sum(axis=1) / np.linalg.norm(rays, axis=1), 0.0)
    light = AMBIENT + HEADLIGHT * toward + SKYLIGHT * np.maximum(smooth[:, 2], 0.0)
    colour = (np.asarray(mesh.colours, dtype=np.float64)[corners] * weight).sum(axis=1) * light[:, None]
    return cosine, np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def _vertex_normals(mesh: PaintedMesh) -> F64:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    normals = np.zeros(mesh.vertices.shape)
    for axis in range(3):
        for k in range(3):
            normals[:, axis] += np.bincount(mesh.triangles[:, k], weighted[:, axis], len(mesh.vertices))
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
