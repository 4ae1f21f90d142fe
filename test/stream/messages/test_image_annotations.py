# SPDX-License-Identifier: Apache-2.0
"""Boxes of vision_msgs and drawings of foxglove_msgs: where things are, in which colours, and what is left out."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory, definition_files, typestore
from flowing_puppet_ros.draw.palette import PART_COLOURS, joint_colour, person_colour
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.image_annotations import (
    BONES,
    LINE_LIST,
    LINE_LOOP,
    make_annotations,
    make_detections_2d,
    simplify,
)

FACTORY = BagMessageFactory()
HEADER = make_header(FACTORY, 1_500_000_007, "camera")
SIZE = (320, 240)
NAN = float("nan")
ARM = {"left_shoulder": (100.0, 60.0, 0.9), "left_elbow": (110.0, 90.0, 0.8), "left_wrist": (120.0, 120.0, 0.3)}
OUTLINE = np.array([(90.0, 50.0), (130.0, 50.0), (130.0, 125.0), (90.0, 125.0)])


def puppet(identity: str = "a2", joints: Any = ARM, outline: Any = OUTLINE, confidence: float = 0.75) -> Any:
    """Return a Puppet with one part."""
    make, package = FACTORY.make, "flowing_puppet_msgs/msg/"
    parts = [make(package + "PuppetPart", name="left_upper_arm", label=1, contour=outline)] if len(outline) else []
    points = [make(package + "PuppetJoint", name=n, x=x, y=y, confidence=c) for n, (x, y, c) in joints.items()]
    return make(package + "Puppet", id=identity, confidence=confidence, joints=points, parts=parts)


def corners(detection: Any) -> list[float]:
    """Return left, top, right and bottom of a detection's box."""
    box, centre = detection.bbox, detection.bbox.center.position
    return [
        *(centre.x - box.size_x / 2, centre.y - box.size_y / 2),
        *(centre.x + box.size_x / 2, centre.y + box.size_y / 2),
    ]


def rgba(colour: Any) -> tuple[int, int, int, float]:
    """Return a Color as 0 to 255, and its opacity."""
    return round(colour.r * 255), round(colour.g * 255), round(colour.b * 255), colour.a


def test_a_person_is_a_detection_with_box_class_score_and_id() -> None:
    made = make_detections_2d(FACTORY, HEADER, [puppet(), puppet("a7", confidence=1.5)], SIZE)
    assert made.header == HEADER
    first, second = made.detections
    # Pixel centres of ours lie half a pixel from the corner of the image.
    assert corners(first) == [90.5, 50.5, 130.5, 125.5] and first.bbox.center.theta == 0
    (result,) = first.results
    assert (first.header, first.id, result.hypothesis.class_id) == (HEADER, "a2", "person")
    assert (result.hypothesis.score, second.results[0].hypothesis.score) == (0.75, 1.0)
    assert result.pose.pose.orientation.w == 1.0
    assert make_detections_2d(FACTORY, HEADER, [], SIZE).detections == []


def test_boxes_are_clipped_and_people_outside_are_left_out() -> None:
    beside, away = {"neck": (-50.0, 60.0, 0.2)}, OUTLINE + np.array([0, 300])
    people = [
        puppet("a1", ARM | {"right_wrist": (400.0, -20.0, 0.5)}),
        puppet("a2", ARM | beside, OUTLINE),
        puppet("a3", {}, away),
        puppet("a4", {"neck": (NAN, NAN, 0.0)}, []),
        puppet("a5", ARM, []),
        puppet("a6", ARM | {"neck": (1e30, 1e30, 1.0)}, OUTLINE * 1e9),
    ]
    made = {one.id: corners(one) for one in make_detections_2d(FACTORY, HEADER, people, SIZE).detections}
    assert made == {
        "a1": [90.5, 0, 320, 125.5],
        "a2": [0, 50.5, 130.5, 125.5],
        "a5": [100.5, 60.5, 120.5, 120.5],
        "a6": [100.5, 60.5, 120.5, 120.5],
    }


def test_drawings_have_outlines_lines_joints_and_label() -> None:
    made = make_annotations(FACTORY, HEADER, [puppet()], SIZE)
    outline, bones = made.points
    assert (outline.type, bones.type) == (LINE_LOOP, LINE_LIST)
    assert [(p.x, p.y) for p in outline.points] == [(x + 0.5, y + 0.5) for x, y in OUTLINE]
    assert rgba(outline.outline_color) == (*PART_COLOURS["left_upper_arm"], 1.0)
    assert rgba(outline.fill_color) == (*PART_COLOURS["left_upper_arm"], 0.2)
    assert [(p.x, p.y) for p in bones.points] == [(100.5, 60.5), (110.5, 90.5), (110.5, 90.5), (120.5, 120.5)]
    assert rgba(bones.outline_color) == (*person_colour("a2"), 1.0) and bones.fill_color.a == 0
    assert [(c.position.x, c.position.y) for c in made.circles] == [(x + 0.5, y + 0.5) for x, y, _ in ARM.values()]
    side = joint_colour("left_elbow")
    assert [rgba(c.fill_color)[:3] == side for c in made.circles] == [True, True, False], "a doubtful joint is a ring"
    assert rgba(made.circles[2].outline_color)[:3] == side
    assert made.circles[0].diameter > made.circles[1].diameter > made.circles[2].diameter
    (label,) = made.texts
    assert label.text == "a2" and rgba(label.background_color) == (*person_colour("a2"), 1.0)
    assert label.position.x == 90.5 and 44 < label.position.y <= 50.5
    elements = [made, *made.circles, *made.points, *made.texts]
    assert all(element.timestamp == HEADER.stamp for element in elements)


def test_the_kinds_of_points_are_those_of_the_definition() -> None:
    (text,) = (p.read_text() for p in definition_files("foxglove_msgs") if p.stem == "PointsAnnotation")
    assert f"LINE_LOOP={LINE_LOOP} " in text and f"LINE_LIST={LINE_LIST} " in text


def test_what_is_unknown_is_not_drawn() -> None:
    hidden = ARM | {"left_elbow": (NAN, NAN, 0.0), "neck": (1e30, 0.0, 1.0)}
    made = make_annotations(FACTORY, HEADER, [puppet(joints=hidden, outline=OUTLINE * NAN)], SIZE)
    assert len(made.circles) == 2 and made.points == []
    outside = make_annotations(FACTORY, HEADER, [puppet(joints={}, outline=OUTLINE - 500)], SIZE)
    assert outside.texts == [], "nobody is named in an image that they are not in"
    high = make_annotations(FACTORY, HEADER, [puppet(outline=OUTLINE - np.array([0, 60]))], SIZE)
    assert high.texts[0].position.y == high.texts[0].font_size, "a label stays in the image"
    empty = make_annotations(FACTORY, HEADER, [], SIZE)
    assert (empty.circles, empty.points, empty.texts) == ([], [], [])


def test_bones_join_every_joint_of_the_larger_puppet_once() -> None:
    assert len(BONES) == len(set(BONES)) == 18
    joined = {joint for bone in BONES for joint in bone}
    assert len(joined) == 19, "a tree of 19 joints has 18 lines"


def test_simple_outlines_stay_near_the_full_ones() -> None:
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    outline = np.stack([100 + 40 * np.cos(angle), 100 + 15 * np.sin(angle)], axis=1)
    simple = simplify(outline)
    assert 8 < len(simple) < 60
    polygon = simple.astype(np.float32).reshape(-1, 1, 2)
    distances = [abs(cv2.pointPolygonTest(polygon, (float(x), float(y)), True)) for x, y in outline]
    assert 0.05 < max(distances) <= 0.26


def test_people_have_different_colours() -> None:
    assert len({person_colour(f"b{number}") for number in range(1, 8)}) == 7
    assert person_colour("a1") == person_colour("a8") == person_colour("") != person_colour("a2")
    letters = [person_colour(name) for name in ("bkqzf", "xwhar", "dnotu", "plmie", "gsvcy")]
    assert len(set(letters)) >= 3 and letters[0] == person_colour("bkqzf")


@pytest.mark.parametrize("make", [make_detections_2d, make_annotations])
def test_the_messages_serialise_to_themselves(make: Any) -> None:
    message = make(FACTORY, HEADER, [puppet(), puppet("a3", {}, [])], SIZE)
    store, name = typestore(), message.__msgtype__
    data = store.serialize_cdr(message, name)
    assert store.serialize_cdr(store.deserialize_cdr(data, name), name) == data


def test_older_foxglove_messages_do_without_the_stamp_of_the_whole() -> None:
    class Older:
        """Makes ImageAnnotations as foxglove_msgs before 3.2.5 has them."""

        def make(self, type_name: str, **values: Any) -> Any:
            """Make a message."""
            is_whole = type_name == "foxglove_msgs/msg/ImageAnnotations"
            return SimpleNamespace(**values) if is_whole else FACTORY.make(type_name, **values)

    made = make_annotations(Older(), HEADER, [puppet()], SIZE)
    assert set(vars(made)) == {"circles", "points", "texts"}
    assert made.circles[0].timestamp == HEADER.stamp
