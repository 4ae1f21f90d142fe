# SPDX-License-Identifier: Apache-2.0
"""Scenes of several sensors: what one saw where another saw through, and what is known of a person by all of them."""

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.scene.rig_agreement import find_seen_through
from flowing_puppet_ros.body.scene.rig_scene import RigScene
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorProjection
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig

WIDTH, HEIGHT, FOCAL, WALL_M = 64, 48, 50.0, 5.0
# Right, down and forward of a camera that looks along x, z up.
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def look_at_wall(eye: np.ndarray, floating: int = 0) -> SceneCloud:
    """Return what a camera sees that looks along x at a wall; its first pixels in the middle row are half as far."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(columns - 31.5) / FOCAL, (rows - 23.5) / FOCAL, np.ones_like(rows, dtype=float)], axis=-1) @ AHEAD
    depth = np.full((HEIGHT, WIDTH), WALL_M - eye[0])
    depth[24, 20 : 20 + floating] /= 2
    points = (eye + depth[..., None] * rays).reshape(-1, 3)
    optical = SensorProjection.pinhole(FOCAL, FOCAL, 31.5, 23.5)
    projection = optical.turn(AHEAD.T).move(eye)
    image = RangeImage.of_camera(projection, points, np.arange(len(points)), (HEIGHT, WIDTH))
    return SceneCloud(points, None, 0, True, image, eye)


def test_what_floats_where_another_sensor_saw_through_is_nobodys() -> None:
    parts = [look_at_wall(np.zeros(3), floating=6), look_at_wall(np.array([0.0, 0.4, 0.0]))]
    through = find_seen_through(parts)
    assert np.flatnonzero(through[0]).tolist() == [24 * WIDTH + 20 + k for k in range(6)]
    assert not through[1].any()  # the wall behind what floats is seen by both
    merged = RigScene.merge(parts, 7)
    assert len(merged.points) == 2 * WIDTH * HEIGHT - 6
    np.testing.assert_array_equal(np.bincount(merged.owner), [WIDTH * HEIGHT - 6, WIDTH * HEIGHT])


def test_a_place_is_unknown_where_no_sensor_knows_it() -> None:
    left, right = look_at_wall(np.array([0.0, 2.0, 0.0])), look_at_wall(np.array([0.0, -2.0, 0.0]))
    merged = RigScene.merge([left, right], 0)
    rows = np.arange(0, len(merged.points), 7)
    (person,) = merged.with_fields([PersonCloud(merged.points[rows], rows=rows)])
    assert isinstance(person.field, SensorRig)
    places = np.array([[2.0, 2.0, 0.0], [2.0, -2.0, 0.0], [2.0, 9.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(person.field.find_unknown(places), [False, False, True, True])
    alone = [field.find_unknown(places).tolist() for field in person.field.fields if field is not None]
    assert alone == [[False, True, True, True], [True, False, True, True]]


def test_a_surface_is_seen_by_the_sensor_that_it_faces() -> None:
    rig = SensorRig(np.array([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0]]), (None, None), np.zeros(0, dtype=np.int64))
    vertices = np.zeros((3, 3))
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.testing.assert_array_equal(rig.find_facing(vertices, normals), [True, True, False])


def test_a_part_of_a_scene_keeps_whose_points_are_whose() -> None:
    merged = RigScene.merge([look_at_wall(np.array([0.0, 2.0, 0.0])), look_at_wall(np.array([0.0, -2.0, 0.0]))], 3)
    rows = np.arange(len(merged.points)) % 3 == 0
    part = merged.take(rows)
    np.testing.assert_array_equal(part.points, merged.points[rows])
    np.testing.assert_array_equal(part.owner, merged.owner[rows])
    assert part.stamp == 3 and part.is_merged


def test_pixels_without_depth_may_be_doubted_but_for_the_persons_own() -> None:
    scene = look_at_wall(np.zeros(3))
    assert scene.image is not None
    row, column = np.unravel_index(np.arange(WIDTH * HEIGHT), (HEIGHT, WIDTH))
    dark = (row < 10) & (column < 10)
    person = np.flatnonzero((row == 30) & (column > 40))
    kept = np.flatnonzero(~dark)
    depth = scene.image.depth.copy()
    depth.reshape(-1)[dark] = np.inf
    image = RangeImage(scene.image.projection, scene.image.bounds, depth, scene.image.pixel)
    field = image.make_field(person)
    doubted = field.doubt_blanks(scene.points[person])
    before = scene.points * 0.5  # half way to everything
    assert not field.find_unknown(before).any()
    np.testing.assert_array_equal(np.flatnonzero(~doubted.find_unknown(before)), kept)
    behind = scene.points[person] * 1.5
    assert not doubted.find_unknown(behind).any()  # the person's own pixels hide nothing
