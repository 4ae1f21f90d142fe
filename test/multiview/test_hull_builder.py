# SPDX-License-Identifier: Apache-2.0
"""Puppets of several cameras to masks, joints and a hull: the whole path on drawn spheres, and what goes wrong."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import CameraObservation, HullBuilder, HullBuilderSettings

Ring = Callable[..., list[Camera]]
RADIUS = 0.35
JOINTS = np.array([[0, 0, 0.3], [0, 0.3, 0], [0, -0.3, 0], [0, 0, -0.3]])
SETTINGS = HullBuilderSettings.from_mapping({"hull.margin": 0.2})


def builder(cameras: list[Camera]) -> HullBuilder:
    made = HullBuilder(SETTINGS)
    for index, camera in enumerate(cameras):
        made.set_camera(f"cam{index}", camera)
    return made


def ball(camera: Camera, radius: float = RADIUS) -> np.ndarray:
    """Labels of a ball at the origin as `camera` sees it."""
    pixels = np.stack(np.meshgrid(*map(np.arange, camera.size)), axis=-1)
    rays = camera.cast_rays(pixels)
    gap = np.linalg.norm(np.cross(rays, camera.centre), axis=-1)
    return (gap < radius).astype(np.uint8)


def view(made: HullBuilder, name: str, seed: int = 0, empty: bool = False) -> CameraObservation:
    camera = made.cameras[name]
    noise = np.random.default_rng(seed).normal(scale=3, size=(*camera.size[::-1], 3))
    image = np.where(ball(camera)[..., None] > 0, (200, 90, 60), (70, 100, 90)) + noise
    labels = np.zeros(camera.size[::-1], np.uint8) if empty else ball(camera, RADIUS - 0.02)
    pixels, depth = camera.project(JOINTS)
    observed = made.update_background(
        name, np.clip(image, 0, 255).astype(np.uint8), labels, camera.focal / float(depth.mean())
    )
    return CameraObservation(observed, pixels, np.full(len(JOINTS), 0.9))


def test_a_ball_in_four_cameras_becomes_points_normals_and_joints(ring: Ring) -> None:
    made = builder(ring(4))
    person = made.segment({name: view(made, name) for name in made.cameras})
    hull = made.carve(person)
    assert person.problem == hull.problem == ""
    np.testing.assert_allclose(person.joints, JOINTS, atol=1e-6)
    np.testing.assert_allclose(person.confidence, 0.9)
    radius = np.linalg.norm(hull.points, axis=1)
    assert radius.min() > 0.33 and radius.max() < 0.6
    assert ((hull.points * hull.normals).sum(axis=1) > 0).mean() > 0.99
    assert set(person.silhouettes) == set(person.masks) == set(made.cameras)


def test_a_camera_with_a_bad_mask_is_left_out(ring: Ring) -> None:
    made = builder(ring(4))
    views = {name: view(made, name, empty=name == "cam2") for name in made.cameras}
    person = made.segment(views)
    others = builder(ring(4))
    del views["cam2"]
    expected = others.carve(others.segment({name: view(others, name) for name in views}))
    assert person.problem == "" and person.silhouettes["cam2"].problem and "cam2" not in person.masks
    np.testing.assert_allclose(made.carve(person).points, expected.points, atol=1e-6)


def test_too_few_usable_silhouettes_still_give_the_joints(ring: Ring) -> None:
    made = builder(ring(3))
    person = made.segment({name: view(made, name, empty=name != "cam1") for name in made.cameras})
    hull = made.carve(person)
    assert hull.points.shape == hull.normals.shape == (0, 3)
    assert "needs 2 usable silhouettes, got 1 (cam0: no puppet in the image; cam2: no puppet" in hull.problem
    np.testing.assert_allclose(person.joints, JOINTS, atol=1e-6)


def test_one_camera_gives_neither_hull_nor_joints(ring: Ring) -> None:
    made = builder(ring(1))
    person = made.segment({"cam0": view(made, "cam0")})
    assert "got 1" in made.carve(person).problem
    assert np.isnan(person.joints).all() and person.joints.shape == (4, 3)


def test_unknown_joints_leave_the_search_to_the_masks(ring: Ring) -> None:
    made = builder(ring(4))
    views = {}
    for name in made.cameras:
        seen = view(made, name)
        views[name] = CameraObservation(seen.observation, np.full((4, 2), np.nan), np.zeros(4))
    person = made.segment(views)
    hull = made.carve(person)
    assert hull.problem == "" and np.isnan(person.joints).all()
    assert np.linalg.norm(hull.points, axis=1).min() > 0.33


def test_contradicting_cameras_are_a_problem_not_an_error(ring: Ring) -> None:
    made = builder(ring(4))
    views = {name: view(made, name) for name in made.cameras}
    aside = replace(made.cameras["cam1"], translation=made.cameras["cam1"].translation + np.array([0.9, 0, 0]))
    made.cameras["cam1"] = aside
    assert "no common space" in made.carve(made.segment(views)).problem


def test_a_moved_camera_learns_its_background_again(ring: Ring) -> None:
    made = builder(ring(2))
    for seed in range(4):
        view(made, "cam0", seed)
    made.set_camera("cam0", made.cameras["cam0"])
    assert made.background_share("cam0") > 0.4
    made.set_camera("cam0", ring(3)[1])
    assert made.background_share("cam0") == 0


def test_a_set_observed_before_a_reset_is_still_cut(ring: Ring) -> None:
    made = builder(ring(4))
    views = {name: view(made, name) for name in made.cameras}
    made.reset()
    assert made.background_share("cam0") == 0
    assert made.segment(views).problem == ""


def test_images_of_another_size_and_unknown_cameras_are_refused(ring: Ring) -> None:
    made = builder(ring(2))
    with pytest.raises(InputError, match="camera cam0 is 100 x 50, its camera_info says 240 x 320"):
        made.update_background("cam0", np.zeros((50, 100, 3), np.uint8), np.zeros((50, 100), np.uint8), 100.0)
    seen = view(made, "cam0")
    with pytest.raises(InputError, match="camera side has no calibration"):
        made.segment({"side": seen})
