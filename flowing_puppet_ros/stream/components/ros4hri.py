# SPDX-License-Identifier: Apache-2.0
"""People by REP-155 (ROS4HRI): the list of ids, and topics for each person."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8, Array
from flowing_puppet_ros.image.formats.skeletons import HRI_18
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.component import Output, Port
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import IMAGE, MessageFactory

_HRI = "hri_msgs/msg/"
PERSON_TOPICS = {
    "roi": (_HRI + "NormalizedRegionOfInterest2D", "reliable"),
    "cropped": (IMAGE, "reliable"),
    "skeleton2d": (_HRI + "Skeleton2D", "reliable"),
    "joint_states": ("sensor_msgs/msg/JointState", "reliable"),
    "urdf": ("std_msgs/msg/String", "latched"),
    "position": ("geometry_msgs/msg/PointStamped", "reliable"),
    "velocity": ("geometry_msgs/msg/TwistStamped", "reliable"),
}
"""Topics of a person below `bodies/<id>`: type and QoS."""
CLIPPED_CONFIDENCE = 0.1
"""Factor on the confidence of a joint outside the image, whose position is clipped."""


@dataclass(frozen=True)
class Ros4HriSettings(Settings):
    """Whether and where people are also published as REP-155 says."""

    publish: bool = setting(False, "also publish people as REP-155 (ROS4HRI) topics; at most one node per namespace")
    namespace: str = setting("/humans", "namespace of the REP-155 topics")


class Ros4HriPublisher:
    """Makes the REP-155 messages of one component; each person's topics are some of `PERSON_TOPICS`."""

    def __init__(self, settings: Ros4HriSettings, factory: MessageFactory, *topics: str) -> None:
        """Make the ports of `topics`, or none when the settings do not ask for them."""
        root = f"{settings.namespace.rstrip('/')}/bodies"
        self.enabled = settings.publish
        self._factory = factory
        self._tracked_port = Port(f"{root}/tracked", _HRI + "IdsList")
        self._person_ports = {topic: Port(f"{root}/{{id}}/{topic}", *PERSON_TOPICS[topic]) for topic in topics}
        self.ports = (self._tracked_port, *self._person_ports.values()) if self.enabled else ()
        self._open: dict[str, set[str]] = {}

    def make(self, header: Any, alive: Sequence[str], messages: Mapping[str, Mapping[str, Any]]) -> Output:
        """Return the ids of all `alive`, their messages (id -> topic -> message), and None for lost people's topics."""
        ids = {identity: to_name_component(identity) for identity in alive}
        outputs: Output = []
        for identity in [known for known in self._open if known not in ids.values()]:
            outputs += [
                (self._person_ports[topic].person_topic(identity), None) for topic in sorted(self._open.pop(identity))
            ]
        outputs.append(
            (self._tracked_port.name, self._factory.make(_HRI + "IdsList", header=header, ids=list(ids.values())))
        )
        for identity, by_topic in messages.items():
            self._open.setdefault(ids[identity], set()).update(by_topic)
            outputs += [
                (self._person_ports[topic].person_topic(ids[identity]), message) for topic, message in by_topic.items()
            ]
        return outputs


def to_name_component(identity: str) -> str:
    """Return the id as a component of a topic's name: a letter, then letters, digits and underscores."""
    text = re.sub(r"\W", "_", identity, flags=re.ASCII)
    return text if text[:1].isalpha() else f"p{text}"


def make_skeleton2d(
    factory: MessageFactory, header: Any, joints: Mapping[str, tuple[float, float, float]], size: tuple[int, int]
) -> Any:
    """Return the Skeleton2D of joints {name: (x, y in pixels, confidence)} in an image of `size` (width, height).

    Positions outside the image are clipped to [0, 1] with a lower confidence; missing joints have confidence 0.
    """
    width, height = size
    point = _HRI + "NormalizedPointOfInterest2D"
    skeleton = [factory.make(point, x=0.0, y=0.0, c=0.0) for _ in HRI_18]
    for index, name in enumerate(HRI_18):
        x, y, confidence = joints.get(name, (np.nan, np.nan, 0.0))
        if not (np.isfinite([x, y]).all() and confidence > 0):
            continue
        # The message's origin is the edge of the image, ours is the centre of its first pixel.
        position = np.array([(x + 0.5) / width, (y + 0.5) / height])
        clipped = np.clip(position, 0.0, 1.0)
        confidence = min(confidence, 1.0) * (1.0 if (position == clipped).all() else CLIPPED_CONFIDENCE)
        skeleton[index] = factory.make(point, x=clipped[0], y=clipped[1], c=confidence)
    return factory.make(_HRI + "Skeleton2D", header=header, skeleton=skeleton)


def make_roi(factory: MessageFactory, header: Any, box: tuple[int, int, int, int], size: Any, confidence: float) -> Any:
    """Return the NormalizedRegionOfInterest2D of `box` (left, top, right, bottom), pixels, the last two exclusive."""
    width, height = size
    left, top, right, bottom = box
    edges = {"xmin": left / width, "ymin": top / height, "xmax": right / width, "ymax": bottom / height}
    return factory.make(
        _HRI + "NormalizedRegionOfInterest2D", header=header, **edges, c=float(np.clip(confidence, 0, 1))
    )


def bounding_box(points: Array, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """Return left, top, right and bottom (exclusive) around `points` (N, 2) in an image; None if all are outside."""
    low = np.floor(np.nanmin(points, axis=0) + 0.5)
    high = np.ceil(np.nanmax(points, axis=0) + 0.5)
    (left, top), (right, bottom) = (np.clip(corner, 0, size).astype(int) for corner in (low, high))
    return (int(left), int(top), int(right), int(bottom)) if left < right and top < bottom else None


def make_image_messages(factory: MessageFactory, header: Any, image: U8, puppets: Any) -> dict[str, dict[str, Any]]:
    """Return id -> topic -> message of the Puppets in an `image` (H, W, 3) or (H, W): skeleton2d, roi and cropped."""
    size = (image.shape[1], image.shape[0])
    messages: dict[str, dict[str, Any]] = {}
    for puppet in puppets:
        joints = {joint.name: (joint.x, joint.y, joint.confidence) for joint in puppet.joints}
        messages[puppet.id] = {"skeleton2d": make_skeleton2d(factory, header, joints, size)}
        outlines = [np.asarray(part.contour, float).reshape(-1, 2) for part in puppet.parts]
        box = bounding_box(np.concatenate(outlines), size) if outlines else None
        if box is not None:
            left, top, right, bottom = box
            encoding = "rgb8" if image.ndim == 3 else "mono8"
            crop = np.ascontiguousarray(image[top:bottom, left:right])
            messages[puppet.id]["roi"] = make_roi(factory, header, box, size, puppet.confidence)
            messages[puppet.id]["cropped"] = make_image(factory, header, crop, encoding)
    return messages
