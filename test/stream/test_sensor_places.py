# SPDX-License-Identifier: Apache-2.0
"""Where sensors are in the frame in which people are tracked, and the sentences for what is not known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.track.scene_tracker import SceneTracker
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, make_header, make_transform
from flowing_puppet_ros.stream.sensor_places import ANCHOR_GRID_M, SensorPlaces
from test.stream.messages.test_frame_tree import FACTORY, SECOND, link, message, robot, turned

POINTS = np.array([[2.0, 0.3, -0.4], [3.0, -1.0, 0.5]])


def places(
    frames: FrameTree, fixed: str = "map", sensor: str = "", up: str = "auto", view: str = "auto", floor: str = ""
) -> tuple[SensorPlaces, Report]:
    report = Report()
    return SensorPlaces(frames, up, fixed, sensor, report, view, floor), report


def find(made: SensorPlaces, frame: str, seconds: float) -> Any:
    stamp = round(seconds * SECOND)
    return made.find(make_header(FACTORY, stamp, frame), stamp, POINTS, False)


def test_points_are_put_where_the_sensor_was_at_their_stamp() -> None:
    made, _ = places(robot())
    place = find(made, "camera", 10.5)
    eye = np.array([2.0 + 0.5 * np.sqrt(0.5), 0.5 * np.sqrt(0.5), 0])
    np.testing.assert_allclose(place.viewpoint, eye, atol=1e-12)
    np.testing.assert_allclose(place.put(POINTS), POINTS @ turned(45.0).T + eye, atol=1e-12)
    rotation, translation = place.back
    np.testing.assert_allclose(place.put(POINTS) @ rotation.T + translation, POINTS, atol=1e-12)
    np.testing.assert_allclose(place.to_sensor, turned(45.0).T, atol=1e-12)


def test_large_coordinates_are_counted_from_near_the_first_place() -> None:
    frames = FrameTree()
    frames.add(message(link(1, "map", "camera", 400_050.0 + 1.25), link(1, "x", "y", 0)), moving=True)
    made, _ = places(frames)
    assert find(made, "camera", 1.0).viewpoint[0] == pytest.approx(51.25 - ANCHOR_GRID_M)


def test_a_sensor_that_hangs_upside_down_is_no_special_case() -> None:
    frames = FrameTree()
    over = np.diag([1.0, -1.0, -1.0])
    frames.add(message(make_transform(FACTORY, make_header(FACTORY, 0, "map"), "lidar", np.array([0, 0, 3.0]), over)))
    place = find(places(frames)[0], "lidar", 1.0)
    np.testing.assert_allclose(place.put(np.array([2.0, 0.5, 1.2])), [2.0, -0.5, 1.8])
    np.testing.assert_allclose(place.to_sensor @ np.array([0, 0, 1.0]), [0, 0, -1.0])
    alone = find(places(frames, fixed="", up="-z")[0], "lidar", 1.0)
    assert alone.put(np.array([0, 0, 1.2]))[2] == pytest.approx(-1.2)


@pytest.mark.parametrize("fixed", ["", "map"])
def test_the_sensor_is_as_high_as_it_is_over_base_footprint(fixed: str) -> None:
    frames = FrameTree()
    tilted = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # an optical frame that looks ahead
    frames.add(
        message(
            make_transform(
                FACTORY, make_header(FACTORY, 0, "base_footprint"), "base_link", np.array([0, 0, 0.2]), np.eye(3)
            ),
            make_transform(
                FACTORY, make_header(FACTORY, 0, "base_link"), "eye_optical", np.array([0.1, 0, 1.1]), tilted
            ),
            make_transform(
                FACTORY, make_header(FACTORY, 0, "map"), "base_footprint", np.array([5.0, 0, 0.4]), np.eye(3)
            ),
        )
    )
    made, _ = places(frames, fixed=fixed, floor="base_footprint")
    place = find(made, "eye_optical", 1.0)
    assert place.height == pytest.approx(1.3)
    assert place.viewpoint[2] == pytest.approx(1.7 if fixed else 0.0)
    assert find(made, "base_footprint", 1.0).height is None
    assert find(places(frames, fixed=fixed, floor="no_frame")[0], "eye_optical", 1.0).height is None


def test_frames_that_nothing_connects_are_one_sentence_and_the_sensors_frame_is_used() -> None:
    made, report = places(robot(), fixed="odom")
    for seconds in (10.2, 10.3):
        place = find(made, "camera", seconds)
        assert not place.is_fixed
        np.testing.assert_allclose(place.put(POINTS), POINTS)
    (said,) = report.drain_warnings()
    missing = "/tf and /tf_static do not connect 'camera' with 'odom'; publish or record the transform"
    assert said == f"{missing}: people are tracked in the former"
    assert not made.is_awaited("camera", 11 * SECOND)  # given up


def test_a_late_transform_is_waited_for_and_then_one_sentence() -> None:
    made, report = places(robot())
    assert find(made, "camera", 10.5).is_fixed
    assert made.is_awaited("camera", round(11.2 * SECOND))
    assert find(made, "camera", 11.2) is None
    (said,) = report.drain_warnings()
    assert "is 0.20 s older" in said
    assert said.endswith("what has no place in fixed_frame is fitted by itself")
    assert made.is_awaited("camera", round(11.3 * SECOND))


@pytest.mark.parametrize(("fixed", "view"), [("map", "auto"), ("", "single")])
def test_clouds_in_the_maps_frame_need_the_sensors(fixed: str, view: str) -> None:
    made, report = places(robot(), fixed=fixed, view=view)
    np.testing.assert_allclose(find(made, "map", 10.5).viewpoint, np.zeros(3))
    (said,) = report.drain_warnings()
    assert "where their sensor is in it is not known" in said
    assert "set sensor_frame" in said
    known, report = places(robot(), fixed=fixed, sensor="base", view=view)
    place = find(known, "map", 10.5)
    np.testing.assert_allclose(place.viewpoint, [2.0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(place.to_sensor, turned(45.0).T, atol=1e-12)
    np.testing.assert_allclose(place.put(POINTS), POINTS)
    assert report.drain_warnings() == []
    assert known.is_awaited("map", round(11.2 * SECOND))


def test_the_people_of_a_cloud_are_looked_for_as_high_as_its_sensor_is(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[SceneCloud] = []

    def step(tracker: SceneTracker, cloud: SceneCloud, *_: Any) -> tuple[list[Any], list[str]]:
        seen.append(cloud)
        return [], []

    monkeypatch.setattr(SceneTracker, "step", step)
    component = BodyFitterComponent(BodyFitterSettings(), FACTORY)
    mounted = make_transform(
        FACTORY, make_header(FACTORY, 0, "base_footprint"), "lidar", np.array([0, 0, 1.4]), np.eye(3)
    )
    component.handle("/tf_static", message(mounted))
    component.handle("points", make_cloud(FACTORY, make_header(FACTORY, SECOND, "lidar"), POINTS))
    component.flush()
    assert [cloud.sensor_height for cloud in seen] == [pytest.approx(1.4)]


def test_what_a_sensor_is_mounted_on_tells_which_way_is_up_without_a_fixed_frame() -> None:
    tilted = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])  # looks down
    frames = FrameTree()
    frames.add(
        message(make_transform(FACTORY, make_header(FACTORY, 0, "base"), "lidar", np.array([0, 0, 1.0]), tilted))
    )
    place = find(places(frames, fixed="")[0], "lidar", 1.0)
    np.testing.assert_allclose(place.put(tilted.T @ np.array([3.0, 0.0, -1.0]))[2], -1.0)
    np.testing.assert_allclose(place.to_sensor @ place.rotation, np.eye(3), atol=1e-12)
    assert find(places(frames, fixed="", up="z")[0], "lidar", 1.0).put(np.array([0, 0, 1.0]))[2] == 1.0  # as it is set
    frames = FrameTree()
    frames.add(message(link(1, "odom", "lidar", 0.0)), moving=True)  # what moves against it tells nothing
    np.testing.assert_array_equal(find(places(frames, fixed="")[0], "lidar", 1.0).rotation, np.eye(3))


def test_nobody_is_tracked_from_one_way_up_to_another() -> None:
    component = BodyFitterComponent(BodyFitterSettings(), FACTORY)
    made, _ = places(FrameTree(), fixed="")
    place = find(made, "lidar", 1.0)
    turned_over = replace(place, rotation=np.diag([1.0, -1.0, -1.0]))
    frames = [component._is_turned("lidar", each) for each in (place, place, turned_over, turned_over)]
    assert frames == [False, False, True, False]


def test_a_camera_whose_frame_is_not_named_as_one_is_told() -> None:
    made, report = places(FrameTree(), fixed="")
    ahead = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (200, 3))
    for _ in range(2):
        made.find(make_header(FACTORY, 0, "camera"), 0, ahead, False)
    assert len(report.warnings) == 1 and "up:=-y" in report.warnings[0]
    made, report = places(FrameTree(), fixed="")
    find(made, "lidar", 1.0)
    assert not report.warnings
