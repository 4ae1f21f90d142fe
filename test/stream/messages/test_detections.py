# SPDX-License-Identifier: Apache-2.0
"""Detections of other packages as keypoints: which joint is where, what is absent, and whatever else may come."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent
from flowing_puppet_ros.stream.messages.detections import (
    BodyList,
    BodySkeleton,
    collect_detections,
    decode_detections,
    find_body_id,
    is_complete,
    skeleton_topic,
)
from test.helpers.foreign_detections import (
    BOXES,
    COCO,
    FACTORY,
    SHAPES,
    YOLO,
    ZED,
    Joints,
    make_ids,
    make_skeleton,
    make_yolo,
    make_zed,
)

SIZE = (640, 480)
PERSON: Joints = {name: (100.0 + 7 * k, 50.0 + 11 * k, 0.75) for k, name in enumerate(COCO)}
(DETECTIONS,) = (port for port in PuppetTrackerComponent.inputs if port.name == "detections")


def decode(message: Any, report: Report | None = None) -> list[Keypoints]:
    return decode_detections(message, SIZE, report or Report())


def places(person: Keypoints) -> dict[str, tuple[float, float, float]]:
    """The joints that a tracker would use, by our names."""
    return person.select_usable()


def assert_same(person: Keypoints, expected: Joints) -> None:
    found = places(person)
    assert found.keys() == expected.keys()
    for name, point in expected.items():
        np.testing.assert_allclose(found[name], point, atol=1e-4, err_msg=name)


def body_list(*parts: Any) -> BodyList:
    collected: Any = None
    for part in parts:
        collected = collect_detections(collected, part)
    assert isinstance(collected, BodyList)
    return collected


def test_a_pose_network_of_yolo() -> None:
    seen = {name: point for name, point in PERSON.items() if name not in ("left_ear", "right_ankle")}
    first, second = decode(make_yolo(1, [seen, PERSON], ["7", ""]))
    assert_same(first, seen)
    assert_same(second, PERSON)
    assert (first.track_id, second.track_id) == ("7", "")


@pytest.mark.parametrize("body_format", [0, 1, 2])
def test_the_skeletons_of_zed(body_format: int) -> None:
    seen = {name: point for name, point in PERSON.items() if name != "right_knee"}
    first, second = decode(make_zed(1, [seen, PERSON], body_format, [0, 12]))
    assert_same(first, seen)
    assert_same(second, PERSON)
    assert (first.track_id, second.track_id) == ("0", "12")
    (untracked,) = decode(make_zed(1, [PERSON], body_format))
    assert untracked.track_id == ""


def test_absent_points_of_zed() -> None:
    message = make_zed(1, [PERSON])
    points = message.objects[0].skeleton_2d.keypoints
    for name, value in {"nose": (np.nan, 4), "left_eye": (-1, 4), "right_eye": (4, np.inf), "left_ear": (0, 9)}.items():
        points[SHAPES[2][name]].kp[:] = value
    (person,) = decode(message)
    assert PERSON.keys() - places(person).keys() == {"nose", "left_eye", "right_eye"}
    assert places(person)["left_ear"][:2] == (0, 9), "the left border is no missing point"


def test_the_bodies_of_ros4hri() -> None:
    seen = {name: point for name, point in PERSON.items() if name != "left_elbow"}
    parts = [
        BodySkeleton("zoe", make_skeleton(5, PERSON, SIZE)),
        make_ids(5, ["zoe", "ada"]),
        BodySkeleton("ada", make_skeleton(5, seen, SIZE)),
    ]
    for order in ((0, 1, 2), (2, 1, 0), (1, 0, 2)):
        first, second = decode(body_list(*(parts[k] for k in order)))
        assert_same(first, seen)
        assert_same(second, PERSON)
        assert (first.track_id, second.track_id) == ("ada", "zoe")
    (alone,) = decode(body_list(parts[1], parts[0]))
    assert alone.track_id == "zoe", "a body without a skeleton is absent"
    assert decode(body_list(make_ids(5, []))) == []
    with pytest.raises(InputError, match="none of the 2 bodies"):
        decode(body_list(parts[1]))


def test_a_list_is_complete_with_its_last_skeleton() -> None:
    skeleton = make_skeleton(5, PERSON, SIZE)
    assert not is_complete(None)
    assert not is_complete(body_list(BodySkeleton("ada", skeleton)))
    assert not is_complete(body_list(BodySkeleton("ada", skeleton), make_ids(5, ["ada", "zoe"])))
    assert is_complete(body_list(make_ids(5, ["ada"]), BodySkeleton("ada", skeleton), BodySkeleton("eve", skeleton)))
    assert is_complete(body_list(make_ids(5, [])))
    assert is_complete(make_yolo(5, [])), "other messages come whole"
    assert BodySkeleton("ada", skeleton).header is skeleton.header


def test_skeletons_lie_beside_their_list() -> None:
    listing = "/humans/bodies/tracked"
    assert skeleton_topic(listing, "ab1") == "/humans/bodies/ab1/skeleton2d"
    assert find_body_id(listing, "/humans/bodies/ab1/skeleton2d") == "ab1"
    others = ("/humans/bodies/ab1/roi", "/robot/bodies/ab1/skeleton2d", "/humans/bodies/a/b/skeleton2d", listing)
    assert not any(find_body_id(listing, topic) for topic in others)


def test_our_own_and_its_id() -> None:
    joints = [
        FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=c)
        for name, (x, y, c) in PERSON.items()
    ]
    puppet = FACTORY.make("flowing_puppet_msgs/msg/Puppet", id="p3", joints=joints)
    (person,) = decode(FACTORY.make("flowing_puppet_msgs/msg/PuppetArray", puppets=[puppet]))
    assert_same(person, PERSON)
    assert person.track_id == "p3"


def test_what_is_no_person_is_left_out() -> None:
    report = Report()
    assert decode(make_yolo(1, [PERSON], name="dog"), report) == []
    box = make_zed(1, [PERSON])
    box.objects[0].skeleton_available = False
    assert decode(box, report) == []
    assert (report.counters["detections of other classes"], report.warnings) == (2, [])


def bad_zed(**values: Any) -> Any:
    message = make_zed(1, [PERSON])
    for name, value in values.items():
        setattr(message.objects[0], name, value)
    return message


def bad_yolo(number: int) -> Any:
    message = make_yolo(1, [PERSON])
    message.detections[0].keypoints.data[3].id = number
    return message


def short_skeleton() -> Any:
    message = make_skeleton(1, PERSON, SIZE)
    message.skeleton = message.skeleton[:17]
    return body_list(BodySkeleton("ada", message))


MOVED = {name: (x + 1000, y, c) for name, (x, y, c) in PERSON.items()}


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (make_yolo(1, [PERSON], name=""), "no class_name"),
        (make_yolo(1, [{}]), "no keypoints; the network must be one for poses"),
        (bad_yolo(0), "of id 0, but ids of COCO's 17 must begin with 1"),
        (bad_yolo(-(2**31)), "must begin with 1"),
        (make_yolo(1, [MOVED]), "inside the image of 640x480 px"),
        (bad_zed(body_format=3), "body_format 3 is none of 0"),
        (bad_zed(confidence=0.0), "confidence is 0, which must be 1 to 99"),
        (bad_zed(confidence=math.nan), "confidence is nan"),
        (make_zed(1, [MOVED]), "inside the image of 640x480 px"),
        (body_list(BodySkeleton("ada", make_skeleton(1, PERSON, (1, 1)))), "must be divided by the image's size"),
        (short_skeleton(), "17 keypoints where its format has 18"),
    ],
)
def test_people_who_cannot_be_used_are_counted_and_told_of_once(message: Any, sentence: str) -> None:
    report = Report()
    assert decode(message, report) == decode(message, report) == []
    assert report.counters["unusable people"] == 2
    (warning,) = report.warnings
    assert warning.startswith("a detected person is left out: ") and sentence in warning


def test_one_bad_person_takes_no_other_along() -> None:
    message = make_yolo(1, [PERSON, PERSON])
    message.detections[0].class_name = ""
    (person,) = decode(message)
    assert_same(person, PERSON)


def test_points_beyond_the_seventeen_are_left_out() -> None:
    report = Report()
    (person,) = decode(bad_yolo(18), report)
    assert_same(person, {name: point for name, point in PERSON.items() if name != COCO[3]})
    assert report.counters["unusable keypoints"] == 1
    assert "a keypoint of id 18 is left out" in report.warnings[0]


def test_of_two_points_with_one_number_the_better_counts() -> None:
    message = make_yolo(1, [PERSON])
    message.detections[0].keypoints.data[1].id = 1
    message.detections[0].keypoints.data[1].score = 0.8
    (person,) = decode(message)
    assert places(person)["nose"] == (*PERSON["left_eye"][:2], 0.8)


def test_a_message_of_another_kind_is_named_with_those_that_are_understood() -> None:
    for message, name in (
        (FACTORY.make("vision_msgs/msg/Detection2DArray", detections=[FACTORY.make("vision_msgs/msg/Detection2D")]),
         "vision_msgs/msg/Detection2D"),
        (FACTORY.make(BOXES, detections=[FACTORY.make("other_msgs/msg/Box")]), "other_msgs/msg/Box"),
        (FACTORY.make("flowing_puppet_msgs/msg/BodyArray"), "flowing_puppet_msgs/msg/BodyArray"),
        (SimpleNamespace(), "types/msg/SimpleNamespace"),
    ):  # fmt: skip
        with pytest.raises(InputError, match="understood are flowing_puppet_msgs/msg/PuppetArray, yolo_msgs") as caught:
            decode(message)
        assert f"{name} " in str(caught.value)


def test_the_input_takes_these_types_also_of_renamed_packages() -> None:
    for kind in (YOLO, ZED, "hri_msgs/msg/IdsList", "zed_interfaces/msg/ObjectsStamped", DETECTIONS.type):
        assert DETECTIONS.accepts(kind)
    for kind in ("vision_msgs/msg/Detection2DArray", "hri_msgs/msg/Skeleton2D", "", "other_msgs/msg/PuppetArray"):
        assert not DETECTIONS.accepts(kind)


numbers = st.floats(width=32)
points = st.lists(st.builds(SimpleNamespace, x=numbers, y=numbers, c=numbers), max_size=20)
keypoints = st.lists(
    st.builds(SimpleNamespace, id=st.integers(-(2**31), 2**31 - 1) | st.integers(1, 17), score=numbers,
              point=st.builds(SimpleNamespace, x=st.floats(), y=st.floats())), max_size=20
)  # fmt: skip
yolo = st.builds(
    SimpleNamespace, class_name=st.sampled_from(["person", "Person", "", "cat"]), id=st.text(max_size=3),
    keypoints=st.builds(SimpleNamespace, data=keypoints),
)  # fmt: skip
zed = st.builds(
    SimpleNamespace, label_id=st.integers(-(2**15), 2**15 - 1), confidence=numbers, tracking_available=st.booleans(),
    skeleton_available=st.booleans(), body_format=st.integers(-128, 127) | st.integers(0, 2),
    skeleton_2d=st.builds(
        SimpleNamespace, keypoints=st.lists(st.builds(SimpleNamespace, kp=st.lists(numbers, max_size=3))) | st.lists(
            st.builds(SimpleNamespace, kp=st.lists(numbers, min_size=2, max_size=2)), min_size=38, max_size=70)),
)  # fmt: skip
skeletons = st.builds(
    BodyList, st.none(), st.dictionaries(st.text(max_size=3), st.builds(SimpleNamespace, skeleton=points))
)


@settings(max_examples=300, deadline=None)
@given(
    st.builds(SimpleNamespace, detections=st.lists(yolo, max_size=3))
    | st.builds(SimpleNamespace, objects=st.lists(zed, max_size=3))
    | skeletons
)
def test_whatever_comes_gives_sane_keypoints(message: Any) -> None:
    for person in decode(message):
        for x, y, confidence in places(person).values():
            assert abs(x) < 1e5 and abs(y) < 1e5 and 0 < confidence <= 1
