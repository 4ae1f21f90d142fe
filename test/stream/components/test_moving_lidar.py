# SPDX-License-Identifier: Apache-2.0
"""A LiDAR, level or upside down, on a robot that drives and turns among somebody who stands and somebody who walks."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform
from flowing_puppet_ros.stream.messages.message_types import TRANSFORMS
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints

pytestmark = pytest.mark.slow

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000
RATE_HZ, FRAMES = 5.0, 7
HEIGHT_M, SPEED_M_S, TURN_RAD_S = 1.1, 0.9, 0.35
HIPS = ("left_hip", "right_hip")
EYE = np.eye(3)


@dataclass(frozen=True)
class Walkers:
    """Who stands and who walks, at RATE_HZ."""

    source: BodySource
    people: list[list[TrueBody]]

    def hips(self, person: int, frame: int) -> np.ndarray:
        rows = [self.source.joint_names.index(name) for name in HIPS]
        return np.asarray(self.people[person][frame].joints[rows].mean(axis=0))


@pytest.fixture(scope="module")
def walkers() -> Walkers:
    source, rng = BodySource(), np.random.default_rng(5)
    stands = pose_motion(source, "waving", rng, 1, RATE_HZ, np.pi)[0].translate(np.array([5.0, 1.8, 0.0]))
    walks = [
        body.translate(np.array([4.6, -1.4, 0]))
        for body in pose_motion(source, "walking", rng, FRAMES, RATE_HZ, 0.7 * np.pi)
    ]
    return Walkers(source, [[stands] * FRAMES, walks])


def find_pose(seconds: float, roll: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and place of the LiDAR in the map."""
    turn = rotation.exp(np.array([0.0, 0.0, TURN_RAD_S * np.sin(3 * seconds)]))
    return turn @ rotation.exp(np.array([roll, 0.0, 0.0])), np.array([SPEED_M_S * seconds, -0.2, HEIGHT_M])


def scan(walkers: Walkers, frame: int, roll: float) -> np.ndarray:
    """Return what the LiDAR sees of a room with two machines as large as people, with something like a head on top."""
    turn, place = find_pose(frame / RATE_HZ, roll)
    boxes = [
        make_box(np.array([2.0, 0, -0.05]), np.array([16.0, 12.0, 0.1]), EYE),
        make_box(np.array([8.0, 0, 1.5]), np.array([0.1, 12.0, 3.0]), EYE),
        make_box(np.array([6.0, -3.4, 0.75]), np.array([0.35, 0.45, 1.5]), EYE),
        make_box(np.array([6.0, -3.4, 1.62]), np.array([0.2, 0.2, 0.24]), EYE),
        make_box(np.array([3.0, 3.2, 0.7]), np.array([0.3, 0.5, 1.4]), EYE),
        make_box(np.array([3.0, 3.2, 1.55]), np.array([0.22, 0.18, 0.3]), EYE),
    ]
    people = [(bodies[frame].vertices, walkers.source.triangles) for bodies in walkers.people]
    room, crowd = ([((vertices - place) @ turn, faces) for vertices, faces in each] for each in (boxes, people))
    points, _ = scan_scene(room, crowd, np.random.default_rng(frame), "spinning-32", 0.0)
    return points


@dataclass
class Drive:
    """What came of a drive: (frame, id, hips and velocity in the map), and how often nothing was fitted again."""

    found: list[tuple[int, str, np.ndarray, np.ndarray]]
    remembered: int
    warnings: list[str]
    rejected: list[np.ndarray]
    """Places in the map of what is no person in the last cloud."""


def drive(walkers: Walkers, roll: float = 0.0, **settings: Any) -> Drive:
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({"view": "single", **settings}), FACTORY)
    result = Drive([], 0, [], [])
    for frame in range(FRAMES):
        seconds = frame / RATE_HZ
        stamp = SECOND + round(seconds * SECOND)
        turn, place = find_pose(seconds, roll)
        pose = make_transform(FACTORY, make_header(FACTORY, stamp, "map"), "lidar", place, turn)
        component.handle("/tf", FACTORY.make(TRANSFORMS, transforms=[pose]))
        cloud = make_cloud(FACTORY, make_header(FACTORY, stamp, "lidar"), scan(walkers, frame, roll))
        for name, message in component.handle("points", cloud):
            for body in message.bodies if name == "bodies" else ():
                joints = decode_body_joints(body)
                hips = np.mean([joints[name][:3] for name in HIPS], axis=0)
                velocity = np.array([body.velocity.x, body.velocity.y, body.velocity.z])
                result.found.append((frame, body.id, turn @ hips + place, turn @ velocity))
        reasons = [each.reason for each in component._people.scene._finder.last_rejected]
        result.remembered += reasons.count("rejected before")
    told = component.describe_rejected()
    assert told is not None and told["stamp_ns"] == stamp
    result.rejected = [turn @ one["place"] + place for one in told["candidates"]]
    result.warnings = component.report.drain_warnings()
    return result


def name_of(result: Drive, walkers: Walkers, person: int) -> set[str]:
    """Return the ids of a person."""
    return {
        identity
        for frame, identity, hips, _ in result.found
        if np.linalg.norm((hips - walkers.hips(person, frame))[:2]) < 0.4
    }


@pytest.fixture(scope="module")
def level(walkers: Walkers) -> Drive:
    return drive(walkers, fixed_frame="map")


def check(result: Drive, walkers: Walkers) -> None:
    """Fail unless both people have one id each, and are where they are, as fast as they are."""
    assert result.warnings == []
    assert {identity for _, identity, *_ in result.found} == {"b1", "b2"}
    for person, speed in ((0, 0.0), (1, 0.9)):
        (identity,) = name_of(result, walkers, person)
        own = [item for item in result.found if item[1] == identity]
        assert len(own) >= FRAMES - 1
        away = [np.linalg.norm((hips - walkers.hips(person, frame))[:2]) for frame, _, hips, _ in own]
        assert np.mean(away) < 0.1
        assert np.linalg.norm(own[-1][3]) == pytest.approx(speed, abs=0.3)


def test_people_keep_ids_and_places_in_the_map(level: Drive, walkers: Walkers) -> None:
    check(level, walkers)


def test_a_lidar_that_hangs_upside_down_is_no_special_case(walkers: Walkers) -> None:
    check(drive(walkers, np.pi, fixed_frame="map"), walkers)


def test_what_stands_in_the_map_is_rejected_once(walkers: Walkers) -> None:
    fitted = {"people.min_filter": 0.0}  # also what its shape tells from people
    mapped = drive(walkers, fixed_frame="map", **fitted)
    assert mapped.remembered > drive(walkers, **fitted).remembered


def test_the_places_of_what_is_rejected_are_told(level: Drive) -> None:
    for machine in ([6.0, -3.4, 0.0], [3.0, 3.2, 0.0]):
        assert min(np.linalg.norm(place - machine) for place in level.rejected) < 0.4
