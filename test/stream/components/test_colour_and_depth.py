# SPDX-License-Identifier: Apache-2.0
"""The body fitter with the puppets of a colour camera, as a node and a replay drive it."""

from typing import Any

import numpy as np
import pytest
from capsule_man import joints_of  # type: ignore[import-not-found]
from watched_people import (  # type: ignore[import-not-found]
    FOCAL,
    HEIGHT,
    WIDTH,
    Standing,
    find_puppet,
    make_colour_camera,
    stand_at,
    watch,
)

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.component import Output
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import BODIES, CAMERA_INFO, PUPPETS

pytestmark = pytest.mark.slow

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000
LAG_NS = 20_000_000  # by which the colour images are older


def info(stamp: int, factor: float, frame: str = "eye") -> Any:
    """Return the calibration of the depth camera, or of the colour camera of `factor` times its size."""
    fx, cx, cy = FOCAL * factor, (WIDTH * factor - 1) / 2, (HEIGHT * factor - 1) / 2
    size = {"width": round(WIDTH * factor), "height": round(HEIGHT * factor)}
    k = np.array([fx, 0, cx, 0, fx, cy, 0, 0, 1.0])
    return FACTORY.make(CAMERA_INFO, header=make_header(FACTORY, stamp, frame), k=k, d=np.zeros(5), **size)


def puppets(model: StitchedPuppet, stamp: int, people: list[Standing], frame: str = "eye") -> Any:
    """Return what a tracker publishes of people."""
    made = []
    for number, person in enumerate(people):
        seen = find_puppet(model, person, make_colour_camera(), "", 4.0, number)
        joints = [
            FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=sure)
            for name, (x, y), sure in zip(model.joint_names, seen.pixels, seen.confidence, strict=True)
            if np.isfinite(x)
        ]
        made.append(FACTORY.make("flowing_puppet_msgs/msg/Puppet", id=f"a{number + 1}", joints=joints))
    return FACTORY.make(PUPPETS, header=make_header(FACTORY, stamp, frame), puppets=made)


def depth(stamp: int, people: list[Standing]) -> Any:
    metres = watch(people).depth.astype(np.float32)
    return make_image(FACTORY, make_header(FACTORY, stamp, "eye"), metres, "32FC1")


def make(expected: bool = True) -> BodyFitterComponent:
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({}), FACTORY)
    component.set_expected("puppets", expected)
    return component


def bodies_in(outputs: Output) -> list[Any]:
    return [message for name, message in outputs if name == "bodies"]


def test_everybody_has_a_body_under_the_id_of_the_puppet_at_once_whatever_comes_first(model: StitchedPuppet) -> None:
    pair = [stand_at(joints_of(), 2.5, 0.4), stand_at(joints_of(0.2, 0.2, 0.2), 2.3, -0.35, turn=0.0)]
    early, late = puppets(model, SECOND - LAG_NS, pair), puppets(model, SECOND + LAG_NS, pair)
    messages = {
        "in order": [("puppets", early), ("depth", depth(SECOND, pair)), ("puppets", late)],
        "live": [("puppets", early), ("puppets", late), ("depth", depth(SECOND, pair))],
    }
    published = []
    for order in messages.values():
        component = make()
        component.handle("puppets/camera_info", info(SECOND, 2.0))
        component.handle("camera_info", info(SECOND, 1.0))
        outputs = [output for port, message in order for output in component.handle(port, message)]
        (array,) = bodies_in(outputs + component.flush())
        assert [body.id for body in array.bodies] == ["a1", "a2"]
        published.append(typestore().serialize_cdr(array, BODIES))
        assert component.report.drain_warnings() == []
        joints = {joint.name: joint.position for joint in array.bodies[0].joints}
        shoulder = pair[0].joints["left_shoulder"]  # x ahead, y left, z up; the message is in the optical frame
        found = joints["left_shoulder"]
        np.testing.assert_allclose([found.z, -found.x, -found.y], shoulder, atol=0.06)
    assert bytes(published[0]) == bytes(published[1])


def test_a_cloud_waits_for_masks_that_are_expected_and_goes_on_without_those_of_another_image(
    model: StitchedPuppet,
) -> None:
    person = [stand_at(joints_of(), 2.5)]
    component = make()
    component.set_expected("person_masks", True)
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    component.handle("camera_info", info(SECOND, 1.0))
    header = make_header(FACTORY, SECOND, "eye")
    assert bodies_in(component.handle("puppets", puppets(model, SECOND, person))) == []
    assert bodies_in(component.handle("depth", depth(SECOND, person))) == []
    square = make_image(FACTORY, header, np.zeros((100, 100), np.uint8), "mono8")
    (array,) = bodies_in(component.handle("person_masks", square))
    assert [body.id for body in array.bodies] == ["a1"]
    (sentence,) = component.report.drain_warnings()
    assert "100x100 on person_masks" in sentence


@pytest.mark.parametrize(("shift", "told"), [(0.0, False), (30.0, True)])
def test_puppets_that_lie_beside_the_bodies_are_one_sentence(model: StitchedPuppet, shift: float, told: bool) -> None:
    people = [stand_at(joints_of(), 2.5, 0.6), stand_at(joints_of(0.2, 0.2, 0.2), 2.3, -0.6, turn=0.0)]
    component = make()
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    component.handle("camera_info", info(SECOND, 1.0))
    for number in range(11):
        stamp = SECOND + number * SECOND // 30
        seen = puppets(model, stamp, people)
        for joint in (joint for puppet in seen.puppets for joint in puppet.joints):
            joint.x += shift  # of a colour image of 2 px per pixel of depth
        component.handle("puppets", seen)
        component.handle("depth", depth(stamp, people))
    component.flush()
    sentences = [text for text in component.report.drain_warnings() if "colour and depth do not fit" in text]
    assert len(sentences) == told


def test_without_a_puppet_nobody_in_view_has_a_body(model: StitchedPuppet) -> None:
    person = [stand_at(joints_of(), 2.5)]
    component = make()
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    component.handle("camera_info", info(SECOND, 1.0))
    component.handle("puppets", puppets(model, SECOND, []))
    (array,) = bodies_in(component.handle("depth", depth(SECOND, person)) + component.flush())
    assert array.bodies == []
    assert array.header.stamp.sec == 1


@pytest.mark.parametrize(
    ("frame", "calibrated", "sentence"),
    [
        ("other", True, "/tf and /tf_static do not connect 'eye' with 'other'"),
        ("eye", False, "no puppets/camera_info came yet"),
    ],
)
def test_what_cannot_be_joined_is_one_sentence_and_the_cloud_is_used_alone(
    model: StitchedPuppet, frame: str, calibrated: bool, sentence: str
) -> None:
    person = [stand_at(joints_of(), 2.5)]
    component = make()
    component.handle("camera_info", info(SECOND, 1.0))
    if calibrated:
        component.handle("puppets/camera_info", info(SECOND, 2.0, frame))
    component.handle("puppets", puppets(model, SECOND, person, frame))
    (array,) = bodies_in(component.handle("depth", depth(SECOND, person)) + component.flush())
    (said,) = component.report.drain_warnings()
    assert sentence in said
    assert component.counters["clouds without puppets"] == 1
    assert [body.id for body in array.bodies] == ["b1"]


def test_depth_that_is_nowhere_known_is_one_sentence_and_ids_go_on(model: StitchedPuppet) -> None:
    person = [stand_at(joints_of(), 2.5)]
    component = make()
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    for number, shown in enumerate((True, False, True)):
        stamp = SECOND + number * SECOND // 10
        component.handle("camera_info", info(stamp, 1.0))
        component.handle("puppets", puppets(model, stamp, person))
        image = depth(stamp, person)
        if not shown:
            image.data = np.full((HEIGHT, WIDTH), np.nan, np.float32).view(np.uint8).ravel()
        (array,) = bodies_in(component.handle("depth", image))
        assert [(body.id, len(body.parts)) for body in array.bodies] == [("a1", 16 if shown else 0)]
    (said,) = component.report.drain_warnings()
    assert "the cloud has no finite point" in said


def test_who_is_seen_in_colour_only_is_as_far_away_as_the_size_says(model: StitchedPuppet) -> None:
    """Somebody beyond the depth sensor's range stays in the messages, somebody before a wall that it sees does not."""
    near, far = stand_at(joints_of(), 2.5, 0.4), stand_at(joints_of(), 9.0, -0.8)
    component = make()
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    component.handle("camera_info", info(SECOND, 1.0))
    component.handle("puppets", puppets(model, SECOND, [near, far]))
    image = depth(SECOND, [near])
    metres = np.frombuffer(image.data.tobytes(), np.float32).reshape(HEIGHT, WIDTH).copy()
    metres[metres > 3.5] = np.nan  # the sensor's range ends before the wall
    image.data = metres.view(np.uint8).ravel()
    (array,) = bodies_in(component.handle("depth", image) + component.flush())
    assert [(body.id, len(body.parts), body.reliable) for body in array.bodies] == [("a1", 16, True), ("a2", 0, False)]
    joints = {joint.name: joint for joint in array.bodies[1].joints}
    hip, true = joints["left_hip"].position, far.joints["left_hip"]
    assert np.hypot(hip.x / hip.z + true[1] / true[0], hip.y / hip.z + true[2] / true[0]) < 0.02  # on its ray
    assert hip.z == pytest.approx(true[0], rel=0.2)
    assert all(joint.visibility == 0 and joint.confidence < 0.35 for joint in joints.values())

    component.handle("camera_info", info(2 * SECOND, 1.0))
    component.handle("puppets", puppets(model, 2 * SECOND, [near, far]))
    (array,) = bodies_in(component.handle("depth", depth(2 * SECOND, [near])) + component.flush())
    assert [body.id for body in array.bodies] == ["a1"]  # a wall is where a2 should be seen


def test_a_calibration_of_another_size_or_a_depth_of_another_moment_is_one_sentence(model: StitchedPuppet) -> None:
    person = [stand_at(joints_of(), 2.5)]
    component = make()
    component.handle("puppets/camera_info", info(SECOND, 2.0))
    component.handle("puppets", puppets(model, SECOND, person))
    component.handle("camera_info", info(SECOND, 2.0))  # of the colour image
    (array,) = bodies_in(component.handle("depth", depth(SECOND, person)) + component.flush()) or (None,)
    assert array is None
    (said,) = component.report.drain_warnings()
    assert said == (
        "the depth image is 320x240, its camera_info says 640x480: publish the camera_info of these images, as "
        "image_proc's resize does"
    )
    later = 3 * SECOND  # of a moment from which there are no puppets
    component.handle("camera_info", info(later, 1.0))
    (array,) = bodies_in(component.handle("depth", depth(later, person)) + component.flush())
    (said,) = component.report.drain_warnings()
    assert "the puppets nearest to a cloud are 2.00 s from it" in said
    assert [body.id for body in array.bodies] == ["b1"]
