# SPDX-License-Identifier: Apache-2.0
"""The floor as a grid, linkage that widens with distance, and candidates where people stand."""

import numpy as np

from flowing_puppet_ros.body.segmentation.candidates import SceneHeights, find_candidates
from flowing_puppet_ros.body.segmentation.column_index import ColumnIndex
from flowing_puppet_ros.body.segmentation.floor_grid import FloorGrid
from flowing_puppet_ros.body.segmentation.linkage import link_points

SENSOR = np.array([0.0, 0.0, 1.6])


def ground(rng: np.random.Generator, count: int = 60_000) -> np.ndarray:
    """A street that falls by 2 %, with a pavement 15 cm higher from y = 4 on."""
    xy = rng.uniform(-15, 15, (count, 2))
    z = -0.02 * xy[:, 0] + 0.15 * (xy[:, 1] > 4)
    return np.column_stack([xy, z]) + rng.normal(0, 0.01, (count, 3)) * [0, 0, 1]


def figure(x: float, y: float, z: float, rng: np.random.Generator, count: int = 400, height: float = 1.7) -> np.ndarray:
    """A trunk 0.45 by 0.25 m on legs, and a head, as an ellipse at each height."""
    up = rng.uniform(0, height, count)
    wide = np.interp(up / height, [0, 0.5, 0.55, 0.8, 0.84, 0.88, 1.0], [0.1, 0.12, 0.2, 0.24, 0.08, 0.09, 0.05])
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([x + wide * np.cos(angle), y + 0.6 * wide * np.sin(angle), z + up])


def test_the_floor_follows_slopes_and_pavements_and_not_cars() -> None:
    rng = np.random.default_rng(0)
    car = rng.uniform([-9, -2, 0.3], [-5, -0.2, 1.4], (4000, 3))
    points = ground(rng)
    hidden = (points[:, 0] > -9.2) & (points[:, 0] < -4.8) & (points[:, 1] > -2.2) & (points[:, 1] < 0)
    floor = FloorGrid.find(np.concatenate([points[~hidden], car]))
    for x, y, z in ((0.0, 0.0, 0.0), (10.0, 0.0, -0.2), (-10.0, 8.0, 0.35), (-7.0, -1.0, 0.14)):
        assert abs(floor.locate(x, y) - z) < 0.06
    np.testing.assert_allclose(floor.height(np.array([[10.0, 0.0, 1.0]])), 1.2, atol=0.06)


def test_under_what_stands_near_a_sensor_that_looks_ahead_the_floor_goes_on() -> None:
    """With rings every two degrees down to -14, no floor is seen nearer than 5.5 m."""
    rng = np.random.default_rng(0)
    points = np.concatenate([ground(rng, 200_000), *(figure(x, 0.0, -0.02 * x, rng, 4000) for x in (2.5, 4.5, 9.0))])
    ray = points - SENSOR
    elevation = np.degrees(np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])))
    seen = points[(np.abs(elevation - 2.0 * np.round(elevation / 2.0)) < 0.05) & (np.abs(elevation + 1) < 13.5)]
    assert np.hypot(*seen[np.abs(seen[:, 2] + 0.02 * seen[:, 0]) < 0.05, :2].T).min() > 5.5
    floor = FloorGrid.find(seen, SENSOR)
    for x in (2.5, 4.5, 9.0):
        assert abs(floor.locate(x, 0.0) + 0.02 * x) < 0.05


def test_the_floor_follows_a_ramp_and_not_what_stands_on_it() -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-15, 15, (60_000, 2))
    points = np.column_stack([xy, np.clip(0.08 * xy[:, 0] - 0.16, 0.0, 0.64) + rng.normal(0, 0.01, len(xy))])
    floor = FloorGrid.find(np.concatenate([points, figure(5.0, 0.0, 0.24, rng)]), SENSOR)
    for x in (-5.0, 5.0, 8.0, 12.0):
        assert abs(floor.locate(x, 0.0) - np.clip(0.08 * x - 0.16, 0.0, 0.64)) < 0.09


def room(rng: np.random.Generator, lowest: float, half: float = 3.0, count: int = 30_000) -> np.ndarray:
    """The walls of a room with z = 0 on the floor, and a person, by rays every two degrees from `lowest` on up."""
    along = rng.uniform(-half, half, count)
    side = rng.integers(0, 4, count)
    xy = np.where((side < 2)[:, None], np.column_stack([along, half * (2 * side - 1)]), 0.0)
    xy[side > 1] = np.column_stack([half * (2 * side - 5), along])[side > 1]
    walls = np.column_stack([xy, rng.uniform(0.0, 3.0, count)])
    floor = np.column_stack([rng.uniform(-half, half, (2 * count, 2)), np.zeros(2 * count)])
    points = np.concatenate([floor, walls, figure(2.0, 0.5, 0.0, rng, 4000)])
    ray = points - SENSOR
    elevation = np.degrees(np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])))
    return points[(np.abs((elevation + 90.0) % 2.0 - 1.0) < 0.1) & (elevation > lowest)]


def test_a_room_in_which_all_rays_end_above_the_floor_shows_none() -> None:
    rng = np.random.default_rng(6)
    seen = room(rng, -16.0)
    assert seen[:, 2].min() > 0.3
    floor = FloorGrid.find(seen, SENSOR)
    assert not floor.is_seen and floor.locate(2.0, 0.5) > 0.3
    for level in (0.0, 0.1):
        known = FloorGrid.find(seen, SENSOR, level)
        assert not known.is_seen
        assert abs(known.locate(2.0, 0.5) - level) < 0.02 and abs(known.locate(-2.0, -2.0) - level) < 0.02


def test_a_floor_that_is_seen_counts_unless_it_is_known_to_be_lower() -> None:
    seen = room(np.random.default_rng(7), -40.0)
    for level in (0.0, -0.1, 0.5):
        floor = FloorGrid.find(seen, SENSOR, level)
        assert floor.is_seen and abs(floor.locate(2.0, 0.5)) < 0.05
    up = np.array([0.0, 0.0, 0.7])
    table = FloorGrid.find(seen + up, SENSOR + up, 0.0)
    assert not table.is_seen and abs(table.locate(2.0, 0.5)) < 0.05


def test_walls_behind_a_table_near_the_sensor_show_no_floor() -> None:
    """No ray ends below them, but they are not what the lowest rays hit."""
    rng = np.random.default_rng(8)
    seen = room(rng, -40.0)
    ray = seen - SENSOR
    hidden = ray[:, 2] / np.hypot(ray[:, 0], ray[:, 1]) < -0.3
    angle, slope = rng.uniform(-np.pi, np.pi, 20_000), np.tan(np.radians(2.0 * rng.integers(-20, -8, 20_000) + 1.0))
    near = 0.8 * np.column_stack([np.cos(angle), np.sin(angle), slope])
    table = SENSOR + near[slope < -0.3]
    floor = FloorGrid.find(np.concatenate([seen[~hidden], table]), SENSOR)
    assert seen[~hidden][:, 2].min() > 0.2 and not floor.is_seen


def test_a_floor_that_was_cut_away_is_where_the_legs_end() -> None:
    rng = np.random.default_rng(1)
    people = [figure(x, y, 0.0, rng) for x, y in ((3, 0), (5, 2), (6, -3), (8, 1))]
    floor = FloorGrid.find(np.concatenate(people))
    assert abs(floor.locate(5, 2)) < 0.15


def test_walls_and_people_over_a_floor_that_was_cut_away_show_where_it_was() -> None:
    seen = room(np.random.default_rng(9), -40.0)
    floor = FloorGrid.find(seen[seen[:, 2] > 0.1], SENSOR)
    assert floor.is_seen and abs(floor.locate(2.0, 0.5)) < 0.25


def test_the_gap_grows_with_the_distance_and_is_larger_upwards() -> None:
    line = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.6]])
    near = link_points(line, np.full(3, 3.0))
    far = link_points(line, np.full(3, 20.0))
    assert near[0] != near[1] and near[1] != near[2]
    assert far[0] == far[1] == far[2]


def test_everybody_in_a_group_is_a_candidate_and_a_wall_is_none() -> None:
    rng = np.random.default_rng(2)
    places = [(6.0, 0.0), (6.1, 0.5), (6.0, -0.45), (3.0, 3.0)]
    people = [figure(x, y, -0.02 * x, rng) for x, y in places]
    wall = np.column_stack([rng.uniform(-5, 5, 8000), np.full(8000, -6.0), rng.uniform(0, 3, 8000)])
    scene = SceneHeights.of(np.concatenate([ground(rng), wall, *people]))
    found, owned = find_candidates(scene, SENSOR, 25)
    assert not owned
    middles = np.array([candidate.middle for candidate in found])
    for place in places:
        assert np.linalg.norm(middles - place, axis=1).min() < 0.2
    assert len(found) <= 6 and not (middles[:, 1] < -5).any()
    assert all(1.5 < candidate.top < 1.85 for candidate in found)


def test_known_people_keep_their_points_and_are_no_candidates() -> None:
    rng = np.random.default_rng(3)
    people = [figure(x, y, -0.02 * x, rng) for x, y in ((6.0, 0.0), (6.0, 2.0))]
    start = 60_000
    scene = SceneHeights.of(np.concatenate([ground(rng), *people]))
    found, owned = find_candidates(scene, SENSOR, 25, [people[1]])
    assert len(found) == 1 and abs(found[0].middle[1]) < 0.2
    assert set(owned) == {0}
    assert (owned[0] >= start + 400).all() and len(owned[0]) > 350


def test_no_points_above_the_floor_give_no_candidates() -> None:
    scene = SceneHeights.of(ground(np.random.default_rng(4), 2000))
    assert find_candidates(scene, SENSOR, 25) == ([], {})


def test_the_linkage_joins_what_chains_of_near_points_join() -> None:
    points = np.random.default_rng(5).uniform(0, 3, (400, 3)) * [1, 1, 0.7]
    distance = np.full(400, 6.0)  # a gap of 0.172 m, and 0.43 m upwards
    scaled = points * [1, 1, 0.4]
    near = np.linalg.norm(scaled[:, None] - scaled[None], axis=2) < 0.172
    for _ in range(9):  # chains of up to 2 ** 9 points
        near = near.astype(float) @ near > 0
    label = link_points(points, distance)
    assert 10 < label.max() < 390
    np.testing.assert_array_equal(label[:, None] == label[None], near)


def test_points_near_a_place_are_those_that_all_distances_give() -> None:
    points = np.random.default_rng(6).normal(0, 3, (2000, 3))
    index = ColumnIndex.of(points)
    for place in (np.zeros(2), np.array([4.0, -3.0]), np.array([30.0, 0.0])):
        rows, away = index.find_near(points, place, 1.3)
        every = np.hypot(*(points[:, :2] - place).T)
        assert set(rows) == set(np.flatnonzero(every <= 1.3)) and len(set(rows)) == len(rows)
        np.testing.assert_allclose(away, every[rows])


def test_who_leans_at_a_wall_is_a_candidate_without_the_wall() -> None:
    rng = np.random.default_rng(4)
    wall = np.column_stack([6.15 + rng.normal(0, 0.01, 20_000), rng.uniform(-4, 4, 20_000), rng.uniform(0, 3, 20_000)])
    behind = np.abs(wall[:, 1]) < 0.3
    person = figure(6.0, 0.0, -0.12, rng)
    seen = wall[~behind | (wall[:, 2] > 1.7)]
    scene = SceneHeights.of(np.concatenate([ground(rng), seen, person]))
    assert scene.wall[60_000 : 60_000 + len(seen)][seen[:, 2] > 0.3].mean() > 0.9 and not scene.wall[:60_000].all()
    found = find_candidates(scene, SENSOR, 25)[0]
    (nearest,) = [each for each in found if np.linalg.norm(each.middle - [6.0, 0.0]) < 0.2]
    assert (nearest.rows >= 60_000 + len(seen)).mean() > 0.95 and len(nearest.rows) > 200


def test_the_pieces_of_somebody_half_hidden_are_one_candidate_and_a_chair_beside_is_not_theirs() -> None:
    rng = np.random.default_rng(5)
    person = figure(6.0, 0.0, -0.12, rng, count=500)
    height = person[:, 2] + 0.12
    legs, upper = person[(height > 0.15) & (height < 0.35)], person[height > 0.95]
    chair = rng.uniform([5.6, 2.9, 0.0], [5.66, 3.1, 0.5], (100, 3))
    whole = figure(6.0, 3.0, -0.12, rng)
    start = 60_000
    scene = SceneHeights.of(np.concatenate([ground(rng), legs, upper, whole, chair]))
    found = find_candidates(scene, SENSOR, 25)[0]
    (hidden,) = [each for each in found if np.linalg.norm(each.middle - [6.0, 0.0]) < 0.2]
    assert len(hidden.rows) > 0.9 * (len(legs) + len(upper)) and hidden.rows.min() < start + len(legs)
    beside = [each for each in found if np.linalg.norm(each.middle - [6.0, 3.0]) < 0.25]
    assert beside and min((each.rows >= start + len(legs) + len(upper) + 400).sum() for each in beside) < 40


def test_near_known_people_alone_nobody_else_is_looked_for() -> None:
    rng = np.random.default_rng(3)
    people = [figure(x, y, -0.02 * x, rng) for x, y in ((6.0, 0.0), (6.0, 4.0))]
    scene = SceneHeights.of(np.concatenate([ground(rng), *people]))
    everywhere = find_candidates(scene, SENSOR, 25, [people[1]])
    found, owned = find_candidates(scene, SENSOR, 25, [people[1]], only_known=True)
    assert len(everywhere[0]) == 1 and not found
    for rows in (owned[0], everywhere[1][0]):
        assert (rows >= 60_400).mean() > 0.9 and (rows >= 60_400).sum() > 350


def test_who_sits_on_the_floor_is_a_candidate_only_where_low_ones_are_wanted() -> None:
    rng = np.random.default_rng(2)
    people = [figure(6.0, 0.0, -0.12, rng), figure(6.0, 2.0, -0.12, rng, height=0.9)]
    scene = SceneHeights.of(np.concatenate([ground(rng), *people]))
    standing = find_candidates(scene, SENSOR, 25)[0]
    every = find_candidates(scene, SENSOR, 25, low=True)[0]
    assert len(standing) == 1 and len(every) == 2
    assert (every[0].rows == standing[0].rows).all() and not every[0].low
    assert every[1].low and abs(every[1].middle[1] - 2.0) < 0.2 and every[1].top < 1.05
