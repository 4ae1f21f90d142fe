# SPDX-License-Identifier: Apache-2.0
"""Bodies as navigation wants them: where people are, how fast they move, and the one to follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.stream.messages.geometry import make_point, make_pose, make_vector
from flowing_puppet_ros.stream.messages.message_types import PEOPLE, PERSON_POSE, MessageFactory


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPerson:
    """A person in the header's frame.

    Attributes:
        id: of the person.
        position: (3,) m, between the hips.
        rotation: (3, 3), x out of the chest and z towards the head.
        velocity: (3,) m/s.
        confidence: 0 to 1.
    """

    id: str
    position: F64
    rotation: F64
    velocity: F64
    confidence: float


def make_people(factory: MessageFactory, header: Any, people: Sequence[PlacedPerson]) -> Any:
    """Return the people_msgs/People of everybody in a cloud, named by their ids."""
    persons = [
        factory.make(
            "people_msgs/msg/Person",
            name=person.id,
            position=make_point(factory, person.position),
            velocity=make_point(factory, person.velocity),
            reliability=person.confidence,
            tagnames=[],
            tags=[],
        )
        for person in people
    ]
    return factory.make(PEOPLE, header=header, people=persons)


def make_person_pose(factory: MessageFactory, header: Any, people: Sequence[PlacedPerson], chosen: str) -> Any | None:
    """Return the PoseStamped of the `chosen` person or, if that is empty, of the nearest; None if there is none."""
    found = [person for person in people if chosen in ("", person.id)]
    if not found:
        return None
    person = min(found, key=lambda each: float(np.linalg.norm(each.position)))
    return factory.make(PERSON_POSE, header=header, pose=make_pose(factory, person.position, person.rotation))


def make_place(factory: MessageFactory, header: Any, person: PlacedPerson) -> dict[str, Any]:
    """Return the topics `position` and `velocity` of a person by REP-155."""
    twist = factory.make(
        "geometry_msgs/msg/Twist",
        linear=make_vector(factory, person.velocity),
        angular=make_vector(factory, np.zeros(3)),
    )
    return {
        "position": factory.make(
            "geometry_msgs/msg/PointStamped", header=header, point=make_point(factory, person.position)
        ),
        "velocity": factory.make("geometry_msgs/msg/TwistStamped", header=header, twist=twist),
    }
