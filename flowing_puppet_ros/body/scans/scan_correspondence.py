# SPDX-License-Identifier: Apache-2.0
"""Closest points on triangle meshes, and the map from scan to scan through two fits of one model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.scans.scan import Scan

CENTRE_CANDIDATES, SAMPLE_CANDIDATES = 24, 8  # nearest face centres and nearest samples of which faces are tried
SURFACE_SAMPLES = 20000  # points spread over a mesh beside its face centres
# Distance, as a share of the mesh's largest extent, that a normal rotated by one radian adds to a face: about 1 cm on
# people, which keeps the sides of fingers and the lips of a fold apart.
NORMAL_LENGTH_SHARE = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Points on a mesh: `face` (N,) and `barycentric` coordinates (N, 3) of each."""

    face: np.ndarray
    barycentric: np.ndarray

    def interpolate(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) on a mesh with vertices (V, 3) and the same faces (F, 3)."""
        return (self.barycentric[:, :, None] * vertices[faces[self.face]]).sum(axis=1)


def find_closest_on_mesh(
    points: np.ndarray, normals: np.ndarray | None, vertices: np.ndarray, faces: np.ndarray
) -> SurfacePoints:
    """Find for every point the closest point of a mesh, on a face whose normal does not contradict the point's.

    Exact among the 24 faces whose centres are nearest and those of the 8 nearest samples. A face whose normal
    contradicts the point's is taken only when none of them agrees; of those that agree, a more parallel one counts as
    closer by `NORMAL_LENGTH_SHARE`.

    Args:
        points: (N, 3) in the mesh's frame and unit.
        normals: (N, 3) of any length, or None to take any face.
        vertices: (V, 3).
        faces: (F, 3).
    """
    corners = np.ascontiguousarray(vertices[faces], dtype=np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(cross, axis=1)
    # Large faces get more samples, so that their centres alone do not decide which faces are near.
    extra = np.floor(SURFACE_SAMPLES * areas / areas.sum()).astype(np.int64)
    owner = np.concatenate([np.arange(len(faces)), np.repeat(np.arange(len(faces)), extra)])
    mix = np.random.default_rng(0).dirichlet(np.ones(3), int(extra.sum()))
    centres = corners.mean(axis=1)
    samples = np.concatenate([centres, (mix[:, :, None] * corners[owner[len(faces) :]]).sum(axis=1)])
    near = owner[cKDTree(samples).query(points, k=min(SAMPLE_CANDIDATES, len(samples)))[1].reshape(len(points), -1)]
    centred = cKDTree(centres).query(points, k=min(CENTRE_CANDIDATES, len(faces)))[1].reshape(len(points), -1)
    near = np.concatenate([centred, near], axis=1)
    directions = np.zeros_like(points) if normals is None else normals
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions / np.where(length > 0, length, 1.0)
    normal_length = NORMAL_LENGTH_SHARE * float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    face, barycentric = _find_closest(
        np.ascontiguousarray(points, dtype=np.float64), np.ascontiguousarray(directions, dtype=np.float64), near,
        corners, cross / np.where(areas > 0, areas, 1.0)[:, None], normal_length**2,
    )  # fmt: skip
    return SurfacePoints(face, barycentric)


def correspond(
    fit_a: np.ndarray, fit_b: np.ndarray, faces: np.ndarray, scan_a: Scan, scan_b: Scan
) -> tuple[np.ndarray, np.ndarray]:
    """Map every point of one scan to another through two fits of one model (thesis, "Experiments").

    A point of scan A is mapped to the closest place on fit A, to the same place on fit B, and on to scan B's surface.

    Args:
        fit_a: (V, 3) fitted vertices in scan A's frame.
        fit_b: (V, 3) fitted vertices in scan B's frame.
        faces: (F, 3) of the model.
        scan_a: N points.
        scan_b: M points.

    Returns:
        Points (N, 3) on scan B, and the distances (N,) between scan B's surface and fit B there.
    """
    place = find_closest_on_mesh(scan_a.points, scan_a.vertex_normals(), fit_a, faces)
    bridge = place.interpolate(fit_b, faces)
    if scan_b.faces is None:
        found = scan_b.points[cKDTree(scan_b.points).query(bridge)[1]]
    else:
        corners = fit_b[faces[place.face]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        found = find_closest_on_mesh(bridge, normals, scan_b.points, scan_b.faces).interpolate(
            scan_b.points, scan_b.faces
        )
    return found, np.linalg.norm(found - bridge, axis=1)


@njit(cache=True, nogil=True)
def _find_closest(
    points: np.ndarray,
    normals: np.ndarray,
    candidates: np.ndarray,
    corners: np.ndarray,
    face_normals: np.ndarray,
    squared_normal_length: float,
) -> tuple[np.ndarray, np.ndarray]:
    face = np.empty(len(points), dtype=np.int64)
    barycentric = np.empty((len(points), 3))
    for row in range(len(points)):
        best, best_agrees = np.inf, False
        for candidate in candidates[row]:
            cosine = np.dot(normals[row], face_normals[candidate])
            agrees = cosine >= 0
            if best_agrees and not agrees:
                continue
            place = _closest_on_triangle(points[row], corners[candidate])
            gap = (
                place[0] * corners[candidate, 0] + place[1] * corners[candidate, 1] + place[2] * corners[candidate, 2]
            ) - points[row]
            distance = np.dot(gap, gap) + 2 * squared_normal_length * (1 - cosine)
            if distance < best or (agrees and not best_agrees):
                best, best_agrees = distance, agrees
                face[row], barycentric[row] = candidate, place
    return face, barycentric


@njit(cache=True, nogil=True)
def _closest_on_triangle(point: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (3,) of the closest point: inside the face, or on the nearest of its edges."""
    ab, ac, ap = triangle[1] - triangle[0], triangle[2] - triangle[0], point - triangle[0]
    aa, bb, cc = np.dot(ab, ab), np.dot(ab, ac), np.dot(ac, ac)
    pa, pc = np.dot(ap, ab), np.dot(ap, ac)
    determinant = aa * cc - bb * bb
    place = np.zeros(3)
    if determinant > 1e-12 * aa * cc:
        v, w = (cc * pa - bb * pc) / determinant, (aa * pc - bb * pa) / determinant
        if v >= 0 and w >= 0 and v + w <= 1:
            place[0], place[1], place[2] = 1 - v - w, v, w
            return place
    best = np.inf
    for first in range(3):
        second = (first + 1) % 3
        edge = triangle[second] - triangle[first]
        length = np.dot(edge, edge)
        along = min(max(np.dot(point - triangle[first], edge) / length, 0.0), 1.0) if length > 0 else 0.0
        gap = point - triangle[first] - along * edge
        if np.dot(gap, gap) < best:
            best = np.dot(gap, gap)
            place[:] = 0.0
            place[first], place[second] = 1 - along, along
    return place
