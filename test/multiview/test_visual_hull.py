# SPDX-License-Identifier: Apache-2.0
"""Hulls of analytic bodies: the carved surface against the exact cones of the silhouettes, and bad masks."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.visual_hull import HullSettings, bounds_of_joints, bounds_of_masks, visual_hull

Ring = Callable[..., list[Camera]]
LENS = (-0.05, 0.1, 0.001, -0.001, 0.0)
BOX = np.array([[-0.8, -0.8, -1.0], [0.8, 0.8, 1.0]])
# start, end, radius of a body with one raised arm, metres
CAPSULES = [
    ((0, 0, 0.45), (0, 0, -0.1), 0.15),
    ((0, 0, 0.72), (0, 0, 0.78), 0.1),
    ((0, 0.18, 0.45), (0.1, 0.6, 0.7), 0.045),
    ((0, -0.18, 0.45), (0, -0.3, 0.0), 0.045),
    ((0, 0.1, -0.1), (0.15, 0.2, -0.85), 0.07),
    ((0, -0.1, -0.1), (-0.1, -0.2, -0.85), 0.07),
]
BALL = [((0.1, -0.05, 0.2), (0.1, -0.05, 0.2), 0.3)]


def outside(centre: np.ndarray, rays: np.ndarray, capsules: list) -> np.ndarray:
    """How far lines from `centre` along unit `rays` (..., 3) pass outside the nearest capsule, metres."""
    gaps = []
    for start, end, radius in capsules:
        axis, offset = np.subtract(end, start), centre - start
        across, along = rays @ axis, rays @ offset
        s = np.clip((axis @ offset - across * along) / np.maximum(axis @ axis - across**2, 1e-12), 0, 1)
        nearest = start + s[..., None] * axis - centre
        t = (nearest * rays).sum(axis=-1)
        gaps.append(np.linalg.norm(nearest - t[..., None] * rays, axis=-1) - radius)
    return np.min(gaps, axis=0)


def mask(camera: Camera, capsules: list) -> np.ndarray:
    pixels = np.stack(np.meshgrid(*map(np.arange, camera.size)), axis=-1)
    return np.where(outside(camera.centre, camera.cast_rays(pixels), capsules) <= 0, 255, 0).astype(np.uint8)


def hull_distance(cameras: list[Camera], points: np.ndarray, capsules: list) -> np.ndarray:
    """The exact hull's signed distance: the largest over the cameras of the distance outside their cone."""
    rays = [points - camera.centre for camera in cameras]
    rays = [ray / np.linalg.norm(ray, axis=-1, keepdims=True) for ray in rays]
    return np.max([outside(c.centre, r, capsules) for c, r in zip(cameras, rays, strict=True)], axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("capsules", [BALL, CAPSULES], ids=["ball", "body"])
@pytest.mark.parametrize("count", [2, 4, 8])
def test_the_surface_lies_on_the_exact_cones(ring: Ring, count: int, capsules: list) -> None:
    cameras = ring(5, lens=LENS)[:2] if count == 2 else ring(count, lens=LENS)
    settings = HullSettings(tolerance=0.0)
    points, normals = visual_hull(cameras, [mask(c, capsules) for c in cameras], BOX, settings)
    distance = np.abs(hull_distance(cameras, points, capsules))
    # A pixel is 1 cm and a voxel 2 cm: the surface is found to a fraction of both but where cones meet in an edge.
    assert np.median(distance) < 0.003
    assert np.quantile(distance, 0.95) < 0.012
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    rise = hull_distance(cameras, points + 0.01 * normals, capsules) - hull_distance(
        cameras, points - 0.01 * normals, capsules
    )
    assert (rise > 0).mean() > 0.99
    assert np.median(rise) > 0.018


def test_no_part_of_the_body_is_carved_away(ring: Ring) -> None:
    cameras = ring(8)
    points, _ = visual_hull(cameras, [mask(c, CAPSULES) for c in cameras], BOX)
    for start, end, radius in CAPSULES:
        for s in np.linspace(0, 1, 9):
            centre = np.asarray(start) + s * np.subtract(end, start)
            assert np.linalg.norm(points - centre, axis=1).min() > radius - 0.01
    assert points[:, 2].max() > 0.86 and points[:, 2].min() < -0.90


@pytest.mark.slow
def test_the_volume_of_a_balls_hull(ring: Ring) -> None:
    cameras = ring(8)
    points, _ = visual_hull(cameras, [mask(c, BALL) for c in cameras], BOX, HullSettings(tolerance=0.0))
    grid = np.stack(np.meshgrid(*[np.arange(-0.5, 0.7, 0.015)] * 3, indexing="ij"), axis=-1)
    exact = np.count_nonzero(hull_distance(cameras, grid, BALL) <= 0) * 0.015**3
    assert ConvexHull(points).volume == pytest.approx(exact, rel=0.03)
    assert exact > 4 / 3 * np.pi * 0.3**3


def test_tolerance_swells_the_hull_by_as_much(ring: Ring) -> None:
    cameras = ring(4)
    masks = [mask(c, BALL) for c in cameras]
    for tolerance in (-0.02, 0.03):
        points, _ = visual_hull(cameras, masks, BOX, HullSettings(tolerance=tolerance))
        assert np.median(hull_distance(cameras, points, BALL)) == pytest.approx(tolerance, abs=0.004)


def test_masks_of_any_scale_fit_their_camera(ring: Ring) -> None:
    cameras = ring(4)
    small = [mask(c.scale(0.5), BALL) for c in cameras]
    points, _ = visual_hull(cameras, small, BOX, HullSettings(tolerance=0.0))
    assert np.median(np.abs(hull_distance(cameras, points, BALL))) < 0.004


def test_only_the_largest_component_is_kept(ring: Ring) -> None:
    cameras = ring(8)
    speck = ((-0.5, 0.5, -0.5), (-0.5, 0.5, -0.5), 0.06)
    points, _ = visual_hull(cameras, [mask(c, [*BALL, speck]) for c in cameras], BOX)
    assert np.linalg.norm(points - BALL[0][0], axis=1).max() < 0.5


def test_what_a_camera_does_not_see_is_the_others_affair(ring: Ring) -> None:
    cameras = ring(4)
    narrow = ring(4, size=(240, 120))[0]  # sees the middle only
    views = [narrow, *cameras[1:]]
    points, _ = visual_hull(views, [mask(c, CAPSULES) for c in views], BOX)
    assert points[:, 2].max() > 0.86 and points[:, 2].min() < -0.90


def test_what_a_lens_would_fold_into_the_image_is_the_others_affair(ring: Ring) -> None:
    cameras = ring(5)
    # Turned by 61 degrees: the body is far outside its view, where the lens model folds it onto the image's middle.
    c, s = np.cos(np.radians(61.0)), np.sin(np.radians(61.0))
    aside = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    blind = replace(
        cameras[4],
        distortion=np.array([-0.3, 0, 0, 0, 0]),
        rotation=aside @ cameras[4].rotation,
        translation=aside @ cameras[4].translation,
    )
    masks = [mask(camera, CAPSULES) for camera in cameras[:4]]
    empty = np.zeros((320, 240), np.uint8)
    empty[0, 0] = 255
    expected, _ = visual_hull(cameras[:4], masks, BOX)
    points, _ = visual_hull([*cameras[:4], blind], [*masks, empty], BOX)
    np.testing.assert_allclose(points, expected, atol=1e-6)


def test_nothing_is_kept_where_one_camera_alone_sees(ring: Ring) -> None:
    cameras = ring(5)[:2]
    full = [np.full((320, 240), 255, np.uint8) for _ in cameras]
    points, _ = visual_hull(cameras, full, BOX * 2.5, HullSettings(voxel=0.05))
    for camera in cameras:
        pixels, depth = camera.project(points)
        assert (depth > -0.05).all()
        assert (pixels > -12).all() and (pixels < np.array(camera.size) + 12).all()


def test_bounds_of_masks_hold_the_body(ring: Ring) -> None:
    cameras = ring(4)
    low, high = bounds_of_masks(cameras, [mask(c, CAPSULES) for c in cameras], 0.1)
    ends = np.array([end for capsule in CAPSULES for end in capsule[:2]])
    assert (low < ends.min(axis=0) - 0.05).all() and (high > ends.max(axis=0) + 0.05).all()
    assert (high - low).max() < 3


def test_bounds_of_joints() -> None:
    joints = np.array([[0.0, 0, 0], [0.2, -0.3, 1.0]])
    box = bounds_of_joints(joints, 0.1)
    assert box is not None
    np.testing.assert_allclose(box, [[-0.1, -0.4, -0.1], [0.3, 0.1, 1.1]])
    assert bounds_of_joints(np.vstack([joints, [np.nan] * 3]), 0.1) is None
    assert bounds_of_joints(np.vstack([joints, joints, [[0, 0, 5]]]), 0.1) is None
    assert bounds_of_joints(np.zeros((0, 3)), 0.1) is None


def test_same_masks_same_bits(ring: Ring) -> None:
    cameras = ring(4)
    masks = [mask(c, CAPSULES) for c in cameras]
    first, second = (visual_hull(cameras, masks, BOX) for _ in range(2))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(first, second, strict=True))


def test_too_few_or_contradicting_silhouettes_are_one_sentence(ring: Ring) -> None:
    cameras = ring(3)
    masks = [mask(c, BALL) for c in cameras]
    empty = np.zeros_like(masks[0])
    with pytest.raises(PuppetError, match="at least 2 cameras, got 1"):
        visual_hull(cameras, [masks[0], empty, empty], BOX)
    with pytest.raises(PuppetError, match="at least 2 cameras, got 0"):
        bounds_of_masks(cameras, [empty] * 3, 0.1)
    elsewhere = mask(cameras[1], [((0, 0, -0.6), (0, 0, -0.6), 0.05)])
    with pytest.raises(PuppetError, match=r"no common space in the box of 1\.60 x 1\.60 x 2\.00 m"):
        visual_hull(cameras, [masks[0], elsewhere, masks[2]], BOX)


def test_unfit_masks_and_bounds_are_refused(ring: Ring) -> None:
    cameras = ring(2)
    masks = [mask(c, BALL) for c in cameras]
    with pytest.raises(InputError, match="one mask per camera, got 1 for 2"):
        visual_hull(cameras, masks[:1], BOX)
    with pytest.raises(InputError, match=r"mask 1 is \(320, 240\) of float64"):
        visual_hull(cameras, [masks[0], masks[1].astype(float)], BOX)
    with pytest.raises(InputError, match="mask 1 is 320 x 240, which is not a scaled 240 x 320 image"):
        visual_hull(cameras, [masks[0], masks[1].T], BOX)
    with pytest.raises(InputError, match="low and high corner"):
        visual_hull(cameras, masks, BOX[::-1])
    with pytest.raises(InputError, match="low and high corner"):
        visual_hull(cameras, masks, BOX * np.nan)
    with pytest.raises(InputError, match=r"too many voxels of 0\.002 m"):
        visual_hull(cameras, masks, BOX, HullSettings(voxel=0.002))
