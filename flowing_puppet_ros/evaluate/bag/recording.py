# SPDX-License-Identifier: Apache-2.0
"""Read puppets, detections, cameras and bodies out of a replay's bags, ready to be compared.

Topics are found by their types and namespaces: what a camera publishes shares the namespace of its images, and
PuppetArrays called `detections` come from a detector, all others from the tracker.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.depth_topics import encoding_of, holds_depth
from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.joints import LIMB_JOINTS, named_points
from flowing_puppet_ros.image.formats.keypoints import normalise_name
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import triangulate
from flowing_puppet_ros.stream.component import base_topic
from flowing_puppet_ros.stream.messages.depth import depth_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns

IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO, CLOUD, TRANSFORMS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
MESH = "shape_msgs/msg/Mesh"
PUPPETS, BODIES = "flowing_puppet_msgs/msg/PuppetArray", "flowing_puppet_msgs/msg/BodyArray"

MADE = ("overlay", "part_labels", "preview", "hull", "body_vertices")
"""Last words of topics of images and clouds that are results and not a sensor's."""

Joints = dict[str, np.ndarray]


@dataclass(slots=True, eq=False)
class CameraRecord:
    """What the bags hold of one camera; people of each image stamp (ns) as messages, largest puppets first."""

    namespace: str
    image_topic: str = ""
    frame_id: str = ""
    info: Any = None
    camera: Camera | None = None
    puppets: dict[int, list[Any]] = field(default_factory=dict)
    detections: dict[int, list[Any]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The namespace without slashes around it, or "camera"."""
        return self.namespace.strip("/") or "camera"


@dataclass(slots=True, eq=False)
class Recording:
    """What both bags of a replay hold, without images and clouds; keys are stamps in ns."""

    cameras: dict[str, CameraRecord] = field(default_factory=dict)
    bodies: dict[int, list[Any]] = field(default_factory=dict)
    triangles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    body_frame: str = ""
    cloud_topics: dict[str, str] = field(default_factory=dict)
    """Topics of "hull", "body_vertices", and the input's "points" or "depth"."""
    counts: dict[str, int] = field(default_factory=dict)  # messages of each topic that replay wrote

    @property
    def start(self) -> int:
        """The first stamp of all, ns; 0 without any."""
        stamps = [*self.bodies]
        for camera in self.cameras.values():
            stamps += [*camera.puppets, *camera.detections]
        return min(stamps, default=0)


def namespace(topic: str) -> str:
    """The topic without its last word; that of a transport does not count."""
    return base_topic(topic).rpartition("/")[0]


def read_recording(given: Bag, made: Bag) -> Recording:
    """Gather a replay's input bag `given` and output bag `made`; what both hold is taken from the output.

    Raises InputError when `made` has neither puppets nor bodies, and says which topics it has.
    """
    recording = Recording(counts={name: topic.count for name, topic in made.details.items()})
    carried = {_role(name, kind) for name, kind in made.topics.items()}
    if not carried & {PUPPETS, BODIES}:
        names = ", ".join(sorted(made.topics)) or "none"
        raise InputError(f"{made.path} has neither puppets nor bodies; its topics are {names}")
    frames = FrameTree()
    missing = {INFO, TRANSFORMS, "detections"} - carried
    for bag, roles in ((made, carried - {""}), (given, missing)):
        wanted = [name for name, kind in bag.topics.items() if _role(name, kind) in roles]
        for record in bag.messages(wanted):
            # What the replay could not use is in its warnings; the rest is worth a report.
            with suppress(InputError):
                _take(recording, frames, record.topic, record.type, record.message)
    for name, kind in made.topics.items():
        if kind == CLOUD and leaf(name) in ("hull", "body_vertices"):
            recording.cloud_topics[leaf(name)] = name
    for name, kind in given.topics.items():
        if kind == CLOUD and leaf(name) not in MADE:
            recording.cloud_topics.setdefault("points", name)
    _find_images(recording, given)
    _place_cameras(recording, frames)
    return recording


def leaf(topic: str) -> str:
    """The last word of a topic; that of a transport does not count."""
    return base_topic(topic).rpartition("/")[2]


def _role(topic: str, kind: str) -> str:
    """What a topic of this type is read for: its type, or "detections"; empty when it is not read."""
    if kind == PUPPETS and leaf(topic) == "detections":
        return "detections"
    unread = (kind == BODIES and leaf(topic) == "joints") or (kind == TRANSFORMS and leaf(topic) != "tf_static")
    return kind if kind in (INFO, TRANSFORMS, PUPPETS, BODIES, MESH) and not unread else ""


def _take(recording: Recording, frames: FrameTree, topic: str, kind: str, message: Any) -> None:
    role = _role(topic, kind)
    if role == TRANSFORMS:
        frames.add(message)
    elif role == MESH:
        recording.triangles = np.array([triangle.vertex_indices for triangle in message.triangles], np.int64)
    elif role == BODIES:
        recording.bodies[stamp_ns(message)] = list(message.bodies)
        recording.body_frame = message.header.frame_id
    else:
        camera = recording.cameras.setdefault(namespace(topic), CameraRecord(namespace(topic)))
        if role == INFO:
            camera.info = message
        elif role == PUPPETS:
            camera.puppets[stamp_ns(message)] = sorted(message.puppets, key=lambda one: (-one.scale, one.id))
        else:
            camera.detections[stamp_ns(message)] = list(message.puppets)
        camera.frame_id = camera.frame_id or message.header.frame_id


def _find_images(recording: Recording, given: Bag) -> None:
    """Give each camera the image topic of its namespace, or else the one whose first image has its frame.

    Depth images in the frame of the bodies are what these were fitted to.
    """
    topics = [
        name for name, topic in given.details.items() if topic.type in IMAGE and topic.count and leaf(name) not in MADE
    ]
    by_frame: dict[str, str] = {}
    for topic in list(topics):
        with suppress(InputError):
            image = next(given.messages([topic])).message
            frame = image.header.frame_id
            if not holds_depth(topic, encoding_of(topic, image)):
                by_frame.setdefault(frame, topic)
                continue
            topics.remove(topic)
            if recording.bodies and frame == recording.body_frame:
                recording.cloud_topics.setdefault("depth", topic)
    for camera in recording.cameras.values():
        same = [topic for topic in topics if namespace(topic) == camera.namespace]
        camera.image_topic = min(same) if same else by_frame.get(camera.frame_id, "")


def sensed_clouds(recording: Recording) -> list[str]:
    """The input's topics of what bodies were fitted to: points, or else depth images."""
    return [recording.cloud_topics[name] for name in ("points", "depth") if name in recording.cloud_topics][:1]


def as_cloud(recording: Recording, topic: str, message: Any) -> Any:
    """The PointCloud2 of a message on one of `sensed_clouds`; InputError when a depth image cannot be used."""
    if topic != recording.cloud_topics.get("depth"):
        return message
    camera = recording.cameras.get(namespace(topic))
    return depth_cloud(BagMessageFactory(), message, camera and camera.info)


def _place_cameras(recording: Recording, frames: FrameTree) -> None:
    """Make calibrated cameras of those whose frame is tied to the bodies' frame (or to a common root)."""
    for record in recording.cameras.values():
        if record.info is None:
            continue
        frame = record.info.header.frame_id
        info = record.info
        # Without a calibration or a place everything but the re-projection can still be shown.
        with suppress(InputError):
            pose = frames.pose(recording.body_frame or frames.root(frame), frame)
            if pose is None:
                continue
            translation, rotation = pose
            record.camera = Camera.from_info(
                info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model
            )


def puppet_joints(person: Any) -> Joints:
    """Known joints {our name: (x, y)} of a Puppet message, pixels."""
    points = np.array([(joint.x, joint.y) for joint in person.joints], float).reshape(-1, 2)
    seen = [k for k, joint in enumerate(person.joints) if joint.confidence > 0]
    return named_points([person.joints[k].name for k in seen], points[seen])


def body_joints(body: Any) -> Joints:
    """Known joints {our name: (x, y, z)} of a Body message, metres."""
    points = np.array([(j.position.x, j.position.y, j.position.z) for j in body.joints], float).reshape(-1, 3)
    return named_points([joint.name for joint in body.joints], points)


def nearest(joints: Joints, candidates: Iterable[Joints]) -> int | None:
    """Index of the candidate whose common joints are nearest on average; None when none has a joint in common."""
    best, least = None, np.inf
    for index, candidate in enumerate(candidates):
        common = [name for name in joints if name in candidate]
        if common:
            distance = float(np.mean([np.linalg.norm(joints[name] - candidate[name]) for name in common]))
            if distance < least:
                best, least = index, distance
    return best


def track_and_detections(camera: CameraRecord) -> tuple[dict[int, Joints], dict[int, Joints]]:
    """The nearest person's puppet of each stamp, and the detection that fits it best, {stamp: joints}."""
    frames = {stamp: puppet_joints(people[0]) for stamp, people in camera.puppets.items() if people}
    reference: dict[int, Joints] = {}
    for stamp, joints in frames.items():
        candidates = [puppet_joints(person) for person in camera.detections.get(stamp, ())]
        index = nearest(joints, candidates)
        if index is not None:
            reference[stamp] = candidates[index]
    return frames, reference


def triangulated(recording: Recording, bodies: Mapping[int, Joints]) -> dict[int, Joints]:
    """Limb joints {stamp: {name: (3,) metres}} triangulated from the detections of the person of each body.

    Where a camera detected several people it is the one nearest to the re-projected body. Stamps at which fewer than
    two calibrated cameras detected anybody are left out.
    """
    placed = [(record, record.camera) for record in recording.cameras.values() if record.camera is not None]
    found: dict[int, Joints] = {}
    for stamp, body in bodies.items():
        seen = [(record, camera) for record, camera in placed if record.detections.get(stamp)]
        if len(seen) < 2 or not body:
            continue
        views = [_detected(record.detections[stamp], camera, body) for record, camera in seen]
        points, confidence = (np.stack(column) for column in zip(*views, strict=True))
        joints, _ = triangulate([camera for _, camera in seen], points, confidence)
        found[stamp] = named_points(LIMB_JOINTS, joints)
    return found


def _detected(people: list[Any], camera: Camera, body: Joints) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (12,2) and confidences (12,) of the limb joints of the person that is where the body is."""
    pixels, _ = camera.project(np.stack(list(body.values())))
    expected = named_points(list(body), pixels)
    chosen = people[nearest(expected, map(puppet_joints, people)) or 0]
    points, confidence = np.full((len(LIMB_JOINTS), 2), np.nan), np.zeros(len(LIMB_JOINTS))
    for joint in chosen.joints:
        name = normalise_name(joint.name)
        if name in LIMB_JOINTS:
            points[LIMB_JOINTS.index(name)] = joint.x, joint.y
            confidence[LIMB_JOINTS.index(name)] = joint.confidence
    return points, confidence


def first_bodies(recording: Recording) -> dict[int, Any]:
    """The first body of each stamp that has one."""
    return {stamp: bodies[0] for stamp, bodies in recording.bodies.items() if bodies}


def frontality(people: Mapping[int, list[Any]]) -> float:
    """How frontally a camera sees the first person on average: signed shoulder width over shoulder-to-hip length.

    About 0.6 from the front, 0 from the side, negative from behind; -inf when the four joints never are known.
    """
    ratios = []
    for persons in people.values():
        joints = puppet_joints(persons[0]) if persons else {}
        if all(f"{side}_{joint}" in joints for side in ("left", "right") for joint in ("shoulder", "hip")):
            length = np.linalg.norm(
                joints["left_shoulder"] + joints["right_shoulder"] - joints["left_hip"] - joints["right_hip"]
            )
            ratios.append((joints["left_shoulder"][0] - joints["right_shoulder"][0]) / max(float(length) / 2, 1.0))
    return float(np.median(ratios)) if ratios else -np.inf
