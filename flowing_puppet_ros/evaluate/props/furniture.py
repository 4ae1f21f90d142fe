# SPDX-License-Identifier: Apache-2.0
"""Furniture that fits the person who faces x on it, and things that somebody carries, made of boxes and prisms.

Metres; the floor is at z = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh, make_prism
from flowing_puppet_ros.model import rotation

CUSHION_M = 0.015
"""By which a soft seat gives way."""
BACK_GAP_M = (0.0, 0.06)
"""Between the back of somebody who sits and the back of the seat."""
TRUNK_BONES = ("Hips", "LowerBack", "Spine", "Spine1", "LHipJoint", "RHipJoint")
THIGH_BONES = ("Hips", "LHipJoint", "RHipJoint", "LeftUpLeg", "RightUpLeg")
WHEEL_SIDES = 20


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a person touches furniture.

    Attributes:
        middle: (2,) m between the hips.
        seat: height of the lowest part of the thighs near the hips, metres.
        lap: height of the highest part of the thighs.
        back: x of the rearmost part of the trunk.
        belly: x of the foremost part of the trunk.
        half_width: of the hips, from side to side.
    """

    middle: F64
    seat: float
    lap: float
    back: float
    belly: float
    half_width: float

    @classmethod
    def of(cls, source: BodySource, body: TrueBody) -> Place:
        """Measure a person who faces x."""
        joint = locate(source, body)
        middle = (joint["left_hip"] + joint["right_hip"])[:2] / 2
        names = np.array(source.bone_names)[source.bone_of_vertex]
        trunk, thighs = (body.vertices[np.isin(names, bones)] for bones in (TRUNK_BONES, THIGH_BONES))
        near = thighs[np.abs(thighs[:, 0] - middle[0]) < 0.25]
        return cls(
            middle,
            float(near[:, 2].min()),
            float(body.vertices[np.isin(names, THIGH_BONES[3:]), 2].max()),
            float(trunk[:, 0].min()),
            float(trunk[:, 0].max()),
            float(np.abs(near[:, 1] - middle[1]).max()),
        )


def locate(source: BodySource, body: TrueBody) -> Mapping[str, F64]:
    """Return the joints (3,) m of a person by name."""
    return dict(zip(source.joint_names, body.joints, strict=True))


def span(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """Return the box between two corners (3,) m."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    return make_box((a + b) / 2, b - a, np.eye(3))


def _lean(low: float, high: float, x: float, half: float, y: float, thick: float, tilt: float) -> Mesh:
    """Return a seat's back with its front at `x` at its lower end, from z `low` to `high`, tilted back by `tilt`."""
    frame = rotation.exp(np.array([0.0, -tilt, 0.0]))
    length = high - low
    middle = np.array([x, y, low]) + frame @ np.array([-thick / 2, 0.0, length / 2])
    return make_box(middle, np.array([thick, 2 * half, length]), frame)


def make_stool(place: Place, rng: np.random.Generator) -> list[Mesh]:
    """Make a stool with a round seat."""
    radius, (x, y) = rng.uniform(0.17, 0.22), place.middle + np.array([0.08, 0.0])
    return [
        make_prism((x, y), radius, place.seat - 0.05, place.seat),
        make_prism((x, y), 0.03, 0.03, place.seat - 0.05),
        make_prism((x, y), 0.2, 0.0, 0.03),
    ]


def make_chair(place: Place, rng: np.random.Generator) -> list[Mesh]:
    """Make an office chair, with armrests or without, or a chair with four legs."""
    half, (x, y), top = rng.uniform(0.22, 0.26), place.middle, place.seat + CUSHION_M
    back = place.back - rng.uniform(*BACK_GAP_M)
    front = x + rng.uniform(0.28, 0.36)
    meshes = [
        span((back, y - half, top - 0.08), (front, y + half, top)),
        _lean(top + rng.uniform(0.0, 0.2), top + rng.uniform(0.42, 0.7), back, half - 0.02, y, 0.06,
              rng.uniform(0.0, 0.2)),
    ]  # fmt: skip
    if rng.random() < 0.5:
        for sign in (-1, 1):
            for at in (back + 0.03, front - 0.05):
                foot = y + sign * (half - 0.03)
                meshes.append(span((at - 0.02, foot - 0.02, 0.0), (at + 0.02, foot + 0.02, top - 0.08)))
        return meshes
    meshes.append(make_prism(((back + front) / 2, y), 0.035, 0.08, top - 0.08))
    for turn in (0.2, 0.2 + np.pi / 2):
        foot = np.array([(back + front) / 2, y, 0.06])
        meshes.append(make_box(foot, np.array([0.6, 0.06, 0.06]), rotation.exp(np.array([0.0, 0.0, turn]))))
    if rng.random() < 0.6:
        aside, high = max(half, place.half_width) + 0.04, top + rng.uniform(0.18, 0.24)
        for sign in (-1, 1):
            meshes.append(
                span((back + 0.08, y + sign * aside - 0.03, high - 0.03), (front - 0.1, y + sign * aside + 0.03, high))
            )
            meshes.append(
                span((x + 0.05, y + sign * aside - 0.02, top - 0.05), (x + 0.1, y + sign * aside + 0.02, high))
            )
    return meshes


def make_sofa(places: Sequence[Place], rng: np.random.Generator, wide: bool) -> list[Mesh]:
    """Make an armchair, or a `wide` sofa, on which everybody sits whose `places` are given."""
    left, right = (sign * max(sign * place.middle[1] + place.half_width for place in places) for sign in (1, -1))
    room = rng.uniform(0.2, 0.6, 2) if wide else np.full(2, rng.uniform(0.03, 0.08))
    left, right = left + room[0], right - room[1]
    half, y = (left - right) / 2, (left + right) / 2
    back = min(place.back for place in places) - rng.uniform(*BACK_GAP_M)
    top = float(np.mean([place.seat for place in places])) + 2 * CUSHION_M
    front = max(place.middle[0] for place in places) + rng.uniform(0.3, 0.42)
    arm, rest = rng.uniform(0.1, 0.2), top + rng.uniform(0.15, 0.24)
    return [
        span((back - 0.2, right, 0.04), (front, left, top)),
        _lean(top - 0.02, top + rng.uniform(0.4, 0.65), back, half, y, 0.2, rng.uniform(0.05, 0.25)),
        span((back - 0.15, left, 0.0), (front, left + arm, rest)),
        span((back - 0.15, right - arm, 0.0), (front, right, rest)),
    ]


def make_desk(place: Place, rng: np.random.Generator) -> list[Mesh]:
    """Make a desk whose edge is close before somebody who sits."""
    near, half, top = place.belly + rng.uniform(0.03, 0.15), rng.uniform(0.6, 0.9), place.lap + rng.uniform(0.04, 0.1)
    far, y = near + rng.uniform(0.6, 0.8), place.middle[1] + rng.uniform(-0.2, 0.2)
    meshes = [span((near, y - half, top - 0.03), (far, y + half, top))]
    for sign in (-1, 1):
        side = y + sign * (half - 0.02)
        meshes.append(span((near + 0.03, side - 0.02, 0.0), (far - 0.03, side + 0.02, top - 0.03)))
    if rng.random() < 0.5:
        screen = y + rng.uniform(-0.25, 0.25)
        meshes.append(span((far - 0.2, screen - 0.27, top + 0.1), (far - 0.16, screen + 0.27, top + 0.43)))
    return meshes


def make_wheelchair(place: Place, rng: np.random.Generator) -> list[Mesh]:
    """Make a wheelchair: seat, back, handles, armrests, two large wheels and two small ones, a footrest."""
    half, (x, y), top = place.half_width + 0.03, place.middle, place.seat + CUSHION_M
    back, front = place.back - rng.uniform(0.0, 0.03), place.middle[0] + 0.32
    meshes = [
        span((back, y - half, top - 0.04), (front, y + half, top)),
        span((back - 0.03, y - half, top), (back, y + half, top + rng.uniform(0.35, 0.45))),
        span((front, y - half, 0.05), (front + 0.25, y + half, 0.08)),
    ]
    for sign in (-1, 1):
        side = y + sign * (half + 0.05)
        meshes += [
            _make_wheel(x - 0.08, side, 0.3),
            _make_wheel(front, y + sign * half, 0.09),
            span((back, side - 0.03, top + 0.2), (front - 0.1, side + 0.03, top + 0.23)),
            span((back - 0.15, side - 0.02, top + 0.38), (back, side + 0.02, top + 0.42)),
        ]
    return meshes


def _make_wheel(x: float, y: float, radius: float) -> Mesh:
    """Return a wheel that stands on the floor and rolls along x."""
    vertices, triangles = make_prism((0.0, 0.0), radius, -0.015, 0.015, WHEEL_SIDES)
    return vertices @ rotation.exp(np.array([np.pi / 2, 0.0, 0.0])).T + [x, y, radius], triangles


def make_table(place: Place, rng: np.random.Generator) -> list[Mesh]:
    """Make a table on whose edge somebody leans who stands."""
    edge, half = place.back + rng.uniform(0.0, 0.03), rng.uniform(0.5, 0.9)
    top = place.lap - rng.uniform(0.1, 0.2)
    return [
        span((edge - 0.7, -half, top - 0.04), (edge, half, top)),
        span((edge - 0.65, -half + 0.05, 0.0), (edge - 0.6, half - 0.05, top - 0.04)),
    ]


def make_held_box(source: BodySource, body: TrueBody, rng: np.random.Generator) -> list[Mesh]:
    """Make a box between somebody's hands."""
    joint = locate(source, body)
    hands = np.stack([joint["left_hand"], joint["right_hand"]])
    wide, deep, high = abs(hands[0, 1] - hands[1, 1]) - 0.04, rng.uniform(0.2, 0.35), rng.uniform(0.2, 0.35)
    near = Place.of(source, body).belly + 0.02
    middle = np.array([near + deep / 2, hands[:, 1].mean(), hands[:, 2].mean()])
    return [make_box(middle, np.array([deep, wide, high]), np.eye(3))]


def make_backpack(source: BodySource, body: TrueBody, rng: np.random.Generator) -> list[Mesh]:
    """Make a backpack on somebody's back."""
    joint = locate(source, body)
    neck, deep, back = joint["neck"], rng.uniform(0.14, 0.24), Place.of(source, body).back + 0.03
    high = rng.uniform(0.4, 0.52)
    middle = np.array([back - deep / 2, neck[1], neck[2] - 0.02 - high / 2])
    return [make_box(middle, np.array([deep, rng.uniform(0.28, 0.36), high]), np.eye(3))]


def make_bag(source: BodySource, body: TrueBody, rng: np.random.Generator) -> list[Mesh]:
    """Make a bag that hangs from one hand."""
    hand = locate(source, body)[f"{('left', 'right')[int(rng.integers(2))]}_hand"]
    size = np.array([rng.uniform(0.3, 0.45), rng.uniform(0.1, 0.18), rng.uniform(0.28, 0.4)])
    handle = span(hand - np.array([0.1, 0.015, 0.1]), hand - np.array([-0.1, -0.015, 0.07]))
    return [make_box(hand - [0.0, 0.0, 0.1 + size[2] / 2], size, np.eye(3)), handle]
