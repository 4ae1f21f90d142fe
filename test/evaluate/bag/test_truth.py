# SPDX-License-Identifier: Apache-2.0
"""Several true people against several bodies, distances to surfaces, and latency and drops counted by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.evaluate.bag.timing import measure_timing
from flowing_puppet_ros.evaluate.bag.truth import (
    PeopleByStamp,
    PersonGeometry,
    distance_to_surface,
    match_bodies,
    read_truth,
)
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image

FACTORY = BagMessageFactory()
NO_FACES = np.zeros((0, 3), np.int64)


def at(x: float) -> PersonGeometry:
    return PersonGeometry({"left_knee": np.array([x, 0.0, 0.5]), "left_hip": np.array([x, 0.0, 0.9])})


def test_every_true_person_has_a_body_of_their_own_or_none() -> None:
    truth = PeopleByStamp({1: [at(0.0), at(1.0)], 2: [at(0.0), at(1.0)], 3: [at(0.0)]}, NO_FACES)
    # Both true people are nearest to the body at 0.6 m; stamp 2 has one body, stamp 3 none.
    found = PeopleByStamp({1: [at(1.5), at(0.6)], 2: [at(0.9)], 9: [at(0.0)]}, NO_FACES)
    places = [
        (stamp, None if body is None else body.joints["left_knee"][0]) for stamp, _, body in match_bodies(found, truth)
    ]
    assert places == [(1, 0.6), (1, 1.5), (2, None), (2, 0.9), (3, None)]
    strangers = PeopleByStamp({3: [PersonGeometry({"nose": np.zeros(3)})]}, NO_FACES)
    assert [body for _, _, body in match_bodies(strangers, truth)] == [None] * 5


def test_several_people_a_stamp_are_read(tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"7": [{"neck": [1, 2, 3]}, {}], "8": {"neck": [4, 5, 6]}}))
    people = read_truth(path).at
    assert [len(people[stamp]) for stamp in (7, 8)] == [2, 1] and people[8][0].joints["neck"].tolist() == [4, 5, 6]


def test_distance_to_a_surface_is_to_its_inside_too() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    points = np.array([[0.4, 0.3, 0.2], [0.5, 0.5, -0.4], [2.0, 0.5, 0.0]])
    assert distance_to_surface(points, square, faces) == pytest.approx((0.2 + 0.4 + 1.0) / 3)


def test_latency_and_drops(tmp_path: Path) -> None:
    millisecond, second = 10**6, 10**9
    puppets, bodies = "flowing_puppet_msgs/msg/PuppetArray", "flowing_puppet_msgs/msg/BodyArray"
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/cam/image", "sensor_msgs/msg/Image")
        writer.add_topic("/lidar/points", "sensor_msgs/msg/PointCloud2")
        for k in range(3):
            header, time = make_header(FACTORY, k * second, "cam"), k * second + 10 * millisecond
            writer.write("/cam/image", time, make_image(FACTORY, header, np.zeros((2, 2), np.uint8), "mono8"))
            cloud = make_header(FACTORY, k * second + 5, "lidar")
            writer.write("/lidar/points", time, make_cloud(FACTORY, cloud, np.zeros((1, 3))))
    with BagWriter(tmp_path / "out.mcap") as writer:
        writer.add_topic("/cam/puppets", puppets)
        writer.add_topic("/lidar/bodies", bodies)
        for k, late in ((0, 50), (2, 90)):
            header = make_header(FACTORY, k * second, "cam")
            writer.write("/cam/puppets", k * second + late * millisecond, FACTORY.make(puppets, header=header))
        header = make_header(FACTORY, 5, "lidar")
        writer.write("/lidar/bodies", 210 * millisecond, FACTORY.make(bodies, header=header))
    with open_bag(tmp_path / "in.mcap") as given, open_bag(tmp_path / "out.mcap") as made:
        figures = measure_timing(given, made)
    assert figures["latency of puppets, median s"] == pytest.approx(0.06)
    assert figures["latency of bodies, median s"] == pytest.approx(0.2)
    assert (figures["images"], figures["images dropped"]) == (3, 1)
    assert (figures["clouds"], figures["clouds dropped"]) == (3, 2)
