# SPDX-License-Identifier: Apache-2.0
"""People as REP-155 (ROS4HRI) publishes them: the list of ids, and topics for each of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8, Array
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.component import Output, Port
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import IMAGE, MessageFactory

_HRI = "hri_msgs/msg/"
LEAVES = {
    "roi": (_HRI + "NormalizedRegionOfInterest2D", "reliable"),
    "cropped": (IMAGE, "reliable"),
    "skeleton2d": (_HRI + "Skeleton2D", "reliable"),
    "joint_states": ("sensor_msgs/msg/JointState", "reliable"),
    "urdf": ("std_msgs/msg/String", "latched"),
}
"""Topics of a person below `bodies/<id>`: type and QoS."""
SKELETON = (
    *("nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow", "left_wrist"),
    *("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"),
    *("left_eye", "right_eye", "left_ear", "right_ear"),
)
"""Our joint for each value of the constants of hri_msgs/Skeleton2D: left comes first for eyes and ears."""
OUTSIDE = 0.1
"""What is left of the confidence of a joint outside the image, whose place is clipped."""


@dataclass(frozen=True)
class Ros4HriSettings(Settings):
    """Whether and where people are published by REP-155."""

    humans: bool = setting(False, "also publish people as REP-155 (ROS4HRI) says; one node a namespace")
    humans_namespace: str = setting("/humans", "namespace of the REP-155 topics")


class Ros4HriPublisher:
    """Makes the REP-155 messages of one component; each person's topics are `leaves` of `LEAVES`."""

    def __init__(self, settings: Ros4HriSettings, factory: MessageFactory, *leaves: str) -> None:
        """Publish nothing, and have no ports, unless the settings say so."""
        root = f"{settings.humans_namespace.rstrip('/')}/bodies"
        self.on = settings.humans
        self._factory = factory
        self._tracked = Port(f"{root}/tracked", _HRI + "IdsList")
        self._leaves = {leaf: Port(f"{root}/{{id}}/{leaf}", *LEAVES[leaf]) for leaf in leaves}
        self.ports = (self._tracked, *self._leaves.values()) if self.on else ()
        self._open: dict[str, set[str]] = {}

    def publish(self, header: Any, alive: Sequence[str], messages: Mapping[str, Mapping[str, Any]]) -> Output:
        """Return the ids of all who are `alive`, the messages (id -> leaf -> message), and the ends of lost people."""
        ids = {identity: name_component(identity) for identity in alive}
        outputs: Output = []
        for identity in [known for known in self._open if known not in ids.values()]:
            outputs += [(self._leaves[leaf].of(identity), None) for leaf in sorted(self._open.pop(identity))]
        outputs.append(
            (self._tracked.name, self._factory.make(_HRI + "IdsList", header=header, ids=list(ids.values())))
        )
        for identity, made in messages.items():
            self._open.setdefault(ids[identity], set()).update(made)
            outputs += [(self._leaves[leaf].of(ids[identity]), message) for leaf, message in made.items()]
        return outputs


def name_component(identity: str) -> str:
    """The id as a part of a topic's name: starts with a letter, then letters, digits and underscores."""
    text = re.sub(r"\W", "_", identity, flags=re.ASCII)
    return text if text[:1].isalpha() else f"p{text}"


def make_skeleton2d(
    factory: MessageFactory, header: Any, joints: Mapping[str, tuple[float, float, float]], size: tuple[int, int]
) -> Any:
    """Return the Skeleton2D of joints {name: (x, y in pixels, confidence)} in an image of `size` (width, height).

    Places are clipped to [0, 1], where the confidence falls; joints that are not there have confidence 0.
    """
    width, height = size
    point = _HRI + "NormalizedPointOfInterest2D"
    skeleton = [factory.make(point, x=0.0, y=0.0, c=0.0) for _ in SKELETON]
    for index, name in enumerate(SKELETON):
        x, y, confidence = joints.get(name, (np.nan, np.nan, 0.0))
        if not (np.isfinite([x, y]).all() and confidence > 0):
            continue
        # The message counts from the edge of the image, we from the centre of its first pixel.
        place = np.array([(x + 0.5) / width, (y + 0.5) / height])
        clipped = np.clip(place, 0.0, 1.0)
        sure = min(confidence, 1.0) * (1.0 if (place == clipped).all() else OUTSIDE)
        skeleton[index] = factory.make(point, x=clipped[0], y=clipped[1], c=sure)
    return factory.make(_HRI + "Skeleton2D", header=header, skeleton=skeleton)


def make_roi(factory: MessageFactory, header: Any, box: tuple[int, int, int, int], size: Any, confidence: float) -> Any:
    """Return the NormalizedRegionOfInterest2D of a `box` (left, top, right, bottom) in pixels, right and bottom out."""
    width, height = size
    left, top, right, bottom = box
    edges = {"xmin": left / width, "ymin": top / height, "xmax": right / width, "ymax": bottom / height}
    return factory.make(
        _HRI + "NormalizedRegionOfInterest2D", header=header, **edges, c=float(np.clip(confidence, 0, 1))
    )


def box_around(points: Array, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """Left, top, right and bottom (past the last pixel) around points (N,2) in an image; None when all are outside."""
    low = np.floor(np.nanmin(points, axis=0) + 0.5)
    high = np.ceil(np.nanmax(points, axis=0) + 0.5)
    (left, top), (right, bottom) = (np.clip(corner, 0, size).astype(int) for corner in (low, high))
    return (int(left), int(top), int(right), int(bottom)) if left < right and top < bottom else None


def image_humans(factory: MessageFactory, header: Any, image: U8, puppets: Any) -> dict[str, dict[str, Any]]:
    """Return id -> leaf -> message of the Puppets of an image (h,w,3) or (h,w): skeleton2d, roi and cropped."""
    size = (image.shape[1], image.shape[0])
    made: dict[str, dict[str, Any]] = {}
    for puppet in puppets:
        joints = {joint.name: (joint.x, joint.y, joint.confidence) for joint in puppet.joints}
        made[puppet.id] = {"skeleton2d": make_skeleton2d(factory, header, joints, size)}
        outlines = [np.asarray(part.contour, float).reshape(-1, 2) for part in puppet.parts]
        box = box_around(np.concatenate(outlines), size) if outlines else None
        if box is not None:
            left, top, right, bottom = box
            encoding = "rgb8" if image.ndim == 3 else "mono8"
            crop = np.ascontiguousarray(image[top:bottom, left:right])
            made[puppet.id]["roi"] = make_roi(factory, header, box, size, puppet.confidence)
            made[puppet.id]["cropped"] = make_image(factory, header, crop, encoding)
    return made
