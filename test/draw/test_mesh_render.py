# SPDX-License-Identifier: Apache-2.0
"""The software renderer against geometry that can be worked out by hand."""

import numpy as np
import pytest

from flowing_puppet_ros.draw.mesh_render import Canvas, fit_orthographic_camera, render

BOX = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.3, 0.3) for z in (-0.5, 0.5)])
# Faces of the box, counter-clockwise seen from outside.
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])


class Pinhole:
    """A camera at (-5, 0, 0) that looks along +x: image right is -y, image down is -z."""

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = (np.asarray(points, float) + np.array([5.0, 0, 0])).T
        return np.stack([100 - 400 * y / x, 100 - 400 * z / x], axis=1), x


def test_orthographic_view_has_the_size_of_the_box() -> None:
    size = (200, 220)
    camera = fit_orthographic_camera(BOX, direction=(-1, 0, 0), size=size, margin=0.05)
    picture = render(BOX, FACES, camera, size)
    rows, columns = np.nonzero(picture.mask)
    assert np.ptp(rows) + 1 == pytest.approx(198, abs=1.5)  # 1 m high fills 90 % of 220 rows
    assert np.ptp(columns) + 1 == pytest.approx(198 * 0.6, abs=1.5)
    assert picture.coverage.sum() == pytest.approx(198 * 198 * 0.6, rel=0.01)
    inside = picture.depth[100:120, 90:110]
    # The near side is half the box's depth (0.2 m) before the centre, which is 1.2 m away.
    assert np.allclose(inside, 1.0, atol=1e-5)


def test_front_view_shows_the_persons_left_on_the_right() -> None:
    pixels, depth = fit_orthographic_camera(BOX, (-1, 0, 0), (100, 100)).project(
        np.array([[0, 0.3, 0], [0, 0, 0.4], [0.2, 0, 0]])
    )
    assert pixels[0, 0] > 60 and pixels[1, 1] < 30
    assert depth[2] < depth[0]


def test_fixed_scale_is_kept() -> None:
    camera = fit_orthographic_camera(BOX, (0, -1, 0), (300, 300), scale=123.0)
    pixels, _ = camera.project(np.array([[0, 0, 0], [0, 0, 1.0]]))
    assert np.linalg.norm(pixels[1] - pixels[0]) == pytest.approx(123)


@pytest.mark.parametrize("near_first", [True, False])
def test_nearest_surface_wins_in_any_order(near_first: bool) -> None:
    near, far = BOX - np.array([1, 0, 0]), BOX * 2 + np.array([1.5, 0, 0])
    canvas = Canvas(Pinhole(), (200, 200))
    meshes = [(near, (255, 0, 0)), (far, (0, 0, 255))]
    for vertices, colour in meshes if near_first else meshes[::-1]:
        canvas.draw_mesh(vertices, FACES, colour)
    rgb = canvas.compose().rgb
    assert rgb[100, 100, 0] > 100 and rgb[100, 100, 2] == 0


def test_perspective_mesh_stands_where_its_projection_is() -> None:
    picture = render(BOX, FACES, Pinhole(), (200, 200))
    pixels, _ = Pinhole().project(BOX)
    rows, columns = np.nonzero(picture.mask)
    assert [columns.min(), rows.min()] == pytest.approx(pixels.min(axis=0), abs=1)
    assert [columns.max(), rows.max()] == pytest.approx(pixels.max(axis=0), abs=1)


def test_inside_faces_are_darker() -> None:
    camera = fit_orthographic_camera(BOX, (-1, 0, 0), (80, 80))
    outside = render(BOX, FACES, camera, (80, 80), smooth=False).rgb[40, 40]
    inside = render(BOX, FACES[:, ::-1], camera, (80, 80), smooth=False).rgb[40, 40]
    assert (inside.astype(int) < outside.astype(int) - 60).all()


def test_face_and_vertex_colours() -> None:
    camera = fit_orthographic_camera(BOX, (-1, 0, 0), (80, 80))
    per_face = np.zeros((len(FACES), 3))
    per_face[2:4] = (0, 200, 0)  # the side at +x, that the camera sees
    assert render(BOX, FACES, camera, (80, 80), per_face).rgb[40, 40].argmax() == 1
    per_vertex = np.where(BOX[:, 1:2] > 0, (200, 0, 0), (0, 0, 200))
    rgb = render(BOX, FACES, camera, (80, 80), per_vertex).rgb
    assert rgb[40, 60, 0] > rgb[40, 60, 2] and rgb[40, 20, 2] > rgb[40, 20, 0]


def test_faces_behind_the_camera_and_nan_are_left_out() -> None:
    vertices = BOX.copy()
    vertices[0] = np.nan
    picture = render(vertices, FACES[:2], Pinhole(), (50, 50))
    assert not picture.mask.any()
    assert not render(BOX - np.array([9, 0, 0]), FACES, Pinhole(), (50, 50)).mask.any()


def test_points_are_discs_hidden_by_nearer_ones() -> None:
    canvas = Canvas(Pinhole(), (200, 200), samples=1)
    canvas.draw_points(np.array([[0, 0, 0], [1.0, 0, 0]]), np.array([[255, 0, 0], [0, 0, 255]]), radius=4)
    picture = canvas.compose()
    red = (picture.rgb == (255, 0, 0)).all(axis=2)
    assert red.sum() == sum(x * x + y * y <= 16 for x in range(-4, 5) for y in range(-4, 5))
    assert not (picture.rgb == (0, 0, 255)).all(axis=2).any()


def test_opacity_blends_with_the_background_image() -> None:
    background = np.full((200, 200, 3), 100, np.uint8)
    canvas = Canvas(Pinhole(), (200, 200))
    canvas.draw_mesh(BOX, FACES, (200, 0, 0))
    full, half = canvas.compose(background).rgb, canvas.compose(background, opacity=0.5).rgb
    assert (full[0, 0] == 100).all() and (half[0, 0] == 100).all()
    assert np.abs(half.astype(float) - (full.astype(float) + 100) / 2).max() <= 1
