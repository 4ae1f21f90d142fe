# SPDX-License-Identifier: Apache-2.0
"""Attraction to silhouettes: directions against finite differences, and an ellipsoid that finds its outlines."""

from collections.abc import Callable

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import VertexQuadratic
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rim_term import Outline, RimTerm, measure_outside, mesh_edges

Ring = Callable[..., list[Camera]]
CENTRE, RADII = np.array([0.05, -0.04, 0.1]), np.array([0.25, 0.4, 0.7])


def sphere(rings: int = 24, sectors: int = 36) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere without its poles: vertices (V,3) and outward faces (F,3)."""
    polar, turn = np.meshgrid(np.pi * (np.arange(rings) + 0.5) / rings, 2 * np.pi * np.arange(sectors) / sectors)
    polar, turn = polar.T, turn.T
    vertices = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    faces = []
    for i in range(rings - 1):
        for j in range(sectors):
            a, b = i * sectors + j, i * sectors + (j + 1) % sectors
            faces += [(a, a + sectors, b), (b, a + sectors, b + sectors)]
    return vertices, np.array(faces, np.int32)


def ellipsoid_mask(camera: Camera) -> np.ndarray:
    rays = camera.cast_rays(np.stack(np.meshgrid(*map(np.arange, camera.size)), axis=-1)) / RADII
    offset = (camera.centre - CENTRE) / RADII
    b, a = rays @ offset, (rays**2).sum(axis=-1)
    return np.where(b * b - a * (offset @ offset - 1) >= 0, 255, 0).astype(np.uint8)


def attraction(vertices: np.ndarray, faces: np.ndarray, seen: list[Outline], sigma: float) -> VertexQuadratic:
    return RimTerm(seen, faces, mesh_edges(faces))(vertices, sigma)


def outlines(cameras: list[Camera]) -> list[Outline]:
    return [Outline.of(camera, ellipsoid_mask(camera)) for camera in cameras]


def energy(quadratic: VertexQuadratic, move: np.ndarray) -> float:
    return float(
        np.einsum("vi,vij,vj->", move, quadratic.matrix, move) + 2 * np.einsum("vi,vi->", move, quadratic.vector)
    )


@pytest.mark.parametrize("count", [3, 4])
def test_an_ellipsoid_finds_place_and_size(ring: Ring, count: int) -> None:
    unit, faces = sphere()
    centre, radii = CENTRE + np.array([0.06, -0.05, 0.08]), RADII * (1.2, 0.85, 1.1)
    seen = outlines(ring(count, size=(240, 400)))
    for sigma in np.geomspace(0.1, 0.02, 12):
        quadratic = attraction(centre + radii * unit, faces, seen, sigma)
        jacobian = np.concatenate([np.tile(np.eye(3), (len(unit), 1, 1)), unit[:, None, :] * np.eye(3)], axis=2)
        hessian = np.einsum("via,vij,vjb->ab", jacobian, quadratic.matrix, jacobian)
        step = np.linalg.solve(hessian, -np.einsum("via,vi->a", jacobian, quadratic.vector))
        centre, radii = centre + step[:3], radii + step[3:]
    # A pixel is one centimetre here.
    np.testing.assert_allclose(centre, CENTRE, atol=0.005)
    np.testing.assert_allclose(radii, RADII, atol=0.008)


def test_a_body_on_its_outlines_is_hardly_attracted(ring: Ring) -> None:
    unit, faces = sphere()
    seen = outlines(ring(4, size=(240, 400)))
    there = attraction(CENTRE + RADII * unit, faces, seen, 0.05)
    aside = attraction(CENTRE + RADII * unit + (0.04, 0, 0), faces, seen, 0.05)
    pull = [np.linalg.norm(each.vector.sum(axis=0)) for each in (there, aside)]
    assert pull[0] < 0.1 * pull[1]
    assert aside.vector.sum(axis=0)[0] > 0  # moving further off would cost more


def test_the_quadratic_is_the_squared_change_of_the_signed_distance(ring: Ring) -> None:
    # One vertex outside one silhouette, its kernel wide open: the energy of a small move is the change of d squared.
    camera = ring(4, size=(240, 400))[0]
    outline = Outline.of(camera, ellipsoid_mask(camera))
    vertex = CENTRE + np.array([[0.0, 0.1, 0.9]])
    quadratic = attraction(vertex, np.zeros((0, 3), np.int32), [outline], 1e3)

    def distance(point: np.ndarray) -> float:
        (pixel,), (depth,) = camera.project(point)
        column, row = np.floor(pixel).astype(int)
        u, v = pixel - (column, row)
        d = outline.distance[row : row + 2, column : column + 2]
        return float(np.array([1 - v, v]) @ d @ np.array([1 - u, u])) * depth / camera.focal

    assert distance(vertex) > 0.05
    rng = np.random.default_rng(0)
    for _ in range(10):
        move = rng.normal(size=(1, 3)) * 0.01
        # The depth changes too, which the linearisation leaves out: that is a small share of the distance.
        expected = distance(vertex + move) ** 2 - distance(vertex) ** 2
        assert energy(quadratic, move) == pytest.approx(expected, rel=0.1, abs=4e-4)


def test_what_no_camera_sees_is_not_attracted(ring: Ring) -> None:
    unit, faces = sphere()
    seen = outlines(ring(2, size=(240, 400)))
    behind = seen[0].camera.centre * 2 + 0.1 * unit
    quadratic = attraction(behind, faces, seen[:1], 0.05)
    assert not quadratic.matrix.any() and not quadratic.vector.any()


def test_the_images_border_is_no_outline(ring: Ring) -> None:
    camera = ring(4, size=(240, 120))[0]  # the ellipsoid is cut off above and below
    points = Outline.of(camera, ellipsoid_mask(camera)).points
    assert len(points) > 20
    assert points[:, 1].min() > 1 and points[:, 1].max() < 118


def test_a_mask_without_an_outline_is_refused(ring: Ring) -> None:
    for value in (0, 255):
        with pytest.raises(InputError, match="240 x 320 pixels is empty or full"):
            Outline.of(ring(2)[0], np.full((320, 240), value, np.uint8))


def test_edges_are_those_of_the_faces() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3], [0, 2, 3], [0, 3, 1]], np.int32)
    assert mesh_edges(faces).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_distances_to_a_silhouette_are_metres_at_the_depth(ring: Ring) -> None:
    camera = ring(4, size=(240, 400))[0]
    mask = np.zeros(camera.size[::-1], np.uint8)
    mask[:, 100:] = 255  # its outline is at column 99.5
    outline = Outline.of(camera, mask)
    for depth in (2.0, 3.0, 5.0):
        columns = np.array([60.0, 90.0, 130.0])
        plane = np.stack([columns, np.full(3, 200.0)], axis=1)
        points = (
            camera.centre + camera.cast_rays(plane) * (depth / (camera.cast_rays(plane) @ camera.rotation[2]))[:, None]
        )
        seen, distance, slope = measure_outside(points, outline)
        assert seen.tolist() == [0, 1, 2]
        np.testing.assert_allclose(distance, (99.5 - columns) * depth / camera.focal, atol=1e-6)
        np.testing.assert_allclose(slope, [[-1, 0]] * 3, atol=1e-6)
