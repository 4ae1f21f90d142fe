# SPDX-License-Identifier: Apache-2.0
"""The coarse mesh: closed, near the full one, not folded, the same every time."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.messages.bodies.mesh_preview import simplify_mesh


def sphere(rings: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed sphere of radius 1: vertices and faces that look outwards."""
    polar = np.linspace(0, np.pi, rings + 2)[1:-1]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    grid = [(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in around]
    vertices = np.array([*grid, (0, 0, 1), (0, 0, -1)])
    faces, top = [], rings * columns
    for column in range(columns):
        beside = (column + 1) % columns
        faces += [(top, column, beside), (top + 1, top - columns + beside, top - columns + column)]
        for ring in range(rings - 1):
            a, b = ring * columns + column, ring * columns + beside
            faces += [(a, a + columns, b), (b, a + columns, b + columns)]
    return vertices, np.array(faces)


def assert_closed(faces: np.ndarray) -> None:
    """Assert that every edge is passed once in each direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}


def test_a_sphere_keeps_its_volume_and_outside() -> None:
    vertices, faces = sphere(30, 40)
    coarse = simplify_mesh(vertices, faces, 500)
    assert 490 <= len(coarse) <= 500
    assert_closed(coarse)
    a, b, c = (vertices[coarse[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1).min() > 0
    # An icosphere of 500 triangles, all vertices on the sphere, has 97.6 % of its volume.
    assert 0.96 < np.linalg.det(np.stack([a, b, c], axis=1)).sum() / 6 / (4 / 3 * np.pi) < 1


@pytest.mark.slow
def test_a_body_keeps_its_surface(model: StitchedPuppet) -> None:
    vertices = model.vertices(model.rest_state())
    coarse = simplify_mesh(vertices, np.asarray(model.faces, np.int64), 2000)
    assert_closed(coarse)
    np.testing.assert_array_equal(coarse, simplify_mesh(vertices, np.asarray(model.faces, np.int64), 2000))
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1, 1, 1], (len(coarse), 20))
    filled = (weights @ vertices[coarse]).reshape(-1, 3)
    distance = cKDTree(filled).query(vertices)[0]
    assert distance.mean() < 0.008 and distance.max() < 0.03, "metres; points of the coarse surface are 6 mm apart"
