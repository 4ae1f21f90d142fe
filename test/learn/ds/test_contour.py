# SPDX-License-Identifier: Apache-2.0
"""Silhouettes and contours of projected parts against brute force and shapes whose outline is known."""

import numpy as np
import pytest

from flowing_puppet_ros.learn.ds.contour import fill_silhouette, resample_sides, trace_contour


def disc(radius: float, center: tuple[float, float] = (0.0, 0.0), count: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """Return a fan of triangles: points (count + 1, 2), triangles (count, 3)."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = np.arange(count)
    triangles = np.stack([np.full(count, count), around, (around + 1) % count], axis=1)
    return np.vstack([rim, [0, 0]]) + center, triangles


def capsule(length: float, radius: float, bulge: float = 0.0, count: int = 400) -> np.ndarray:
    """Return the outline (4 * count, 2) of a bone on the x axis; `bulge` widens the side of positive y midway."""
    x = np.linspace(-length / 2, length / 2, count)
    cap = np.linspace(-np.pi / 2, np.pi / 2, count)
    right = np.stack([length / 2 + radius * np.cos(cap), radius * np.sin(cap)], axis=1)
    top = np.stack([x[::-1], radius + bulge * np.cos(np.pi * x[::-1] / length)], axis=1)
    return np.vstack([right, top, -right, np.stack([x, np.full(count, -radius)], axis=1)])


def test_silhouette_covers_the_pixels_inside_any_triangle() -> None:
    rng = np.random.default_rng(0)
    points, triangles = rng.uniform(-5, 35, (12, 2)), rng.integers(0, 12, (6, 3), dtype=np.int32)
    mask = fill_silhouette(points, triangles, (30, 40))
    y, x = np.mgrid[:30, :40]
    expected = np.zeros((30, 40), bool)
    for face in triangles:
        a, b, c = points[face]
        if len(set(face)) == 3:
            first, second, origin = b - a, c - a, np.stack([x, y], axis=-1) - a
            across = first[0] * second[1] - first[1] * second[0]
            u = (origin[..., 0] * second[1] - origin[..., 1] * second[0]) / across
            v = (first[0] * origin[..., 1] - first[1] * origin[..., 0]) / across
            expected |= (u >= 0) & (v >= 0) & (u + v <= 1)
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(mask, expected)


def test_closed_contour_follows_the_rim_of_a_disc() -> None:
    points, triangles = disc(0.1, (0.7, -0.3))
    contour = trace_contour(points, triangles)
    radius = np.linalg.norm(contour - (0.7, -0.3), axis=1)
    assert abs(radius - 0.1).max() < 0.003
    steps = np.linalg.norm(np.diff(contour, axis=0, append=contour[:1]), axis=1)
    assert steps.sum() == pytest.approx(2 * np.pi * 0.1, rel=0.05)


def test_closed_contour_takes_the_largest_piece() -> None:
    (large, first), (small, second) = disc(0.1), disc(0.03, (0.4, 0.0))
    contour = trace_contour(np.vstack([large, small]), np.vstack([first, second + len(large)]))
    assert contour[:, 0].max() < 0.11


def test_closed_contour_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="covers no area"):
        trace_contour(np.zeros((3, 2)), np.array([[0, 1, 2]]))


def test_sides_are_sampled_evenly_between_the_crossings_of_the_bone_line() -> None:
    outline = capsule(0.4, 0.05)
    points = resample_sides(outline, np.array([-0.2, 0.0]), np.array([0.2, 0.0]), 25)
    assert points.shape == (50, 2)
    np.testing.assert_allclose(points[[0, 25]], [[-0.25, 0.0], [0.25, 0.0]], atol=1e-3)
    assert (points[1:25, 1] > 0).all() and (points[26:, 1] < 0).all()
    steps = np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1)
    half = 0.4 + np.pi * 0.05
    np.testing.assert_allclose(steps, half / 25, rtol=0.01)


@pytest.mark.parametrize("reverse", [False, True])
def test_sampling_ignores_pose_start_and_direction_of_the_contour(reverse: bool) -> None:
    outline = capsule(0.4, 0.05, bulge=0.03)
    near, far = np.array([-0.2, 0.0]), np.array([0.2, 0.0])
    expected = resample_sides(outline, near, far, 20)
    turn = np.array([[np.cos(2.1), -np.sin(2.1)], [np.sin(2.1), np.cos(2.1)]])
    moved = np.roll(outline, 613, axis=0) @ turn.T + [3.0, -1.0]
    near, far = turn @ near + [3.0, -1.0], turn @ far + [3.0, -1.0]
    again = resample_sides(moved[::-1] if reverse else moved, near, far, 20)
    np.testing.assert_allclose(again, expected, atol=1e-9)


def test_mirror_image_exchanges_the_sides() -> None:
    outline = capsule(0.4, 0.05, bulge=0.03)
    near, far = np.array([-0.2, 0.0]), np.array([0.2, 0.0])
    points = resample_sides(outline, near, far, 2000)
    mirrored = resample_sides(outline * [1, -1], near, far, 2000)
    assert points[1000, 1] == pytest.approx(0.08, abs=1e-3)
    assert mirrored[1000, 1] == pytest.approx(0.05, abs=1e-3)
    assert mirrored[3000, 1] == pytest.approx(-0.08, abs=1e-3)


def test_bone_beside_the_contour_is_refused() -> None:
    with pytest.raises(ValueError, match="does not cross"):
        resample_sides(capsule(0.4, 0.05), np.array([-0.2, 0.5]), np.array([0.2, 0.5]), 10)
