# SPDX-License-Identifier: Apache-2.0
"""People by REP-155: ids, skeletons, regions, crops, joint states and URDF, and topics that end with their person."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory, definition_files
from flowing_puppet_ros.image.formats.skeletons import HRI_18
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.component import Port
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.components.ros4hri import (
    Ros4HriPublisher,
    Ros4HriSettings,
    bounding_box,
    make_skeleton2d,
    to_name_component,
)
from flowing_puppet_ros.stream.messages.bodies.human_urdf import find_limits, make_urdf
from flowing_puppet_ros.stream.messages.bodies.ros4hri_skeleton import JOINTS, MOVING_JOINTS, Skeleton
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image

FACTORY = BagMessageFactory()
HEADER = make_header(FACTORY, 1_500_000_000, "camera_optical_frame")
GOLDEN = Path(__file__).resolve().parents[3] / "bags" / "golden" / "golden.mcap"


def test_a_persons_port_knows_its_topics() -> None:
    port = Port("/humans/bodies/{id}/roi", "hri_msgs/msg/NormalizedRegionOfInterest2D")
    assert port.per_person and not Port("roi", port.type).per_person
    assert port.person_topic("a1") == "/humans/bodies/a1/roi"
    assert port.covers("/humans/bodies/a1/roi")
    for other in ("/humans/bodies//roi", "/humans/bodies/a/b/roi", "/humans/bodies/a1/cropped", "/humans/bodies/roi"):
        assert not port.covers(other)


def test_the_skeleton_has_the_order_of_the_constants() -> None:
    (definition,) = (path for path in definition_files("hri_msgs") if path.stem == "Skeleton2D")
    constants = {}
    for line in definition.read_text().splitlines():
        words = line.split("#")[0].split()
        if len(words) == 4 and words[2] == "=":
            constants[words[1].lower()] = int(words[3])
    assert constants == {name: index for index, name in enumerate(HRI_18)}


def test_joints_are_normalised_clipped_and_unknown_ones_have_no_confidence() -> None:
    joints = {
        "neck": (99.5, 49.5, 0.8),
        "left_wrist": (250.0, 20.0, 0.9),
        "nose": (np.nan, 3.0, 0.5),
        "belly": (1, 2, 1),
    }
    message = make_skeleton2d(FACTORY, HEADER, joints, (200, 100))
    neck, wrist = message.skeleton[1], message.skeleton[7]
    assert (neck.x, neck.y) == (0.5, 0.5) and neck.c == pytest.approx(0.8)
    assert wrist.x == 1.0 and 0 < wrist.c < 0.1
    others = [point for index, point in enumerate(message.skeleton) if index not in (1, 7)]
    assert len(others) == 16 and all((point.x, point.y, point.c) == (0, 0, 0) for point in others)
    assert message.header == HEADER


def test_boxes_are_inside_the_image() -> None:
    assert bounding_box(np.array([[2.2, 3.0], [7.0, 4.6]]), (20, 20)) == (2, 3, 8, 6)
    assert bounding_box(np.array([[-9.0, 3.0], [90.0, 4.6]]), (20, 20)) == (0, 3, 20, 6)
    assert bounding_box(np.array([[-9.0, 3.0], [-3.0, 4.6]]), (20, 20)) is None


@pytest.mark.parametrize(
    ("identity", "name"), [("a1", "a1"), ("7", "p7"), ("Jo-hn/3", "Jo_hn_3"), ("ä", "p_"), ("", "p")]
)
def test_ids_fit_into_names_of_topics(identity: str, name: str) -> None:
    assert to_name_component(identity) == name


def test_topics_end_with_their_person() -> None:
    humans = Ros4HriPublisher(Ros4HriSettings(publish=True, namespace="/crowd/"), FACTORY, "urdf")
    text = FACTORY.make("std_msgs/msg/String", data="x")
    first = humans.make(HEADER, ["a1", "a2"], {"a1": {"urdf": text}})
    assert [(name, getattr(message, "ids", "-")) for name, message in first] == [
        ("/crowd/bodies/tracked", ["a1", "a2"]),
        ("/crowd/bodies/a1/urdf", "-"),
    ]
    assert [name for name, _ in humans.make(HEADER, ["a1"], {})] == ["/crowd/bodies/tracked"]
    assert humans.make(HEADER, [], {})[0] == ("/crowd/bodies/a1/urdf", None)
    ((name, empty),) = humans.make(HEADER, [], {})
    assert name == "/crowd/bodies/tracked" and empty.ids == []
    assert Ros4HriPublisher(Ros4HriSettings(), FACTORY, "urdf").ports == ()


@pytest.fixture(scope="module")
def recorded() -> tuple[list[Any], dict[int, Any]]:
    images, detections = [], {}
    with open_bag(GOLDEN) as bag:
        for record in bag.messages(["/cam1/image/compressed", "/cam1/detections"]):
            if record.topic.endswith("detections"):
                detections[stamp_ns(record.message)] = record.message
            else:
                images.append(record.message)
    return images, detections


def test_the_puppets_of_an_image_are_humans(recorded: tuple[list[Any], dict[int, Any]]) -> None:
    images, detections = recorded
    component = PuppetTrackerComponent(PuppetTrackerSettings.from_mapping({"ros4hri.publish": True}), FACTORY)
    component.set_expected("detections", True)
    component.handle("detections", detections[stamp_ns(images[0])])
    made = dict(component.handle("image", images[0]))
    (puppet,) = made["puppets"].puppets
    root = f"/humans/bodies/{puppet.id}"
    assert made["/humans/bodies/tracked"].ids == [puppet.id]
    roi, crop, skeleton = (made[f"{root}/{leaf}"] for leaf in ("roi", "cropped", "skeleton2d"))
    assert all(message.header == images[0].header for message in (roi, crop, skeleton, made["/humans/bodies/tracked"]))
    image = decode_image(images[0])
    height, width = image.shape[:2]
    left, top = round(roi.xmin * width), round(roi.ymin * height)
    np.testing.assert_array_equal(decode_image(crop), image[top : top + crop.height, left : left + crop.width])
    assert crop.width == round((roi.xmax - roi.xmin) * width) and crop.height == round((roi.ymax - roi.ymin) * height)
    wrist = next(joint for joint in puppet.joints if joint.name == "right_wrist")
    assert skeleton.skeleton[4].x * width - 0.5 == pytest.approx(wrist.x, abs=1e-3)
    assert skeleton.skeleton[4].c == pytest.approx(wrist.confidence)
    assert skeleton.skeleton[16].c == 0, "a puppet has no ears"
    component.reset()
    after = component.handle("image", images[1]) + component.flush()
    ended = {name for name, message in after if message is None}
    assert ended == {f"{root}/{leaf}" for leaf in ("roi", "cropped", "skeleton2d")}
    assert dict(after)["/humans/bodies/tracked"].ids == []


def test_a_person_as_urdf() -> None:
    model = StitchedPuppet.load()
    root = ET.fromstring(make_urdf("b1", Skeleton(model).joint_origins(model.rest_state().shape), 70.0))
    links = [link.attrib["name"] for link in root.findall("link")]
    joints = {joint.attrib["name"]: joint for joint in root.findall("joint")}
    assert len(set(links)) == len(links) == len(joints) + 1 and links[0] == "body_b1"
    assert {name.removesuffix("_b1") for name, joint in joints.items() if joint.attrib["type"] == "revolute"} == set(
        MOVING_JOINTS
    )
    assert {"torso", "head", "l_wrist", "r_wrist", "l_ankle", "r_ankle"} == {j.name for j in JOINTS if j.axis is None}
    for joint in joints.values():
        parent, child = joint.find("parent"), joint.find("child")
        assert parent is not None and child is not None
        assert links.index(parent.attrib["link"]) < links.index(child.attrib["link"])


def turn(origin: ET.Element) -> np.ndarray:
    """Return the rotation (3, 3) of an <origin>: about x, then y, then z, fixed axes."""
    roll, pitch, yaw = map(float, origin.attrib["rpy"].split())
    x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return z @ y @ x


def test_the_urdf_has_a_persons_mass_and_their_moments_of_inertia() -> None:
    model = StitchedPuppet.load()
    skeleton, shape = Skeleton(model), model.rest_state().shape
    mass, origins = skeleton.mass(shape), skeleton.joint_origins(shape)
    assert 50 < mass < 90
    root = ET.fromstring(make_urdf("b1", origins, mass))
    masses, center, inertia = [], np.zeros(3), np.zeros((3, 3))
    places = {"body_b1": np.zeros(3)}
    for joint in root.findall("joint"):
        parent, child, origin = joint.find("parent"), joint.find("child"), joint.find("origin")
        assert parent is not None and child is not None and origin is not None
        place = places[parent.attrib["link"]] + np.array([float(v) for v in origin.attrib["xyz"].split()])
        places[child.attrib["link"]] = place
    for link in root.findall("link"):
        inertial = link.find("inertial")
        assert len(link.findall("visual")) == len(link.findall("collision"))
        if inertial is None:
            continue
        own, weight, moments = inertial.find("origin"), inertial.find("mass"), inertial.find("inertia")
        assert own is not None and weight is not None and moments is not None
        at = places[link.attrib["name"]] + np.array([float(v) for v in own.attrib["xyz"].split()])
        masses.append(float(weight.attrib["value"]))
        center += masses[-1] * at
        main = np.diag([float(moments.attrib[name]) for name in ("ixx", "iyy", "izz")])
        assert (np.linalg.eigvalsh(main)[:2].sum() >= np.linalg.eigvalsh(main)[2]).all(), "no such body exists"
        inertia += turn(own) @ main @ turn(own).T + masses[-1] * (at @ at * np.eye(3) - np.outer(at, at))
    assert sum(masses) == pytest.approx(mass, rel=1e-3) and len(masses) == 14
    center /= mass
    inertia -= mass * (center @ center * np.eye(3) - np.outer(center, center))
    # Standing people of 70 kg: centre of mass near the navel; 12, 11 and 1.2 kg m2 about depth, width and length.
    assert abs(center[:2]).max() < 0.1 and 0.0 < center[2] < 0.3
    np.testing.assert_allclose(np.diag(inertia)[:2] / mass, [12 / 70, 11 / 70], rtol=0.35)
    assert 0.8 / 70 < inertia[2, 2] / mass < 2.2 / 70


def test_no_person_of_the_model_breaks_the_limits_of_the_joints() -> None:
    model, rng = StitchedPuppet.load(), np.random.default_rng(4)
    skeleton = Skeleton(model)
    beyond = []
    for _ in range(60):
        state = model.sample(rng)
        angles = skeleton.joint_angles(model.joints(model.vertices(state)), state)
        beyond += [name for name, value in angles.items() if not find_limits(name)[0] <= value <= find_limits(name)[1]]
    assert not beyond
    assert find_limits("l_knee") != find_limits("r_elbow") and find_limits("r_y_shoulder") == (-np.pi, np.pi)


def test_links_have_the_names_that_hri_rviz_shows() -> None:
    """Its TF display knows a skeleton's frames by these names, an underscore and an id of five letters."""
    shown = {"head", "torso", "waist", "p_head", "y_head"} | {
        f"{side}_{name}"
        for side in "lr"
        for name in ("ankle", "elbow", "hip", "knee", "p_hip", "p_shoulder", "shoulder", "wrist", "y_hip", "y_shoulder")
    }
    # It leaves out the link between torso and head that rolls.
    assert {joint.link for joint in JOINTS} - shown == {"r_head"}
    assert shown <= {joint.link for joint in JOINTS}
