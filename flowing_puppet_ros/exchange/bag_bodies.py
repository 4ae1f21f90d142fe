# SPDX-License-Identifier: Apache-2.0
"""Read the bodies of a replayed recording as motions, one for each person."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.exchange.motion import BodyMotion, make_motion
from flowing_puppet_ros.model.sp import POSE_WIDTH, BodyState, StitchedPuppet
from flowing_puppet_ros.stream.messages.geometry import rotation_matrix, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import BODIES

OPTICAL_UP, USUAL_UP = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
"""What is up in an optical frame of a level camera, and in any other frame (REP-103)."""


def read_bag_bodies(path: Path, up: Array | None = None, salvage: bool = False) -> list[BodyMotion]:
    """Read the people of a recording that `replay` or a node wrote, in the order of topics and ids.

    `up` (3,) is up in the bodies' frame; without it the frame's name tells. InputError if there are no bodies with
    parts.
    """
    found: dict[tuple[str, str], list[tuple[int, str, Any]]] = {}
    with open_bag(path, salvage) as bag:
        topics = [name for name, kind in bag.topics.items() if kind == BODIES and not name.endswith("/joints")]
        for record in bag.messages(topics) if topics else ():
            message = record.message
            for body in message.bodies:
                if len(body.parts):
                    frame = message.header.frame_id
                    found.setdefault((record.topic, body.id), []).append((stamp_ns(message), frame, body))
    if not found:
        raise InputError(f"{path} has no fitted bodies; `flowing-puppet replay` writes them beside its input")
    several = len({topic for topic, _ in found}) > 1
    return [
        _make_person(path, (topic.strip("/").replace("/", "-") if several else ""), identity, items, up)
        for (topic, identity), items in sorted(found.items(), key=lambda item: _sort_key(*item[0]))
    ]


def _sort_key(topic: str, identity: str) -> tuple[str, int, str]:
    """Return the key that sorts b2 before b10."""
    return topic, len(identity), identity


def _make_person(
    path: Path, topic: str, identity: str, items: list[tuple[int, str, Any]], up: Array | None
) -> BodyMotion:
    ordered = {stamp: (frame, body) for stamp, frame, body in sorted(items, key=lambda item: item[0])}
    frames = {frame for frame, _ in ordered.values()}
    if len(frames) > 1:
        raise InputError(f"{path} has {identity} in several frames ({', '.join(sorted(frames))}); replay it with one")
    stem = path.name.removesuffix(".mcap").removesuffix(".db3")
    name = "-".join(part for part in (stem, topic, identity) if part)
    bodies = [body for _, body in ordered.values()]
    model = StitchedPuppet.load(bodies[0].model)
    states = [_read_state(model, body) for body in bodies]
    axis = up if up is not None else np.array(OPTICAL_UP if "optical" in frames.pop() else USUAL_UP)
    vertices = np.stack([model.vertices(state) for state in states])
    arrays = {
        "vertices": vertices,
        "joints": np.stack([list(_read_joints(model, body)) for body in bodies]),
        "part_rotation": np.stack([state.rotation for state in states]),
        "part_center": np.stack([state.center for state in states]),
        "shape": np.stack([state.shape for state in states]),
        "confidence": np.array([body.confidence for body in bodies]),
        "reliable": np.array([bool(getattr(body, "reliable", True)) for body in bodies]),
    }
    return make_motion(name, identity, model, np.array(list(ordered)), arrays, axis)


def _read_state(model: StitchedPuppet, body: Any) -> BodyState:
    """Return the model's variables from the parts of a Body."""
    poses = [part.pose for part in body.parts]
    pose = np.zeros((len(model.tree), POSE_WIDTH))
    for row, part in zip(pose, body.parts, strict=True):
        row[: len(part.pose_coefficients)] = part.pose_coefficients
    return BodyState(
        np.array([[pose.position.x, pose.position.y, pose.position.z] for pose in poses]),
        np.stack([rotation_matrix([getattr(pose.orientation, axis) for axis in "xyzw"]) for pose in poses]),
        pose,
        np.array([part.shape_coefficients for part in body.parts], np.float64),
    )


def _read_joints(model: StitchedPuppet, body: Any) -> Iterator[tuple[float, float, float]]:
    """Yield the joints of a Body in the order of the model."""
    places = {joint.name: joint.position for joint in body.joints}
    for name in model.joint_names:
        if name not in places:
            raise InputError(f"the body {body.id} has no joint {name}; replay the recording with this version")
        yield places[name].x, places[name].y, places[name].z
