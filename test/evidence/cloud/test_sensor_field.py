# SPDX-License-Identifier: Apache-2.0
"""What a sensor can know, by hand-made fields, drawn scenes of known geometry, and views with and without a field."""

import numpy as np
import pytest

from flowing_puppet_ros.evidence.cloud.one_sided import OneSidedView
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField, SensorProjection

FOCAL, WIDTH, HEIGHT = 100.0, 80, 60
LENS = SensorProjection.pinhole(FOCAL, FOCAL, 39.5, 29.5)
TO_Z_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_points(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places (N, 3) and pixels (N,) of a depth image (60, 80) with NaN where nothing is known."""
    pixel = np.flatnonzero(np.isfinite(depth))
    z = depth.reshape(-1)[pixel]
    right, down = (pixel % WIDTH - 39.5) / FOCAL * z, (pixel // WIDTH - 29.5) / FOCAL * z
    return np.stack([right, down, z], axis=1), pixel


@pytest.fixture
def scene() -> np.ndarray:
    """A wall 4 m away, a table's edge 1 m away over the lower third, a person 2 m away of 20 by 30 pixels above it."""
    depth = np.full((HEIGHT, WIDTH), 4.0)
    depth[40:] = 1.0
    depth[10:40, 30:50] = 2.0
    return depth


def own_of(scene: np.ndarray) -> np.ndarray:
    return np.asarray(scene[np.isfinite(scene)] == 2.0)


def test_what_is_outside_the_image_or_behind_something_nearer_is_unknown(scene: np.ndarray) -> None:
    points, pixel = camera_points(scene)
    field = RangeImage.of_camera(LENS, points, pixel, scene.shape).make_field(own_of(scene))
    cases = (
        ((0.0, 0.0, 2.0), False),  # on the person
        ((0.0, 0.0, 2.5), False),  # behind the person's own surface, which the view itself judges
        ((0.5, 0.0, 2.0), False),  # before the wall
        ((0.5, 0.0, 4.04), False),  # in the wall, within 5 cm
        ((0.5, 0.0, 4.06), True),  # behind the wall
        ((0.0, 0.4, 2.0), True),  # behind the table: pixel row 49.5
        ((0.0, 0.2, 1.04), False),  # on the table
        ((0.0, 0.7, 2.0), True),  # below the image: pixel row 64.5
        ((0.0, 0.604, 2.0), True),  # row 59.7, just outside
        ((0.85, 0.0, 2.0), True),  # right of it: column 82
        ((0.0, 0.0, -2.0), True),  # behind the sensor
    )
    found = field.find_unknown(np.array([place for place, _ in cases]))
    assert found.tolist() == [unknown for _, unknown in cases]
    turned = RangeImage.of_camera(LENS, points, pixel, scene.shape).turn(TO_Z_UP).make_field(own_of(scene))
    again = turned.find_unknown(np.array([place for place, _ in cases]) @ TO_Z_UP.T)
    assert again.tolist() == found.tolist()


def test_depth_that_ends_a_little_inside_the_image_is_its_border_and_a_lone_person_is_not(scene: np.ndarray) -> None:
    scene[:, :4] = scene[57:] = np.nan
    points, pixel = camera_points(scene)
    bounds = RangeImage.of_camera(LENS, points, pixel, scene.shape).bounds
    assert bounds.tolist() == [3.5, -0.5, 79.5, 56.5]
    scene[scene != 2.0] = np.nan
    points, pixel = camera_points(scene)
    alone = RangeImage.of_camera(LENS, points, pixel, scene.shape)
    assert alone.bounds.tolist() == [-0.5, -0.5, 79.5, 59.5]


def test_an_organised_cloud_finds_its_own_calibration(scene: np.ndarray) -> None:
    scene[::3, ::5] = np.nan
    points, pixel = camera_points(scene)
    for axes in (np.eye(3), TO_Z_UP):
        image = RangeImage.of_organised((points @ axes.T).astype(np.float32).astype(float), pixel, scene.shape)
        assert image is not None
        np.testing.assert_allclose(image.projection.scale, FOCAL, rtol=1e-5)
        np.testing.assert_allclose(image.projection.offset, [39.5, 29.5], atol=1e-3)
        np.testing.assert_allclose(image.depth[np.isfinite(scene)], scene[np.isfinite(scene)], rtol=1e-6)
    rings = np.random.default_rng(0).permutation(points)  # in no order of an image
    assert RangeImage.of_organised(rings, pixel, scene.shape) is None
    assert RangeImage.of_organised(points[:50], pixel[:50], scene.shape) is None


def lidar(elevations: np.ndarray, height: float, sector: float = np.pi) -> tuple[np.ndarray, np.ndarray]:
    """A scan over a floor `height` below, in a hall with walls 6 m away and up, and who of it is a person at x = 3."""
    azimuth, elevation = np.meshgrid(np.arange(-sector, sector - 1e-9, np.radians(0.5)), elevations)
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        reach = np.minimum(
            6.0 / np.hypot(rays[:, 0], rays[:, 1]), np.where(rays[:, 2] < 0, -height / rays[:, 2], np.inf)
        )
    at = 3.0 / np.maximum(rays[:, 0], 1e-9)
    place = at[:, None] * rays
    person = (rays[:, 0] > 0) & (np.abs(place[:, 1]) < 0.25) & (place[:, 2] < 1.7 - height) & (place[:, 2] > -height)
    reach = np.where(person, at, reach)
    return rays * reach[:, None], person


@pytest.mark.parametrize("sector", [np.pi, np.radians(75.0)])
def test_a_lidar_sees_between_its_lowest_and_its_highest_ring(sector: float) -> None:
    points, person = lidar(np.radians(np.arange(-15.0, 15.1, 1.0)), 1.0, sector)
    field = RangeImage.of_scan(points, np.zeros(3)).make_field(person)
    heights = np.tan(np.radians([-20.0, -17.5, -14.5, 0.0, 10.0, 14.5, 17.5, 25.0]))
    unknown = field.find_unknown(np.stack([np.full(8, 2.9), np.zeros(8), 2.9 * heights], axis=1))
    assert unknown.tolist() == [True, True, False, False, False, False, True, True]
    behind_wall = field.find_unknown(np.array([[6.5, 2.0, 0.0], [5.5, 2.0, 0.0]]))
    assert behind_wall.tolist() == [True, False]
    aside = 3.0 * np.stack([np.cos([1.2, 1.45, np.pi]), np.sin([1.2, 1.45, np.pi]), np.zeros(3)], axis=1)
    assert field.find_unknown(aside).tolist() == [False, sector < 1.4, sector < 1.4]


def test_a_lidar_that_is_told_its_limits_needs_no_surroundings() -> None:
    points, person = lidar(np.radians(np.arange(-15.0, 15.1, 1.0)), 1.0)
    alone = points[person]
    low = np.array([[2.9, 0.0, 2.9 * np.tan(np.radians(-20.0))]])
    # A person alone does not say where the field ends.
    assert not RangeImage.of_scan(alone, np.zeros(3)).make_field(slice(None)).find_unknown(low).any()
    given = RangeImage.of_scan(alone, np.zeros(3), (-0.5, 0.5), tuple(np.radians([-15.0, 15.0])))
    field = given.make_field(slice(None))
    assert field.find_unknown(low).all() and field.find_unknown(-low * [1, 1, 1]).all()
    beside = np.array([[2.9 * np.cos(a), 2.9 * np.sin(a), 0.0] for a in (0.45, 0.55, -0.45, -0.55)])
    assert field.find_unknown(beside).tolist() == [False, True, False, True]


def test_of_a_thinned_image_nobody_elses_points_hide(scene: np.ndarray) -> None:
    points, pixel = camera_points(scene)
    image, rows = RangeImage.of_camera(LENS, points, pixel, scene.shape), np.arange(0, len(points), 4)
    own = own_of(scene)
    behind = points[own] * 1.1
    whole, thinned = image.make_field(own), image.thin(rows).make_field(own[rows])
    np.testing.assert_array_equal(thinned.find_unknown(behind), whole.find_unknown(behind))
    assert image.take(rows).make_field(own[rows]).find_unknown(behind).mean() > 0.5


def test_unknown_places_count_as_hidden_in_a_view_and_known_ones_the_same_as_without_a_field(scene: np.ndarray) -> None:
    points, pixel = camera_points(scene)
    person = points[own_of(scene)]
    field = RangeImage.of_camera(LENS, points, pixel, scene.shape).make_field(own_of(scene))
    plain, limited = OneSidedView.build(person, np.zeros(3)), OneSidedView.build(person, np.zeros(3), field=field)
    rng = np.random.default_rng(0)
    places = rng.uniform([-0.6, -0.5, 1.5], [0.6, 1.0, 2.5], (400, 3))
    unknown = field.find_unknown(places)
    assert 50 < unknown.sum() < 350
    beside, behind = limited.compare(places)
    assert not beside[unknown].any() and np.isinf(behind[unknown]).all()
    np.testing.assert_array_equal(beside[~unknown], plain.compare(places)[0][~unknown])
    np.testing.assert_array_equal(behind[~unknown], plain.compare(places)[1][~unknown])
    normals = np.tile([0.0, 0.0, -1.0], (400, 1, 1))
    cost, facing = limited.misfit(places[:, None], normals)
    assert facing.all()
    np.testing.assert_allclose(cost[unknown], 0.05)  # as what is hidden: the places face the sensor
    np.testing.assert_array_equal(cost[~unknown], plain.misfit(places[:, None], normals)[0][~unknown])


def test_a_field_without_ends_and_without_others_hides_nothing() -> None:
    field = SensorField(LENS, np.array([-np.inf, -np.inf, np.inf, np.inf]), np.full((4, 4), np.inf, np.float32))
    assert not field.find_unknown(np.random.default_rng(0).uniform(-9, 9, (50, 3)) * [1, 1, 0] + [0, 0, 1]).any()


def test_around_a_line_only_the_persons_own_pixels_are_known(scene: np.ndarray) -> None:
    points, pixel = camera_points(scene)
    own = own_of(scene)
    field = RangeImage.of_camera(LENS, points, pixel, scene.shape).make_field(own)
    line = np.array([[[-0.2, 0.0, 2.0], [0.2, 0.0, 2.0]]])  # 20 pixels across the middle
    doubted = field.doubt_around(line, 0.1, points[own])
    places = np.array([[0.0, 0.0, 2.0], [0.26, 0.0, 2.0], [0.26, 0.15, 2.0], [0.4, 0.0, 2.0]])
    assert doubted.find_unknown(places).tolist() == [False, True, False, False]
    assert not field.find_unknown(places).any()
