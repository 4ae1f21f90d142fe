# SPDX-License-Identifier: Apache-2.0
"""A tiny made-up replay for the tests: two cameras, one person of capsules, one box for a body."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.replay.replay import METADATA_NAME
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.evaluate.joints import LIMB_JOINTS
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, make_point, make_transform
from flowing_puppet_ros.stream.messages.images import encode_jpeg

FACTORY = BagMessageFactory()
SIZE = (120, 160)
STEP = 100_000_000
START = 5_000_000_000

# Facing +x, so that the left is at +y.
HEIGHTS = {"shoulder": 1.4, "elbow": 1.15, "wrist": 0.95, "hip": 0.9, "knee": 0.5, "ankle": 0.1}
WIDTHS = {"shoulder": 0.2, "elbow": 0.3, "wrist": 0.35, "hip": 0.12, "knee": 0.13, "ankle": 0.14}
JOINTS = {
    f"{side}_{joint}": np.array([0.0, sign * WIDTHS[joint], HEIGHTS[joint]])
    for joint in HEIGHTS
    for side, sign in (("left", 1), ("right", -1))
}
TORSO = ("left_shoulder", "right_shoulder", "right_hip", "left_hip")

BOX = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (0.0, 1.7)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [corner for a, b, c, d in QUADS for corner in ((a, b, c), (a, c, d))]


def camera(azimuth: float) -> Camera:
    """A camera 4 m from the person at this azimuth (0 is in front, degrees), level, at 0.9 m."""
    angle = np.deg2rad(azimuth)
    centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.9])
    forward = -np.array([np.cos(angle), np.sin(angle), 0])
    right = np.cross(forward, [0, 0, 1])
    rotation = np.stack([right, [0, 0, -1], forward])
    matrix = np.array([[260.0, 0, 59.5], [0, 260, 79.5], [0, 0, 1]])
    return Camera(matrix, np.zeros(5), SIZE, rotation, -rotation @ centre)


CAMERAS = {"side": camera(70.0), "front": camera(0.0)}


FRAMES = 5

Replay = Callable[..., tuple[Path, Path]]


@dataclass(frozen=True)
class Content:
    """What the bags should hold."""

    puppets: bool = True
    bodies: bool = True
    detections: bool = True
    images: bool = True
    bystander: bool = False
    overlays: bool = False
    space: bool = False


@pytest.fixture
def replay(tmp_path: Path) -> Replay:
    """Makes the bags of a replay, given what they should hold; returns the paths of the input and the output."""

    def make(**content: bool) -> tuple[Path, Path]:
        return write_bags(tmp_path, Content(**content))

    return make


@pytest.fixture(scope="session")
def write_replay() -> Replay:
    """Makes the bags of a replay in a folder; returns the paths of the input and the output."""
    return lambda folder: write_bags(folder, Content())


def joints_at(frame: int) -> dict[str, np.ndarray]:
    """The person walks to its left, 2 cm a frame."""
    return {name: point + np.array([0, 0.02 * frame, 0]) for name, point in JOINTS.items()}


def write_bags(folder: Path, content: Content) -> tuple[Path, Path]:
    """Write the input and the output bag; returns their paths."""
    given, made = folder / "given", folder / "made"
    with BagWriter(given) as bag:
        _write(bag, _inputs(content))
    with BagWriter(made) as bag:
        _write(bag, _outputs(content))
        bag.add_metadata(
            METADATA_NAME, {"replay": json.dumps({"settings": {"front/puppet_tracker": {"particles": 42}}})}
        )
    return given, made


def _write(bag: BagWriter, messages: list[tuple[str, str, int, Any]]) -> None:
    for topic, kind, stamp, message in messages:
        if not bag.has_topic(topic):
            bag.add_topic(topic, kind)
        bag.write(topic, stamp, message)


def _inputs(content: Content) -> list[tuple[str, str, int, Any]]:
    messages: list[tuple[str, str, int, Any]] = []
    poses = []
    for name, view in CAMERAS.items():
        header = make_header(FACTORY, START, "world")
        poses.append(make_transform(FACTORY, header, name, view.centre, view.rotation.T))
    transforms = FACTORY.make("tf2_msgs/msg/TFMessage", transforms=poses)
    messages.append(("/tf_static", "tf2_msgs/msg/TFMessage", START, transforms))
    for frame in range(FRAMES):
        stamp = START + frame * STEP
        for name, view in CAMERAS.items():
            header = make_header(FACTORY, stamp, name)
            size = {"width": SIZE[0], "height": SIZE[1]}
            info = FACTORY.make(
                "sensor_msgs/msg/CameraInfo",
                header=header,
                distortion_model="plumb_bob",
                d=np.zeros(5),
                k=view.matrix.ravel(),
                **size,
            )
            messages.append((f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", stamp, info))
            pixels = pixels_at(frame, view)
            if content.images:
                kind = "sensor_msgs/msg/CompressedImage"
                image = FACTORY.make(kind, header=header, format="jpeg", data=encode_jpeg(picture(pixels), 95))
                messages.append((f"/{name}/image/compressed", kind, stamp, image))
            if content.detections:
                people = [_person(pixels, "")]
                if content.bystander:
                    stranger = {joint: point * 0.3 + (2, 100) for joint, point in pixels.items()}
                    people.insert(0, _person(stranger, ""))
                messages.append(_people(f"/{name}/detections", header, stamp, people))
    return messages


def _outputs(content: Content) -> list[tuple[str, str, int, Any]]:
    messages: list[tuple[str, str, int, Any]] = []
    mesh = "shape_msgs/msg/Mesh"
    for frame in range(FRAMES):
        stamp = START + frame * STEP
        for name, view in CAMERAS.items():
            if content.puppets:
                header = make_header(FACTORY, stamp, name)
                people = [_person(pixels_at(frame, view), "a1", shift=3.0)]
                messages.append(_people(f"/{name}/puppets", header, stamp, people))
            if content.overlays:
                kind = "sensor_msgs/msg/CompressedImage"
                data = encode_jpeg(np.full((64, 48, 3), 40 * frame, np.uint8), 95)
                image = FACTORY.make(kind, header=make_header(FACTORY, stamp, name), format="jpeg", data=data)
                messages.append((f"/{name}/overlay/compressed", kind, stamp, image))
        if content.space:
            messages.append(_silhouettes(make_header(FACTORY, stamp, "world"), stamp, frame))
        if content.bodies and frame % 2 == 0:
            header = make_header(FACTORY, stamp, "world")
            messages += _body(header, stamp, frame)
    if content.bodies:
        corners = [FACTORY.make("shape_msgs/msg/MeshTriangle", vertex_indices=np.array(t)) for t in TRIANGLES]
        messages.insert(0, ("/body_topology", mesh, START, FACTORY.make(mesh, triangles=corners)))
    return messages


def _silhouettes(header: Any, stamp: int, frame: int) -> tuple[str, str, int, Any]:
    """The person in space as it is, but for the left wrist, which is 50 cm too high."""
    joints = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyJoint",
            name=name,
            position=make_point(FACTORY, point + np.array([0, 0, 0.5 * (name == "left_wrist")])),
            confidence=0.9,
        )
        for name, point in joints_at(frame).items()
    ]
    person = FACTORY.make("flowing_puppet_msgs/msg/Body", id="b1", joints=joints)
    kind = "flowing_puppet_msgs/msg/SilhouetteSet"
    return "/silhouettes", kind, stamp, FACTORY.make(kind, header=header, person=person)


def _body(header: Any, stamp: int, frame: int) -> list[tuple[str, str, int, Any]]:
    joints = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyJoint",
            name=name,
            position=make_point(FACTORY, point + np.array([0, 0, 0.03])),
            confidence=0.9,
        )
        for name, point in joints_at(frame).items()
    ]
    parts = [FACTORY.make("flowing_puppet_msgs/msg/BodyPart", name="torso", confidence=0.8)]
    body = FACTORY.make(
        "flowing_puppet_msgs/msg/Body", id="a1", model="nobody", energy=2.5 + frame, joints=joints, parts=parts
    )
    kind, cloud = "flowing_puppet_msgs/msg/BodyArray", "sensor_msgs/msg/PointCloud2"
    vertices = BOX + np.array([0, 0.02 * frame, 0])
    return [
        ("/bodies", kind, stamp, FACTORY.make(kind, header=header, bodies=[body])),
        ("/hull/joints", kind, stamp, FACTORY.make(kind, header=header)),
        ("/body_vertices", cloud, stamp, make_cloud(FACTORY, header, vertices)),
        ("/hull", cloud, stamp, make_cloud(FACTORY, header, vertices * 1.05)),
    ]


def pixels_at(frame: int, view: Camera) -> dict[str, np.ndarray]:
    """The joints in the camera's image."""
    joints = joints_at(frame)
    pixels, _ = view.project(np.stack(list(joints.values())))
    return dict(zip(joints, pixels, strict=True))


def picture(pixels: dict[str, np.ndarray]) -> np.ndarray:
    """A textured person before a textured wall, (160,120,3) RGB."""
    rng = np.random.default_rng(7)
    image = cv2.GaussianBlur(rng.integers(0, 120, (SIZE[1], SIZE[0], 3), dtype=np.uint8), (0, 0), 1.2)
    for first, second in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
        for side in ("left", "right"):
            ends = [np.rint(pixels[f"{side}_{joint}"]).astype(int).tolist() for joint in (first, second)]
            cv2.line(image, ends[0], ends[1], (230, 190, 160), 7)
    cv2.fillPoly(image, [np.rint([pixels[name] for name in TORSO]).astype(np.int32)], (200, 80, 60))
    return image


def _person(pixels: dict[str, np.ndarray], identity: str, shift: float = 0.0) -> Any:
    """A puppet message; with an id it has a torso as its part, and all joints `shift` px to the right."""
    joints = []
    for name in LIMB_JOINTS:
        x, y = pixels[name] + np.array([shift, 0])
        joints.append(FACTORY.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=0.9))
    parts = []
    if identity:
        contour = np.stack([pixels[name] for name in TORSO])
        parts.append(
            FACTORY.make(
                "flowing_puppet_msgs/msg/PuppetPart", name="torso", label=1, confidence=0.7, contour=contour.ravel()
            )
        )
    values = {"view": "front", "scale": 65.0, "energy": 12.5} if identity else {}
    kind = "flowing_puppet_msgs/msg/Puppet"
    return FACTORY.make(kind, id=identity, confidence=0.9, joints=joints, parts=parts, **values)


def _people(topic: str, header: Any, stamp: int, people: list[Any]) -> tuple[str, str, int, Any]:
    kind = "flowing_puppet_msgs/msg/PuppetArray"
    return topic, kind, stamp, FACTORY.make(kind, header=header, puppets=people)
