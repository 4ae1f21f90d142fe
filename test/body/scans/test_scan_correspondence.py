# SPDX-License-Identifier: Apache-2.0
"""Closest points on meshes against dense brute force, maps between scans, and two-way matches of body and cloud."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence, two_way_distance
from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.body.scans.scan_correspondence import correspond, find_closest_on_mesh

SHIFT = np.array([5.0, 0.0, 0.0])
Ball = tuple[np.ndarray, np.ndarray, Cloud]


def sphere(rings: int = 12, sectors: int = 18) -> tuple[np.ndarray, np.ndarray]:
    """Closed sphere of radius 1 with outward faces."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    around = np.arange(sectors) * 2 * np.pi / sectors
    grid = np.array([[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p in polar for a in around])
    vertices = np.concatenate([grid, [[0, 0, 1.0], [0, 0, -1.0]]])
    faces = []
    for ring in range(rings - 2):
        for k in range(sectors):
            a, b = ring * sectors + k, ring * sectors + (k + 1) % sectors
            faces += [[a, a + sectors, b], [b, a + sectors, b + sectors]]
    top, bottom, last = len(grid), len(grid) + 1, (rings - 2) * sectors
    for k in range(sectors):
        faces += [[top, k, (k + 1) % sectors], [bottom, last + (k + 1) % sectors, last + k]]
    return vertices, np.array(faces)


def test_closest_point_equals_dense_search() -> None:
    vertices, faces = sphere()
    queries = np.random.default_rng(0).normal(size=(60, 3)) * 0.9
    place = find_closest_on_mesh(queries, None, vertices, faces)
    assert np.all(place.barycentric >= -1e-12)
    np.testing.assert_allclose(place.barycentric.sum(axis=1), 1)
    found = np.linalg.norm(place.interpolate(vertices, faces) - queries, axis=1)
    mix = np.random.default_rng(1).dirichlet(np.ones(3), 400)
    dense = np.einsum("mk,fkd->fmd", mix, vertices[faces]).reshape(-1, 3)
    brute = np.array([np.linalg.norm(dense - query, axis=1).min() for query in queries])
    assert np.all(found <= brute + 1e-9)
    assert np.all(brute - found < 0.02)


def test_large_faces_are_found_from_far_off_their_centres() -> None:
    vertices = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 0.3], [0.1, 0, 0.3], [0, 0.1, 0.3]], dtype=float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    place = find_closest_on_mesh(np.array([[9.5, 0.2, 0.05]]), None, vertices, faces)
    np.testing.assert_allclose(place.interpolate(vertices, faces)[0], [9.5, 0.2, 0.0], atol=1e-9)


def test_normals_choose_the_right_side_of_a_thin_plate() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1]], dtype=float)
    faces = np.array([[0, 2, 1], [3, 4, 5]])
    query, down = np.array([[0.2, 0.2, 0.09]]), np.array([[0.0, 0.0, -1.0]])
    assert find_closest_on_mesh(query, down, vertices, faces).face[0] == 0
    assert find_closest_on_mesh(query, -down, vertices, faces).face[0] == 1


def test_of_two_near_faces_the_parallel_one_is_taken() -> None:
    ledge = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    wall = [[0.3, -1, -0.999], [0.3, 1, -0.999], [0.3, 0, 1.001]]
    vertices, faces = np.array(ledge + wall, dtype=float), np.array([[0, 1, 2], [3, 4, 5]])
    point, up, across = np.array([[0.297, 0.2, 0.0035]]), np.array([[0.0, 0.0, 2.0]]), np.array([[2.0, 0.0, 0.0]])
    assert find_closest_on_mesh(point, None, vertices, faces).face[0] == 1
    assert find_closest_on_mesh(point, up, vertices, faces).face[0] == 0
    assert find_closest_on_mesh(point, across, vertices, faces).face[0] == 1


def test_correspondence_follows_a_rigid_motion() -> None:
    vertices, faces = sphere()
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = 2 * vertices @ turn.T + SHIFT
    finer, finer_faces = sphere(30, 40)
    scan_a = Scan(finer * 1.01, finer_faces)
    points, distance = correspond(
        vertices, moved, faces, scan_a, Scan(2 * finer @ turn.T + [5.0, 0.0, 0.0], finer_faces)
    )
    assert np.linalg.norm(points - (2 * finer @ turn.T + [5.0, 0.0, 0.0]), axis=1).max() < 0.08
    assert distance.max() < 0.08


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_closest_places_do_not_depend_on_the_unit(size: float) -> None:
    vertices, faces = sphere()
    points = np.random.default_rng(1).normal(size=(200, 3))
    expected = find_closest_on_mesh(points, None, vertices, faces).interpolate(vertices, faces)
    found = find_closest_on_mesh(size * points, None, size * vertices, faces).interpolate(size * vertices, faces)
    np.testing.assert_allclose(found / size, expected, atol=1e-9)


def test_correspondence_onto_a_cloud_gives_its_points() -> None:
    vertices, faces = sphere()
    points, _ = correspond(vertices, vertices, faces, Scan(vertices, faces), Scan(vertices[::-1].copy()))
    assert points == pytest.approx(vertices)


@pytest.fixture(scope="module")
def ball() -> Ball:
    vertices, faces = sphere(40, 60)
    return vertices, faces, Cloud.of(vertices, vertices)


def test_a_body_on_its_cloud_is_not_pulled(ball: Ball) -> None:
    vertices, faces, cloud = ball
    quadratic = TwoWayCorrespondence(cloud).attract(vertices, faces, 0.1)
    np.testing.assert_allclose(quadratic.vector, 0, atol=1e-12)
    assert np.trace(quadratic.matrix.sum(axis=0)) == pytest.approx(2 * (1 + 3 * 0.05))


def test_a_moved_body_is_pulled_back(ball: Ball) -> None:
    vertices, faces, cloud = ball
    move = np.array([0.02, -0.01, 0.03])
    quadratic = TwoWayCorrespondence(cloud).attract(vertices + move, faces, 0.1)
    step = np.linalg.solve(quadratic.matrix.sum(axis=0), -quadratic.vector.sum(axis=0))
    np.testing.assert_allclose(step, -move, atol=0.006)


def test_sets_that_take_turns_pull_alike_and_together_reach_every_vertex(ball: Ball) -> None:
    vertices, faces, cloud = ball
    move = np.array([0.02, -0.01, 0.03])
    matches, reached = TwoWayCorrespondence(cloud, alternate=3), np.zeros(len(vertices), dtype=bool)
    for turn in range(6):
        quadratic = matches.attract(vertices + move, faces, 0.1, turn)
        step = np.linalg.solve(quadratic.matrix.sum(axis=0), -quadratic.vector.sum(axis=0))
        np.testing.assert_allclose(step, -move, atol=0.006)
        pulled = quadratic.matrix.any(axis=(1, 2))
        assert pulled[turn % 3 :: 3].all() and pulled.mean() < 0.9
        reached |= pulled
    assert reached.all()


def test_contradicting_normals_and_far_points_do_not_pull(ball: Ball) -> None:
    vertices, faces, _ = ball
    inside_out = Cloud.of(vertices, -vertices)
    assert not TwoWayCorrespondence(inside_out).attract(vertices, faces, 0.1).matrix.any()
    far = TwoWayCorrespondence(Cloud.of(vertices, vertices)).attract(vertices + SHIFT, faces, 0.1)
    assert np.abs(far.matrix).sum() < 1e-3


def test_only_the_seen_side_counts(ball: Ball) -> None:
    vertices, faces, _ = ball
    front = vertices[vertices[:, 0] > 0]
    one_sided = Cloud.of(front, front, viewpoint=np.array([50.0, 0.0, 0.0]))
    seen = one_sided.sees(vertices, vertices)
    assert np.all(seen == (vertices[:, 0] > 1 / 50))
    assert two_way_distance(vertices, faces, one_sided) < 0.03
    assert two_way_distance(vertices, faces, Cloud.of(front, front)) > 0.1


def test_two_way_distance_sees_what_either_side_lacks(ball: Ball) -> None:
    vertices, faces, cloud = ball
    assert two_way_distance(vertices, faces, cloud) < 0.02
    apart = Cloud.of(np.concatenate([vertices, vertices + SHIFT]), np.concatenate([vertices, vertices]))
    assert two_way_distance(vertices, faces, apart) > 0.4
