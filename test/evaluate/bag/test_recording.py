# SPDX-License-Identifier: Apache-2.0
"""Reading joints out of messages, and choosing among people (whole bags are read in the tests of the report)."""

from types import SimpleNamespace

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.bag.recording import (
    CameraRecord,
    Recording,
    body_joints,
    find_nearest,
    frontality,
    match_track_to_detections,
    namespace,
    puppet_joints,
    triangulate_detections,
)
from flowing_puppet_ros.evaluate.joints import LIMB_JOINTS
from flowing_puppet_ros.multiview.camera import Camera


def person(joints: dict[str, tuple[float, float]], confidence: float = 0.8) -> SimpleNamespace:
    points = [SimpleNamespace(name=name, x=x, y=y, confidence=confidence) for name, (x, y) in joints.items()]
    return SimpleNamespace(joints=points, parts=[], id="a1", scale=100.0)


def camera(x: float) -> Camera:
    """Make a camera at (x, 0, 0) that looks along +y; image down is -z."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    return Camera(matrix, np.zeros(5), (640, 480), rotation, -rotation @ [x, 0, 0])


@pytest.mark.parametrize(
    ("topic", "expected"),
    [("/cam01/image/compressed", "/cam01"), ("/image", ""), ("/a/b/detections", "/a/b"), ("puppets", "")],
)
def test_namespace(topic: str, expected: str) -> None:
    assert namespace(topic) == expected


def test_joints_without_confidence_or_place_are_left_out() -> None:
    message = person({"LWrist": (1, 2), "RWrist": (np.nan, 2), "nose": (5, 6)})
    message.joints[2].confidence = 0.0
    assert {name: point.tolist() for name, point in puppet_joints(message).items()} == {"left_wrist": [1, 2]}
    place = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    body = SimpleNamespace(joints=[SimpleNamespace(name="left_knee", position=place, confidence=1.0)])
    assert body_joints(body)["left_knee"].tolist() == [1, 2, 3]
    assert puppet_joints(person({})) == {}


def test_nearest_compares_common_joints_only() -> None:
    here = {"left_knee": np.array([10.0, 10]), "left_hip": np.array([10.0, 5])}
    far = {"left_knee": np.array([30.0, 10])}
    near = {"left_hip": np.array([11.0, 5]), "nose": np.array([900.0, 900])}
    assert find_nearest(here, [far, near]) == 1 and find_nearest(here, [{}, far]) == 1
    assert find_nearest(here, [{}]) is None and find_nearest(here, []) is None


def test_the_track_is_compared_with_the_detection_at_its_place() -> None:
    record = CameraRecord("/a")
    record.puppets = {1: [person({"left_knee": (10, 10)})], 2: [], 3: [person({"left_knee": (12, 10)})]}
    record.detections = {1: [person({"LKnee": (90, 10)}), person({"LKnee": (11, 10)})]}
    frames, reference = match_track_to_detections(record)
    assert list(frames) == [1, 3] and reference[1]["left_knee"].tolist() == [11, 10] and 3 not in reference


def test_frontality_tells_front_side_and_back() -> None:
    def seen(width: float) -> dict[int, list[SimpleNamespace]]:
        shoulders = {"left_shoulder": (50 + width, 10.0), "right_shoulder": (50 - width, 10.0)}
        return {1: [person(shoulders | {"left_hip": (55.0, 60.0), "right_hip": (45.0, 60.0)})]}

    front, side, back = (frontality(seen(width)) for width in (15, 1, -15))
    assert front == pytest.approx(0.6) and back == pytest.approx(-0.6) and abs(side) < 0.1
    assert frontality({1: [person({"nose": (1, 1)})], 2: []}) == -np.inf


def test_triangulated_takes_the_person_of_the_body() -> None:
    rng = np.random.default_rng(5)
    body = {name: np.array([0.0, 4, 0]) + rng.uniform(-0.8, 0.8, 3) for name in LIMB_JOINTS}
    recording = Recording()
    for index, x in enumerate((-1.5, 0.0, 1.5)):
        record = CameraRecord(f"/cam{index}", camera=camera(x))
        pixels, _ = camera(x).project(np.stack(list(body.values())))
        man = person(dict(zip(body, map(tuple, pixels), strict=True)))
        stranger = person({name: (float(p[0]) + 200, float(p[1]) - 50) for name, p in zip(body, pixels, strict=True)})
        record.detections = {1: [stranger, man], 2: [man] if index == 0 else []}
        recording.cameras[record.namespace] = record
    found = triangulate_detections(
        recording, {1: {name: point + 0.05 for name, point in body.items()}, 2: body, 3: body}
    )
    assert list(found) == [1]
    for name, point in body.items():
        assert found[1][name] == pytest.approx(point, abs=1e-5)
