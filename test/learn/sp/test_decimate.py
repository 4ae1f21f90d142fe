# SPDX-License-Identifier: Apache-2.0
"""Decimation keeps surfaces closed, boundaries open and vertices where they are."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from flowing_puppet_ros.learn.sp.decimate import decimate, find_boundary_vertices


@pytest.fixture(scope="module")
def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return a unit sphere that is symmetric in y with a ring of vertices on y = 0."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(900, 3))
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    half = half[half[:, 1] > 0.1]
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    points = np.concatenate([ring, half, half * [1, -1, 1]])
    hull = ConvexHull(points)
    outward = np.einsum("ij,ij->i", hull.equations[:, :3], _normals(points, hull.simplices)) > 0
    return points, np.where(outward[:, None], hull.simplices, hull.simplices[:, ::-1])


def _normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = points[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def _run(points: np.ndarray, faces: np.ndarray, count: int, **changes: np.ndarray) -> np.ndarray:
    full = {"spacing": np.full(len(points), 0.2), "group": np.zeros(len(points)), "inner": np.zeros(len(points), bool)}
    return decimate(points, faces, count=count, **(full | changes))


def test_closed_surface_stays_closed(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    points, faces = sphere
    coarse = _run(points, faces, 300)
    used = np.unique(coarse)
    assert len(used) == 300
    assert len(coarse) == 2 * 300 - 4
    assert not find_boundary_vertices(len(points), coarse).any()
    normals = _normals(points, coarse)
    assert np.all(np.einsum("ij,ij->i", normals, points[coarse].mean(axis=1)) > 0), "a face was turned over"


def test_boundary_stays_and_can_be_welded(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    points, faces = sphere
    half = faces[points[faces, 1].mean(axis=1) > 1e-9]
    coarse = _run(points, half, 150)
    edge = find_boundary_vertices(len(points), coarse)
    assert np.abs(points[edge, 1]).max() < 1e-12
    flat = np.abs(points[:, 1]) < 1e-12
    sides = np.concatenate([coarse[:, [0, 1]], coarse[:, [1, 2]], coarse[:, [2, 0]]])
    on_rim = sides[flat[sides].all(axis=1)]
    assert len(on_rim) == edge.sum(), "an inner edge joins two vertices of the rim"


def test_vertices_keep_to_their_group(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    points, faces = sphere
    group = (points[:, 2] > 0).astype(int)
    share = [np.mean(group[np.unique(_run(points, faces, n, group=group))]) for n in (len(points), 250)]
    assert abs(share[0] - share[1]) < 0.1


def test_finer_spacing_keeps_more_vertices(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    points, faces = sphere
    kept = np.unique(_run(points, faces, 300, spacing=np.where(points[:, 0] > 0, 0.1, 0.3)))
    assert np.sum(points[kept, 0] > 0) > 2 * np.sum(points[kept, 0] < 0)


def test_inner_vertices_go_first(sphere: tuple[np.ndarray, np.ndarray]) -> None:
    points, faces = sphere
    inner = points[:, 0] > 0.8
    kept = np.unique(_run(points, faces, len(points), inner=inner))
    assert inner[kept].sum() <= 1
    assert len(kept) >= len(points) - inner.sum()
