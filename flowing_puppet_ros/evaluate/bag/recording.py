# SPDX-License-Identifier: Apache-2.0
"""Read puppets, detections, cameras and bodies from a replay's bags for comparison.

Topics are found by type and namespace: the topics of a camera share the namespace of its images; PuppetArrays on topics
named `detections` come from a detector, all others from the tracker.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.depth_topics import find_info, holds_depth, image_encoding, read_size
from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.joints import LIMB_JOINTS, name_points
from flowing_puppet_ros.image.formats.keypoints import normalise_name
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import triangulate
from flowing_puppet_ros.stream.component import base_topic
from flowing_puppet_ros.stream.messages.depth import make_depth_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import (
    BODIES,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    MESH,
    POINT_CLOUD,
    PUPPETS,
    TRANSFORMS,
)

RESULT_LEAVES = ("overlay", "part_labels", "person_masks", "preview", "hull", "body_vertices")
"""Last words of the image and cloud topics that hold results rather than sensor data."""

Joints = dict[str, np.ndarray]


@dataclass(slots=True, eq=False)
class CameraRecord:
    """The recording of one camera: messages of the people at each image stamp (ns), largest puppets first."""

    namespace: str
    image_topic: str = ""
    frame_id: str = ""
    info: Any = None
    camera: Camera | None = None
    puppets: dict[int, list[Any]] = field(default_factory=dict)
    detections: dict[int, list[Any]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The namespace without leading and trailing slashes, or "camera"."""
        return self.namespace.strip("/") or "camera"


@dataclass(slots=True, eq=False)
class Recording:
    """The contents of a replay's input and output bags without images and clouds; keys are stamps in ns."""

    cameras: dict[str, CameraRecord] = field(default_factory=dict)
    bodies: dict[int, list[Any]] = field(default_factory=dict)
    triangles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    body_frame: str = ""
    cloud_topics: dict[str, str] = field(default_factory=dict)
    """Topics by kind: "hull", "body_vertices", and the input's "points" or "depth"."""
    counts: dict[str, int] = field(default_factory=dict)  # messages on each topic of the output bag

    @property
    def start(self) -> int:
        """The earliest stamp, ns; 0 without any."""
        stamps = [*self.bodies]
        for camera in self.cameras.values():
            stamps += [*camera.puppets, *camera.detections]
        return min(stamps, default=0)


def namespace(topic: str) -> str:
    """Return the topic without its last word and without the suffix of a transport."""
    return base_topic(topic).rpartition("/")[0]


def read_recording(input_bag: Bag, output_bag: Bag) -> Recording:
    """Read a replay's input and output bag; what both hold is taken from the output.

    InputError if the output has neither puppets nor bodies.
    """
    recording = Recording(counts={name: topic.count for name, topic in output_bag.details.items()})
    recorded = {_role(name, kind) for name, kind in output_bag.topics.items()}
    if not recorded & {PUPPETS, BODIES}:
        names = ", ".join(sorted(output_bag.topics)) or "none"
        raise InputError(f"{output_bag.path} has neither puppets nor bodies; its topics are {names}")
    frames = FrameTree()
    input_roles = {CAMERA_INFO, TRANSFORMS, "detections"} - recorded
    for bag, roles in ((output_bag, recorded - {""}), (input_bag, input_roles)):
        wanted = [name for name, kind in bag.topics.items() if _role(name, kind) in roles]
        for record in bag.messages(wanted):
            # The replay has warned about unusable messages; report the rest.
            with suppress(InputError):
                _store_message(recording, frames, record.topic, record.type, record.message)
    for name, kind in output_bag.topics.items():
        if kind == POINT_CLOUD and leaf(name) in ("hull", "body_vertices"):
            recording.cloud_topics[leaf(name)] = name
    for name, kind in input_bag.topics.items():
        if kind == POINT_CLOUD and leaf(name) not in RESULT_LEAVES:
            recording.cloud_topics.setdefault("points", name)
    _assign_image_topics(recording, input_bag)
    _calibrate_cameras(recording, frames)
    return recording


def leaf(topic: str) -> str:
    """Return the last word of a topic without the suffix of a transport."""
    return base_topic(topic).rpartition("/")[2]


def _role(topic: str, kind: str) -> str:
    """Return the role of a topic: its type, or "detections"; empty if it is not read."""
    if kind == PUPPETS and leaf(topic) == "detections":
        return "detections"
    unread = (kind == BODIES and leaf(topic) == "joints") or (kind == TRANSFORMS and leaf(topic) != "tf_static")
    return kind if kind in (CAMERA_INFO, TRANSFORMS, PUPPETS, BODIES, MESH) and not unread else ""


def _store_message(recording: Recording, frames: FrameTree, topic: str, kind: str, message: Any) -> None:
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
        if role == CAMERA_INFO:
            camera.info = message
        elif role == PUPPETS:
            camera.puppets[stamp_ns(message)] = sorted(message.puppets, key=lambda one: (-one.scale, one.id))
        else:
            camera.detections[stamp_ns(message)] = list(message.puppets)
        camera.frame_id = camera.frame_id or message.header.frame_id


def _assign_image_topics(recording: Recording, input_bag: Bag) -> None:
    """Assign to each camera the image topic of its namespace, or else the one whose first image has its frame.

    Depth images in the frame of the bodies are the input of the fit.
    """
    topics = [
        name
        for name, topic in input_bag.details.items()
        if topic.type in (IMAGE, COMPRESSED_IMAGE) and topic.count and leaf(name) not in RESULT_LEAVES
    ]
    by_frame: dict[str, str] = {}
    for topic in list(topics):
        with suppress(InputError):
            image = next(input_bag.messages([topic])).message
            frame = image.header.frame_id
            if not holds_depth(topic, image_encoding(topic, image)):
                by_frame.setdefault(frame, topic)
                continue
            topics.remove(topic)
            if recording.bodies and frame == recording.body_frame:
                recording.cloud_topics.setdefault("depth", topic)
    for camera in recording.cameras.values():
        same = [topic for topic in topics if namespace(topic) == camera.namespace]
        camera.image_topic = min(same) if same else by_frame.get(camera.frame_id, "")


def sensor_cloud_topics(recording: Recording) -> list[str]:
    """Return the input topics that bodies were fitted to: points, or else depth images."""
    return [recording.cloud_topics[name] for name in ("points", "depth") if name in recording.cloud_topics][:1]


def to_cloud(recording: Recording, topic: str, message: Any) -> Any:
    """Convert a message on a sensor's cloud topic to PointCloud2; InputError if a depth image cannot be used."""
    if topic != recording.cloud_topics.get("depth"):
        return message
    cameras = {f"{name}/camera_info": camera.info for name, camera in recording.cameras.items()}
    infos = {name: info for name, info in cameras.items() if info is not None}
    info = find_info(base_topic(topic), message.header.frame_id, read_size(message), infos)
    return make_depth_cloud(BagMessageFactory(), message, infos.get(info))


def _calibrate_cameras(recording: Recording, frames: FrameTree) -> None:
    """Calibrate the cameras whose frame is connected to the bodies' frame (or to a common root)."""
    for record in recording.cameras.values():
        if record.info is None:
            continue
        frame = record.info.header.frame_id
        info = record.info
        # Without calibration or pose, everything but the reprojection can still be shown.
        with suppress(InputError):
            pose = frames.lookup_pose(recording.body_frame or frames.find_root(frame), frame)
            if pose is None:
                continue
            translation, rotation = pose
            record.camera = Camera.from_info(
                info.k, info.d, info.width, info.height, rotation, translation, info.distortion_model
            )


def puppet_joints(person: Any, min_confidence: float = 0.0) -> Joints:
    """Return the known joints {our name: (2,)} px of a Puppet message, those of more than a confidence."""
    points = np.array([(joint.x, joint.y) for joint in person.joints], float).reshape(-1, 2)
    seen = [k for k, joint in enumerate(person.joints) if joint.confidence > min_confidence]
    return name_points([person.joints[k].name for k in seen], points[seen])


def body_joints(body: Any) -> Joints:
    """Return the known joints {our name: (3,)} m of a Body message."""
    points = np.array([(j.position.x, j.position.y, j.position.z) for j in body.joints], float).reshape(-1, 3)
    return name_points([joint.name for joint in body.joints], points)


def find_nearest(joints: Joints, candidates: Iterable[Joints]) -> int | None:
    """Return the index of the candidate whose common joints are nearest on average; None if none has a common joint."""
    best, min_distance = None, np.inf
    for index, candidate in enumerate(candidates):
        common = [name for name in joints if name in candidate]
        if common:
            distance = float(np.mean([np.linalg.norm(joints[name] - candidate[name]) for name in common]))
            if distance < min_distance:
                best, min_distance = index, distance
    return best


def match_track_to_detections(camera: CameraRecord) -> tuple[dict[int, Joints], dict[int, Joints]]:
    """Match the largest puppet of each stamp with the nearest detection; return both as {stamp: joints}."""
    frames = {stamp: puppet_joints(people[0]) for stamp, people in camera.puppets.items() if people}
    reference: dict[int, Joints] = {}
    for stamp, joints in frames.items():
        candidates = [puppet_joints(person) for person in camera.detections.get(stamp, ())]
        index = find_nearest(joints, candidates)
        if index is not None:
            reference[stamp] = candidates[index]
    return frames, reference


def triangulate_detections(recording: Recording, bodies: Mapping[int, Joints]) -> dict[int, Joints]:
    """Triangulate limb joints {stamp: {name: (3,)}} in metres from the detections of the person of each body.

    If a camera detected several people, the one nearest to the reprojected body counts. Stamps at which fewer than two
    calibrated cameras detected a person are left out.
    """
    calibrated = [(record, record.camera) for record in recording.cameras.values() if record.camera is not None]
    found: dict[int, Joints] = {}
    for stamp, body in bodies.items():
        seen = [(record, camera) for record, camera in calibrated if record.detections.get(stamp)]
        if len(seen) < 2 or not body:
            continue
        views = [_select_detection(record.detections[stamp], camera, body) for record, camera in seen]
        points, confidence = (np.stack(column) for column in zip(*views, strict=True))
        joints, _ = triangulate([camera for _, camera in seen], points, confidence)
        found[stamp] = name_points(LIMB_JOINTS, joints)
    return found


def _select_detection(people: list[Any], camera: Camera, body: Joints) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (12, 2) and confidences (12,) of the limb joints of the person nearest to the projected body."""
    pixels, _ = camera.project(np.stack(list(body.values())))
    expected = name_points(list(body), pixels)
    chosen = people[find_nearest(expected, map(puppet_joints, people)) or 0]
    points, confidence = np.full((len(LIMB_JOINTS), 2), np.nan), np.zeros(len(LIMB_JOINTS))
    for joint in chosen.joints:
        name = normalise_name(joint.name)
        if name in LIMB_JOINTS:
            points[LIMB_JOINTS.index(name)] = joint.x, joint.y
            confidence[LIMB_JOINTS.index(name)] = joint.confidence
    return points, confidence


def select_first_bodies(recording: Recording) -> dict[int, Any]:
    """Return the first body of each stamp that has one; people whom colour alone shows come last."""
    return {
        stamp: next((body for body in bodies if body.parts), bodies[0])
        for stamp, bodies in recording.bodies.items()
        if bodies
    }


def frontality(people: Mapping[int, list[Any]]) -> float:
    """Return how frontally a camera sees the first person: median of signed shoulder width over torso length.

    About 0.6 from the front, 0 from the side, negative from behind; -inf if the four joints are never known.
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
