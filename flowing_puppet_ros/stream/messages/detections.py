# SPDX-License-Identifier: Apache-2.0
"""Everyone's detections of people as keypoints: the messages of other detectors, told apart by their fields.

No package of these messages is needed: in a bag their definitions stand in the file, and a live node imports the type
that is published.

    flowing_puppet_msgs/PuppetArray   joints by name
    yolo_msgs/DetectionArray          COCO's 17 keypoints, numbered from 1; what was not found is missing
    zed_msgs/ObjectsStamped           BODY_18, 34 or 38 of the ZED SDK; (0, 0) is not found; one confidence a person
    hri_msgs/IdsList                  the bodies of REP-155, each with a Skeleton2D on a topic of its own
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17, HRI_18, ZED_FORMATS
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.messages.message_types import IDS_LIST, PUPPETS, SKELETON_2D
from flowing_puppet_ros.stream.messages.puppets import decode_puppet_joints

OTHER_DETECTIONS = ("yolo_msgs/msg/DetectionArray", "zed_msgs/msg/ObjectsStamped", IDS_LIST)
"""Types of detections beside our own."""
UNDERSTOOD = (
    f"understood are {PUPPETS}, {OTHER_DETECTIONS[0]}, {OTHER_DETECTIONS[1]} and {IDS_LIST} "
    f"(with a {SKELETON_2D} for each body)"
)
_SKELETON_NAME = "skeleton2d"
_MAX_NORMALISED = 1.5
"""Maximum distance of a normalised coordinate from the middle of the image; some detectors guess beyond its edge."""


@dataclass(frozen=True, slots=True, eq=False)
class BodySkeleton:
    """One Skeleton2D message and the id of its body, which only the topic tells."""

    id: str
    message: Any

    @property
    def header(self) -> Any:
        """The header of the message."""
        return self.message.header


@dataclass(slots=True, eq=False)
class BodyList:
    """The bodies of REP-155 in one image: the ids that are listed (None: no list yet) and the skeletons so far."""

    ids: frozenset[str] | None = None
    skeletons: dict[str, Any] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether the list and the skeletons of all its bodies are there."""
        return self.ids is not None and self.ids <= self.skeletons.keys()

    @property
    def found_bodies(self) -> list[tuple[str, Any]]:
        """Ids and skeletons, in an order that does not depend on that of arrival; InputError without any skeleton."""
        if self.ids and not self.skeletons:
            raise InputError(f"none of the {len(self.ids)} bodies in a list has a {_SKELETON_NAME} of its stamp")
        return sorted(self.skeletons.items())


def skeleton_topic(listing: str, identity: str) -> str:
    """Return the topic of a body's skeleton, beside the topic that lists the bodies."""
    return f"{listing.rpartition('/')[0]}/{identity}/{_SKELETON_NAME}"


def find_body_id(listing: str, topic: str) -> str:
    """Return the id of the body whose skeleton is on `topic`, or "" if that is not beside the list on `listing`."""
    identity = topic.rpartition("/")[0].rpartition("/")[2]
    return identity if topic == skeleton_topic(listing, identity) else ""


def name_body(listing: str, topic: str, message: Any) -> Any:
    """Return a message on `topic` with the id of its body, if it is a skeleton beside the list on `listing`."""
    identity = find_body_id(listing, topic)
    return BodySkeleton(identity, message) if identity else message


def collect_detections(present: Any, message: Any) -> Any:
    """Return the detections of a stamp after another message: all of them or, by REP-155, one more part of them."""
    if not isinstance(message, BodySkeleton) and not hasattr(message, "ids"):
        return message
    bodies = present if isinstance(present, BodyList) else BodyList()
    if isinstance(message, BodySkeleton):
        bodies.skeletons[message.id] = message.message
    else:
        bodies.ids = frozenset(message.ids)
    return bodies


def is_complete(detections: Any) -> bool:
    """Return whether all parts of a stamp's detections (None: none yet) have come."""
    return detections is not None and (not isinstance(detections, BodyList) or detections.is_complete)


def decode_detections(message: Any, size: tuple[int, int], report: Report) -> list[Keypoints]:
    """Return the people in a message of detections, in an image of `size` (width, height), as keypoints in pixels.

    People and keypoints that cannot be used are left out and counted, and each reason goes to the `report` once.
    InputError if this is no message of detections.
    """
    for name, decode in _DECODERS.items():
        if hasattr(message, name):
            return list(_decode_people(getattr(message, name), decode, size, report))
    raise InputError(f"messages of {_describe_type(message)} are not detections of people; {UNDERSTOOD}")


type _Decode = Callable[[Any, tuple[int, int], Report], Keypoints | None]


def _decode_people(items: Iterable[Any], decode: _Decode, size: tuple[int, int], report: Report) -> Iterable[Keypoints]:
    for item in items:
        try:
            person = decode(item, size, report)
            if person is not None:
                _check_inside(person, size)
                yield person
        except AttributeError as error:
            raise InputError(f"{_describe_type(item)} describes no person by keypoints; {UNDERSTOOD}") from error
        except InputError as error:
            report.counters["unusable people"] += 1
            report.warn(f"a detected person is left out: {error}")


def _describe_type(message: Any) -> str:
    kind = type(message)
    return str(getattr(kind, "__msgtype__", f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"))


def _check_inside(person: Keypoints, size: tuple[int, int]) -> None:
    """Raise an InputError if a person has keypoints, but none in the image."""
    known = person.xy[np.isfinite(person.xy).all(axis=1) & (person.confidence > 0)]
    if len(known) and not ((known >= -0.5) & (known <= np.array(size) - 0.5)).all(axis=1).any():
        width, height = size
        raise InputError(
            f"no keypoint is inside the image of {width}x{height} px; the detector must see an image of that size"
        )


def _decode_puppet(puppet: Any, size: tuple[int, int], report: Report) -> Keypoints:
    joints, confidence = decode_puppet_joints(puppet)
    return Keypoints(tuple(joint.name for joint in puppet.joints), joints, confidence, puppet.id)


def _decode_yolo(detection: Any, size: tuple[int, int], report: Report) -> Keypoints | None:
    """Return the person in a yolo_msgs/Detection; None if it is something else."""
    name, found = detection.class_name.strip().lower(), detection.keypoints.data
    if not name:
        raise InputError("a detection has no class_name, which must be 'person'")
    if name != "person":
        report.counters["detections of other classes"] += 1
        return None
    if not len(found):
        raise InputError("it has no keypoints; the network must be one for poses, such as yolo11n-pose")
    xy, confidence = np.full((len(COCO_17), 2), np.nan), np.zeros(len(COCO_17))
    for keypoint in found:
        index = keypoint.id - 1
        if index < 0:  # then all the others are counted from 0 too, and each would be taken for its neighbour
            raise InputError(f"it has a keypoint of id {keypoint.id}, but ids of COCO's 17 must begin with 1")
        if index >= len(COCO_17):
            report.counters["unusable keypoints"] += 1
            report.warn(f"a keypoint of id {keypoint.id} is left out: ids of COCO's keypoints are 1 to {len(COCO_17)}")
        elif keypoint.score > confidence[index]:
            xy[index] = keypoint.point.x, keypoint.point.y
            confidence[index] = keypoint.score
    return Keypoints(COCO_17, xy, confidence, str(detection.id))


def _decode_zed(item: Any, size: tuple[int, int], report: Report) -> Keypoints | None:
    """Return the person in a zed_msgs/Object; None if it has no skeleton.

    The wrapper's label is "Body_" and the id, so that the skeleton tells what is a person.
    """
    if not item.skeleton_available:
        report.counters["detections of other classes"] += 1
        return None
    names, share = ZED_FORMATS.get(int(item.body_format)), float(item.confidence) / 100
    if names is None:
        raise InputError(f"its body_format {item.body_format} is none of 0 (BODY_18), 1 (BODY_34) and 2 (BODY_38)")
    if not share > 0:
        raise InputError(f"its confidence is {item.confidence:g}, which must be 1 to 99")
    points = _to_rows([point.kp for point in item.skeleton_2d.keypoints][: len(names)], len(names), 2)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(points).all(axis=1) & (points >= 0).all(axis=1) & (points > 0).any(axis=1)
    xy = np.where(known[:, None], points, np.nan)
    tracked = item.tracking_available and item.label_id >= 0
    return Keypoints(names, xy, np.where(known, min(share, 1.0), 0.0), str(item.label_id) if tracked else "")


def _decode_body(body: tuple[str, Any], size: tuple[int, int], report: Report) -> Keypoints:
    """Return the person with an id and a hri_msgs/Skeleton2D, whose origin is the corner of the first pixel."""
    identity, message = body
    rows = _to_rows([(point.x, point.y, point.c) for point in message.skeleton], len(HRI_18), 3)
    known = np.isfinite(rows).all(axis=1) & (rows[:, 2] > 0)
    reach = np.abs(rows[known, :2] - 0.5).max(initial=0.0)
    if reach > _MAX_NORMALISED:
        raise InputError(
            f"a {_SKELETON_NAME} has coordinates up to {reach + 0.5:g}, which must be divided by the image's size"
        )
    xy = np.where(known[:, None], rows[:, :2] * size - 0.5, np.nan)
    return Keypoints(HRI_18, xy, np.where(known, rows[:, 2], 0.0), identity)


def _to_rows(values: list[Any], count: int, width: int) -> F64:
    """Return `values` as an array (count, width); InputError if they have another length."""
    try:
        rows = np.array(values, dtype=np.float64)
    except ValueError:
        rows = np.empty(0)
    if rows.shape != (count, width):
        raise InputError(f"it has {len(values)} keypoints where its format has {count} of {width} numbers each")
    return rows


_DECODERS: dict[str, _Decode] = {
    "puppets": _decode_puppet,
    "detections": _decode_yolo,
    "objects": _decode_zed,
    "found_bodies": _decode_body,
}
"""The field that lists the people of a message, and how to read one of them."""
