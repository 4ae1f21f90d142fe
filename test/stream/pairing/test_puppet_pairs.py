# SPDX-License-Identifier: Apache-2.0
"""Puppets paired with clouds by stamp and frame, and the sentences for what cannot be paired."""

from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.people_fitter import FusionSettings
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO, PUPPETS, TRANSFORMS
from flowing_puppet_ros.stream.pairing.puppet_pairs import PuppetPairs

FACTORY = BagMessageFactory()
SECOND = 1_000_000_000
NAMES = ("belly", "neck", "left_shoulder", "right_shoulder", "left_wrist")
TORSO = [80, 80, 200, 80, 200, 300, 80, 300.0]


def puppets(stamp: int, x: float, frame: str = "eye", identity: str = "a1", wrist_depth: int = 0) -> Any:
    """Return a puppet with its joints in a row from x px, whose torso covers them."""
    joints = [
        FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x + 10 * k, y=100.0, confidence=0.9)
        for k, name in enumerate(NAMES)
    ]
    parts = [
        FACTORY.make("flowing_puppet_msgs/msg/PuppetPart", name="torso", depth=5, contour=TORSO),
        FACTORY.make("flowing_puppet_msgs/msg/PuppetPart", name="left_lower_arm", depth=wrist_depth),
    ]
    puppet = FACTORY.make("flowing_puppet_msgs/msg/Puppet", id=identity, joints=joints, parts=parts)
    return FACTORY.make(PUPPETS, header=make_header(FACTORY, stamp, frame), puppets=[puppet])


def info(frame: str = "eye", size: tuple[int, int] = (640, 480)) -> Any:
    k = np.array([500, 0, 320, 0, 500, 240, 0, 0, 1.0])
    p = np.array([400, 0, 300, 0, 0, 400, 200, 0, 0, 0, 1.0, 0])
    return FACTORY.make(
        CAMERA_INFO, header=make_header(FACTORY, 0, frame), width=size[0], height=size[1], k=k, d=np.zeros(5), p=p,
        distortion_model="plumb_bob",
    )  # fmt: skip


def pairs(model: StitchedPuppet, *messages: Any, **settings: Any) -> PuppetPairs:
    """Return pairs that have a camera_info of the frame eye, and some messages of puppets."""
    made = PuppetPairs(model, FusionSettings(**settings))
    made.add("puppets/camera_info", info())
    for message in messages:
        made.add("puppets", message)
    return made


def header(stamp: int, frame: str = "eye") -> Any:
    return make_header(FACTORY, stamp, frame)


def neck_at(found: Any, model: StitchedPuppet) -> float:
    return float(found.puppets[0].pixels[model.joint_names.index("neck"), 0])


@pytest.mark.parametrize(
    ("at", "x"), [(1.0, 110.0), (1.025, 120.0), (1.1, 150.0), (1.25, 150.0)]
)  # 1 s: the first image; then evenly to the second at 1.1 s, and no further
def test_joints_are_where_they_are_at_the_time_of_the_cloud(model: StitchedPuppet, at: float, x: float) -> None:
    made = pairs(model, puppets(SECOND, 100), puppets(SECOND + SECOND // 10, 140))
    found = made.find(header(round(at * SECOND)), round(at * SECOND), np.eye(3), np.zeros(3))
    assert neck_at(found, model) == pytest.approx(x, abs=1e-3)


def test_a_cloud_waits_for_puppets_that_are_not_older(model: StitchedPuppet) -> None:
    made = pairs(model, puppets(SECOND, 100))
    assert made.is_ready("eye", SECOND)
    assert not made.is_ready("eye", SECOND + 1)
    made.drop_until(2 * SECOND)
    assert made.is_ready("eye", SECOND)  # the last ones are kept


def test_late_and_disordered_puppets_are_sorted_and_a_jump_back_is_a_new_recording(model: StitchedPuppet) -> None:
    made = pairs(model, puppets(SECOND + 100, 140), puppets(SECOND, 100))
    assert neck_at(made.find(header(SECOND), SECOND, np.eye(3), np.zeros(3)), model) == pytest.approx(110)
    made.add("puppets", puppets(SECOND - 100 * SECOND // 10, 50))
    assert not made.is_ready("eye", SECOND)


def test_the_camera_stands_where_tf_puts_it_in_the_frame_with_z_up(model: StitchedPuppet) -> None:
    made = pairs(model, puppets(SECOND, 100))
    turn = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of the optical frame in that of the LiDAR
    transform = make_transform(FACTORY, make_header(FACTORY, 0, "lidar"), "eye", np.array([0.1, 0.2, -0.3]), turn)
    made.add("/tf_static", FACTORY.make(TRANSFORMS, transforms=[transform]))
    camera = made.find(header(SECOND, "lidar"), SECOND, np.eye(3), np.zeros(3)).camera
    np.testing.assert_allclose(camera.centre, [0.1, 0.2, -0.3], atol=1e-9)
    # 2 m ahead of the camera and 0.4 m to its left.
    np.testing.assert_allclose(camera.project([2.1, 0.6, -0.3])[0], [320 - 500 * 0.2, 240], atol=1e-6)
    upside_down = np.diag([1.0, -1.0, -1.0])
    camera = made.find(header(SECOND, "lidar"), SECOND, upside_down, np.zeros(3)).camera
    np.testing.assert_allclose(camera.project(upside_down @ [2.1, 0.6, -0.3])[0], [220, 240], atol=1e-6)


def test_puppets_of_rectified_images_take_the_projection_matrix(model: StitchedPuppet) -> None:
    camera = (
        pairs(model, puppets(SECOND, 100), rectified=True).find(header(SECOND), SECOND, np.eye(3), np.zeros(3)).camera
    )
    np.testing.assert_allclose(camera.project([0.5, 0.25, 1.0])[0], [500, 300])


@pytest.mark.parametrize(("depth", "hidden"), [(0, True), (7, False)])
def test_what_lies_behind_the_puppets_own_torso_is_hidden(model: StitchedPuppet, depth: int, hidden: bool) -> None:
    found = pairs(model, puppets(SECOND, 100, wrist_depth=depth)).find(header(SECOND), SECOND, np.eye(3), np.zeros(3))
    assert bool(found.puppets[0].hidden[model.joint_names.index("left_wrist")]) == hidden


def test_ids_begin_with_a_letter(model: StitchedPuppet) -> None:
    found = pairs(model, puppets(SECOND, 100, identity="17")).find(header(SECOND), SECOND, np.eye(3), np.zeros(3))
    assert [puppet.id for puppet in found.puppets] == ["p17"]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"info": None}, "no puppets/camera_info came yet"),
        ({"puppets": None}, "no puppets came for the clouds yet"),
        ({"at": 3 * SECOND}, "2.00 s from it, beyond the fusion.max_lag of 0.35 s"),
        ({"frame": "lidar"}, "/tf and /tf_static do not connect 'lidar' with 'eye'; publish or record the transform"),
        ({"info": info("other_eye")}, "the puppets are of the camera 'eye', puppets/camera_info is of 'other_eye'"),
        ({"info": info(size=(100, 80))}, "outside of the 100x80 image of puppets/camera_info"),
    ],
)
def test_what_cannot_be_paired_is_one_sentence(model: StitchedPuppet, changed: dict[str, Any], sentence: str) -> None:
    made = PuppetPairs(model, FusionSettings())
    if (calibration := changed.get("info", info())) is not None:
        made.add("puppets/camera_info", calibration)
    if changed.get("puppets", True):
        made.add("puppets", puppets(SECOND, 100))
    stamp = changed.get("at", SECOND)
    with pytest.raises(InputError, match=sentence.replace("(", r"\(")):
        made.find(header(stamp, changed.get("frame", "eye")), stamp, np.eye(3), np.zeros(3))


def mask(stamp: int, left: int, width: int = 100, shape: tuple[int, int] = (480, 640)) -> Any:
    """Return a label image in which somebody is at columns from `left` on."""
    labels = np.zeros(shape, dtype=np.uint8)
    labels[:, left : left + width] = 1
    return make_image(FACTORY, make_header(FACTORY, stamp, "eye"), labels, "mono8")


def test_masks_move_with_the_joints_between_two_images(model: StitchedPuppet) -> None:
    made = pairs(model, puppets(SECOND, 100), puppets(SECOND + SECOND // 10, 140))
    made.add("person_masks", mask(SECOND, 80))
    made.add("person_masks", mask(SECOND + SECOND // 10, 120))
    for at, left in ((1.0, 80.0), (1.025, 90.0), (1.075, 110.0), (1.1, 120.0)):
        (found,) = made.find(header(round(at * SECOND)), round(at * SECOND), np.eye(3), np.zeros(3)).puppets
        assert found.mask is not None
        edge = found.mask.measure_distance(np.array([[left - 20, 100.0], [left + 20, 100.0]]))
        np.testing.assert_allclose(edge, [20, -20], atol=1.5)
    # Nothing tells how they go on after the last image.
    later = round(1.2 * SECOND)
    assert made.find(header(later), later, np.eye(3), np.zeros(3)).puppets[0].mask is None


def test_clouds_wait_for_masks_but_not_for_those_who_fall_silent(model: StitchedPuppet) -> None:
    made = pairs(model, puppets(SECOND, 100))
    assert made.is_ready("eye", SECOND)
    assert not made.is_ready("eye", SECOND, masked=True)
    made.add("person_masks", mask(SECOND, 80))
    assert made.is_ready("eye", SECOND, masked=True)
    made.add("puppets", puppets(2 * SECOND, 100))
    assert not made.is_ready("eye", 2 * SECOND, masked=True)
    made.add("puppets", puppets(4 * SECOND, 100))
    assert made.is_ready("eye", 4 * SECOND, masked=True)  # fusion.wait is 2 s
    made.drop_until(4 * SECOND)
    made.add("puppets", puppets(5 * SECOND, 100))
    assert made.is_ready("eye", 5 * SECOND, masked=True)
    made.add("person_masks", mask(5 * SECOND, 80))
    made.add("puppets", puppets(6 * SECOND, 100))
    assert not made.is_ready("eye", 6 * SECOND, masked=True)


def test_nobody_waits_long_for_masks_that_never_come(model: StitchedPuppet) -> None:
    made = pairs(model)
    ready = []
    for second in range(1, 7):
        made.add("puppets", puppets(second * SECOND, 100))
        ready.append(made.is_ready("eye", second * SECOND, masked=True))
        made.drop_until(second * SECOND)
    assert ready == [False, False, False, True, True, True]


def test_a_mask_of_another_image_is_one_sentence_and_the_puppets_stay(model: StitchedPuppet) -> None:
    report = Report()
    made = PuppetPairs(model, FusionSettings(), report=report)
    made.add("puppets/camera_info", info())
    made.add("puppets", puppets(SECOND, 100))
    made.add("person_masks", mask(SECOND, 80, shape=(480, 480)))
    (found,) = made.find(header(SECOND), SECOND, np.eye(3), np.zeros(3)).puppets
    assert found.mask is None
    (sentence,) = report.drain_warnings()
    assert "480x480 on person_masks" in sentence
    assert report.counters["unusable masks"] == 1
