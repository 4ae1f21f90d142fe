# SPDX-License-Identifier: Apache-2.0
"""Bags with other packages' detections: read by the definitions in the file, replayed with the puppets of our own."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.bag.reader import Record, open_bag
from flowing_puppet_ros.bag.replay.build import build_graph
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.messages.detections import BodySkeleton
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, PUPPETS
from test.helpers.foreign_detections import (
    BOXES,
    FACTORY,
    IDS,
    SKELETON,
    YOLO,
    ZED,
    Joints,
    make_ids,
    make_skeleton,
    make_yolo,
    make_zed,
    write_bag,
)

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
SIZE = (192, 240)
IMAGE_TOPIC = "/cam1/image/compressed"
OPTIONS = ReplayOptions(settings={"puppet_tracker": {"parts": 10}}, progress=False)
Content = list[tuple[str, int, Any]]


def recorded(topic: str) -> list[Record]:
    with open_bag(GOLDEN) as bag:
        return list(bag.messages([topic]))[:4]


def given() -> dict[int, Joints]:
    """The joints of the person by stamp."""
    found: dict[int, Joints] = {}
    for record in recorded("/cam1/detections"):
        (puppet,) = record.message.puppets
        found[stamp_ns(record.message)] = {joint.name: (joint.x, joint.y, joint.confidence) for joint in puppet.joints}
    return found


def bag_of(path: Path, topics: dict[str, str], make: Callable[[int, Joints], Content]) -> Path:
    """Write four images and what `make` gives for the stamp and joints of those with a detection."""
    messages: Content = [(IMAGE_TOPIC, record.log_time, record.raw) for record in recorded(IMAGE_TOPIC)]
    for stamp, joints in given().items():
        messages += make(stamp, joints)
    return write_bag(path, {IMAGE_TOPIC: COMPRESSED_IMAGE, **topics}, sorted(messages, key=lambda item: item[1]))


def of_yolo(path: Path, topic: str = "/yolo/detections") -> Path:
    return bag_of(path, {topic: YOLO}, lambda stamp, joints: [(topic, stamp, make_yolo(stamp, [joints], ["4"]))])


def of_zed(path: Path) -> Path:
    topic = "/zed/skeletons"
    return bag_of(path, {topic: ZED}, lambda stamp, joints: [(topic, stamp, make_zed(stamp, [joints], 1, [0]))])


def of_hri(path: Path, listing: str = "/humans/bodies/tracked") -> Path:
    skeleton = f"{listing.rpartition('/')[0]}/abcde/skeleton2d"

    def make(stamp: int, joints: Joints) -> Content:
        return [
            (skeleton, stamp, make_skeleton(stamp, joints, SIZE)),
            (listing, stamp, make_ids(stamp, ["abcde"])),
        ]

    return bag_of(path, {listing: IDS, skeleton: SKELETON}, make)


def puppets(path: Path, topic: str = "/cam1/puppets") -> list[Any]:
    with open_bag(path) as bag:
        return [record.message for record in bag.messages([topic])]


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """The puppets for the same detections in our own message."""
    folder = tmp_path_factory.mktemp("ours")
    own = {record.log_time: record for record in recorded("/cam1/detections")}
    messages = [(record.topic, record.log_time, record.raw) for record in (*recorded(IMAGE_TOPIC), *own.values())]
    source = write_bag(
        folder / "in.mcap",
        {IMAGE_TOPIC: COMPRESSED_IMAGE, "/cam1/detections": PUPPETS},
        sorted(messages, key=lambda item: item[1]),
    )
    replay(source, folder / "out.mcap", OPTIONS)
    return puppets(folder / "out.mcap")


@pytest.mark.parametrize(
    ("write", "topic"),
    [(of_yolo, "/yolo/detections"), (of_zed, "/zed/skeletons"), (of_hri, "/humans/bodies/tracked")],
)
def test_the_same_people_in_another_message_give_the_same_puppets(
    write: Callable[[Path], Path], topic: str, ours: list[Any], tmp_path: Path
) -> None:
    source = write(tmp_path / "in.mcap")
    options = replace(OPTIONS, topic_map={topic: "/cam1/detections"})
    summary = replay(source, tmp_path / "out.mcap", options)
    assert summary["warnings"] == []
    counters = summary["counters"]["cam1/puppet_tracker"]
    assert (counters["paired detections"], counters["images without detection"]) == (3, 1)
    found = puppets(tmp_path / "out.mcap")
    assert [stamp_ns(message) for message in found] == [stamp_ns(message) for message in ours]
    for message, expected in zip(found, ours, strict=True):
        (puppet,), (other,) = message.puppets, expected.puppets
        assert (puppet.id, puppet.view) == (other.id, other.view)
        for joint, same in zip(puppet.joints, other.joints, strict=True):
            np.testing.assert_allclose((joint.x, joint.y), (same.x, same.y), atol=0.01)
            np.testing.assert_allclose(joint.confidence, same.confidence, atol=1e-3)


def notes(topics: dict[str, str]) -> list[str]:
    """What a replay says about the detections of a camera among these topics."""
    return build_graph({"/cam1/image": COMPRESSED_IMAGE} | topics, {}, FrameTree(), {}, {}, BagMessageFactory()).notes


def test_detections_that_lie_elsewhere_are_named() -> None:
    bodies = {"/humans/bodies/tracked": IDS, "/humans/bodies/abcde/skeleton2d": SKELETON}
    for topics, name in (
        ({"/yolo/detections": YOLO}, "/yolo/detections"),
        ({"/zed/skeletons": ZED}, "/zed/skeletons"),
        (bodies, "/humans/bodies/tracked"),
    ):
        (note,) = notes(topics)
        assert f"--topic-map {name}:=/cam1/detections" in note
    (note,) = notes({"/cam1/detections": "vision_msgs/msg/Detection2DArray"})
    assert "not vision_msgs/msg/Detection2DArray (understood are flowing_puppet_msgs" in note


def test_what_a_tracker_made_is_not_offered_to_it() -> None:
    bodies = {"/humans/bodies/tracked": IDS, "/humans/bodies/a1/skeleton2d": SKELETON}
    assert notes({"/cam1/puppets": PUPPETS, **bodies}) == []
    assert notes({"/humans/bodies/tracked": IDS}) == [], "without skeletons there is nothing to take"


@pytest.mark.parametrize("write", [of_yolo, of_hri])
def test_a_track_of_a_bag_starts_from_them_too(write: Callable[..., Path], tmp_path: Path) -> None:
    source = write(tmp_path / "in.mcap", "/cam1/detections")
    expected = given()
    for frame, people in open_bag_frames(source):
        assert (people is None) == (frame.stamp_ns not in expected)
        for person in people or []:
            for name, point in expected[frame.stamp_ns].items():
                np.testing.assert_allclose(person.select_usable()[name], point, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("", "the recording has no definition of it"), ("nonsense[", "definition of new_msgs/msg/A cannot be understood")],
)
def test_a_type_without_a_usable_definition_is_named(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=r"messages on /a cannot be read: .*new_msgs/msg/A") as caught:
        Record("/a", "new_msgs/msg/A", 0, b"", text).message  # noqa: B018
    assert sentence in str(caught.value)


@pytest.mark.parametrize("place", ["type", "part", "field"])
def test_a_definition_runs_no_code(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library makes Python code of the names; its grammar must let no other code through."""
    monkeypatch.chdir(tmp_path)
    code = 'A(open("trace","w"))'
    kind = f"new_msgs/msg/{code if place == 'type' else 'A'}"
    text = {
        "type": "uint8 a",
        "part": f"new_msgs/B b\n{'=' * 80}\nMSG: new_msgs/{code}\nuint8 a",
        "field": f"uint8 {code}",
    }[place]
    with pytest.raises(InputError, match="cannot be understood"):
        Record("/a", kind, 0, b"\0\1\0\0\7", text).message  # noqa: B018
    assert not list(tmp_path.iterdir())


def test_two_bags_may_define_one_type_differently() -> None:
    for text, data, value in (("uint8 x", b"\0\1\0\0\7", 7), ("float32 x", b"\0\1\0\0\0\0\0?", 0.5)):
        assert Record("/a", "new_msgs/msg/A", 0, data, text).message.x == value


def test_a_file_without_an_index_has_its_definitions_too(tmp_path: Path) -> None:
    path = write_bag(
        tmp_path / "in.mcap",
        {"/boxes": BOXES},
        [("/boxes", 5, FACTORY.make(BOXES, detections=[FACTORY.make("other_msgs/msg/Box", left=3.0)]))],
    )
    path.write_bytes(path.read_bytes()[:-40])
    with open_bag(path, salvage=True) as bag:
        (record,) = bag.messages()
        assert record.message.detections[0].left == 3.0


def test_an_image_waits_for_the_skeletons_of_all_listed_bodies_but_not_for_ever() -> None:
    component = PuppetTrackerComponent(PuppetTrackerSettings.from_mapping({"parts": 10}), FACTORY)
    component.set_expected("detections", True)
    images = [record.message for record in recorded(IMAGE_TOPIC)]
    first, second, *_ = (stamp_ns(image) for image in images)
    bodies = {stamp: BodySkeleton("ada", make_skeleton(stamp, joints, SIZE)) for stamp, joints in given().items()}

    def released(port: str, message: Any) -> list[tuple[int, int]]:
        found = component.handle(port, message)
        return [(stamp_ns(made), len(made.puppets)) for name, made in found if name == "puppets"]

    assert released("image", images[0]) == []
    assert released("detections", bodies[first]) == []
    assert released("detections", make_ids(first, ["ada", "zoe"])) == []
    elsewhere = {name: (x + 60, y, c) for name, (x, y, c) in given()[first].items()}
    assert released("detections", BodySkeleton("zoe", make_skeleton(first, elsewhere, SIZE))) == [(first, 2)]
    assert released("image", images[1]) == []
    assert released("detections", bodies[second]) == []
    assert released("image", images[2]) == [(second, 2)]
    assert (component._tracker.tracks[0].unseen, component._tracker.tracks[1].unseen) == (0, 1)
    assert released("detections", BodySkeleton("zoe", make_skeleton(second, elsewhere, SIZE))) == []
    assert component.counters["late detections"] == 1


def test_detections_that_are_none_cost_no_image() -> None:
    component = PuppetTrackerComponent(PuppetTrackerSettings.from_mapping({"parts": 10}), FACTORY)
    component.set_expected("detections", True)
    (image, *_), boxes = (record.message for record in recorded(IMAGE_TOPIC)), [FACTORY.make("other_msgs/msg/Box")]
    component.handle("detections", FACTORY.make(BOXES, header=image.header, detections=boxes))
    ((port, message),) = component.handle("image", image)
    assert (port, message.puppets, component.counters["unusable"]) == ("puppets", [], 1)
    assert "other_msgs/msg/Box describes no person by keypoints" in component.report.drain_warnings()[0]
