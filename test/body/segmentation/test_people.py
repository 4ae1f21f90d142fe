# SPDX-License-Identifier: Apache-2.0
"""People are found in scenes of floor, wall and furniture; what is none is left."""

import numpy as np
import pytest

from flowing_puppet_ros.body.segmentation.people import segment_people
from flowing_puppet_ros.body.segmentation.planes import find_floor, find_wall
from flowing_puppet_ros.body.settings import SegmentationSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet

SETTINGS = SegmentationSettings()


@pytest.fixture(scope="module")
def person() -> np.ndarray:
    """Vertices and face centres of a body, soles at z = 0."""
    model = StitchedPuppet.load("neutral")
    vertices = model.vertices(model.sample(np.random.default_rng(3), shape_scale=0.5))
    points = np.concatenate([vertices, vertices[model.faces].mean(axis=1)])
    return points - [*points[:, :2].mean(axis=0), points[:, 2].min()]


def box(low: list[float], high: list[float], count: int, rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(low, high, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.where(rng.random(count) < 0.5, np.array(low)[axis], np.array(high)[axis])
    return points


def room(rng: np.random.Generator) -> np.ndarray:
    """Floor that leans a little, wall at y = 2, a cupboard, a table's height of boxes."""
    floor = np.column_stack([rng.uniform(-3, 3, (20000, 2)), np.zeros(20000)])
    floor[:, 2] = 0.02 * floor[:, 0]
    wall = np.column_stack([rng.uniform(-3, 3, 12000), np.full(12000, 2.0), rng.uniform(0, 2.5, 12000)])
    furniture = [box([1.2, 0.8, 0], [2.0, 1.3, 1.7], 5000, rng), box([-2, -1, 0], [-1, -0.4, 0.7], 4000, rng)]
    return np.concatenate([floor, wall, *furniture]) + rng.normal(0, 0.005, (41000, 3))


def test_two_people_among_furniture_are_found_and_nothing_else(person: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    people = [person + np.array([0, 0.5, 0.01]), person[:, [1, 0, 2]] * [-1, 1, 1] + [-0.2, -1.2, 0.01]]
    scene = np.concatenate([*people, room(rng)])
    truth = np.concatenate([np.repeat([0, 1], len(person)), np.full(41000, -1)])
    order = rng.permutation(len(scene))
    scene, truth = scene[order], truth[order]
    found = segment_people(scene, -scene, SETTINGS, np.array([0.0, -4.0, 1.0]))
    assert len(found) == 2
    for cloud in found:
        bodies = truth[cloud.rows]
        owner = np.bincount(bodies[bodies >= 0]).argmax()
        assert (bodies == owner).mean() > 0.97
        assert (bodies == owner).sum() > 0.97 * (person[:, 2] > 0.1).sum()
        assert np.array_equal(cloud.points, scene[cloud.rows])
        assert cloud.normals is not None and np.array_equal(cloud.normals, -cloud.points)
    again = segment_people(scene, None, SETTINGS, np.array([0.0, -4.0, 1.0]))
    assert [cloud.points.tobytes() for cloud in again] == [cloud.points.tobytes() for cloud in found]
    assert len(segment_people(scene, None, SegmentationSettings(max_people=1), np.array([0.0, -4.0, 1.0]))) == 1


def test_an_empty_room_has_no_people() -> None:
    scene = room(np.random.default_rng(1))
    assert segment_people(scene, None, SETTINGS, np.array([0.0, -4.0, 1.0])) == []
    assert segment_people(scene, None, SETTINGS) == []


def test_a_person_alone_stays_whole_wherever_the_origin_is(person: np.ndarray) -> None:
    for place in (np.zeros(3), np.array([5e5, 5.5e6, 300.0])):
        (cloud,) = segment_people(person + place, None, SETTINGS)
        assert len(cloud.points) == len(person)
        assert cloud.score > 0.8


def test_rings_far_away_stay_together(person: np.ndarray) -> None:
    place = np.array([10.0, 1.0, -1.2])
    seen = person + place
    direction = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    ring = np.abs(np.degrees(direction[:, 2]) % 0.6 - 0.3) < 0.06
    (cloud,) = segment_people(seen[ring], None, SETTINGS, np.zeros(3))
    assert len(cloud.points) > 0.95 * ring.sum()
    assert segment_people(seen[ring], None, SegmentationSettings(max_range=8.0), np.zeros(3)) == []


def test_no_points_give_no_people_and_wrong_shapes_are_refused(person: np.ndarray) -> None:
    assert segment_people(np.empty((0, 3)), None, SETTINGS) == []
    assert segment_people(np.full((500, 3), np.nan), None, SETTINGS) == []
    assert segment_people(np.zeros((500, 3)), None, SETTINGS) == []
    assert segment_people(person[:20], None, SETTINGS) == []
    with pytest.raises(InputError, match="shape"):
        segment_people(person[:, :2], None, SETTINGS)
    with pytest.raises(InputError, match="normals"):
        segment_people(person, person[:5], SETTINGS)


def test_floor_is_the_level_plane_below_and_walls_are_larger_than_people(person: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    scene = room(rng)
    floor = find_floor(scene[::10], 0.05, np.random.default_rng(0))
    assert floor is not None
    np.testing.assert_allclose(floor.normal, [-0.02, 0, 1], atol=0.01)
    assert abs(floor.offset) < 0.02
    wall = find_wall(scene[20000:32000:5], 0.05, np.random.default_rng(0))
    assert wall is not None and abs(abs(wall.normal[1]) - 1) < 1e-3
    below = np.array([0.0, 0.0, -0.5])
    assert find_floor(scene[::10], 0.05, np.random.default_rng(0), below) is None  # no sensor is below the floor
    assert find_floor(scene[::10], 0.05, np.random.default_rng(0), -below) is not None
    assert find_floor(person, 0.05, np.random.default_rng(0)) is None
    assert find_wall(person, 0.05, np.random.default_rng(0)) is None
