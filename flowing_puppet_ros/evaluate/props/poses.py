# SPDX-License-Identifier: Apache-2.0
"""Poses of people who sit, crouch, bend, lift the arms, lean on an edge or carry a box, drawn by joint angles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.rgbd.motions import Angles
from flowing_puppet_ros.learn.anny.body import RestBody
from flowing_puppet_ros.model import rotation

type Arm = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Rotation vectors in degrees of the left upper and lower arm."""


def _hang(rng: np.random.Generator) -> Arm:
    return (rng.uniform(-38, -32), -rng.uniform(10, 30), 0.0), (0.0, -rng.uniform(15, 50), 0.0)


def _rest_on_arm(rng: np.random.Generator) -> Arm:
    return (rng.uniform(-32, -22), rng.uniform(-12, 5), 0.0), (0.0, -rng.uniform(55, 75), 0.0)


def _rest_on_desk(rng: np.random.Generator) -> Arm:
    return (rng.uniform(-38, -28), -rng.uniform(28, 45), 0.0), (0.0, -rng.uniform(35, 55), 0.0)


def _talk(rng: np.random.Generator) -> Arm:
    return (rng.uniform(-38, -20), -rng.uniform(20, 75), 0.0), (0.0, -rng.uniform(30, 90), rng.uniform(-20, 20))


def _raise(rng: np.random.Generator) -> Arm:
    return (rng.uniform(40, 80), -rng.uniform(0, 15), 10.0), (rng.uniform(30, 70), -30.0, 20.0)


def _lift(rng: np.random.Generator) -> Arm:
    return (rng.uniform(85, 130), rng.uniform(-25, 5), 0.0), (rng.uniform(-5, 40), -rng.uniform(0, 30), 0.0)


def _hold(rng: np.random.Generator) -> Arm:
    return (-38.0, -rng.uniform(5, 15), 0.0), (0.0, -rng.uniform(40, 50), -15.0)


ARMS: dict[str, tuple[Callable[[np.random.Generator], Arm], ...]] = {
    "free": (_hang, _hang, _talk, _talk, _raise),
    "rests": (_rest_on_arm, _rest_on_arm, _hang, _talk, _raise),
    "desk": (_rest_on_desk, _rest_on_desk, _talk, _raise),
    "box": (_hold,),
    "hanging": (_hang,),
    "lifted": (_lift,),
}
"""Ways in which each arm may be held, of people with nothing, with rests, and with a desk before them, of those who
hold a box, of those whose arms hang, and of those who lift them."""

type Leg = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Ranges in degrees: of the thigh ahead of straight down and to its side, and of the bent knee."""
LOW_LEGS: dict[str, tuple[tuple[tuple[float, float], Leg, Leg], ...]] = {
    "floor": (
        ((-15.0, 10.0), ((88.0, 98.0), (3.0, 18.0), (2.0, 18.0)), ((88.0, 98.0), (3.0, 18.0), (2.0, 18.0))),
        ((-10.0, 15.0), ((118.0, 124.0), (3.0, 18.0), (56.0, 66.0)), ((118.0, 124.0), (3.0, 18.0), (56.0, 66.0))),
        ((-5.0, 20.0), ((130.0, 136.0), (3.0, 18.0), (80.0, 92.0)), ((130.0, 136.0), (3.0, 18.0), (80.0, 92.0))),
        ((0.0, 25.0), ((140.0, 146.0), (3.0, 18.0), (100.0, 110.0)), ((140.0, 146.0), (3.0, 18.0), (100.0, 110.0))),
    ),
    "crouching": (
        ((15.0, 45.0), ((98.0, 118.0), (5.0, 25.0), (122.0, 138.0)), ((98.0, 118.0), (5.0, 25.0), (122.0, 138.0))),
        ((0.0, 30.0), ((80.0, 92.0), (3.0, 14.0), (80.0, 100.0)), ((-5.0, 12.0), (2.0, 12.0), (85.0, 100.0))),
        ((-2.0, 20.0), ((-3.0, 8.0), (2.0, 12.0), (85.0, 95.0)), ((-3.0, 8.0), (2.0, 12.0), (85.0, 95.0))),
        ((0.0, 25.0), ((60.0, 75.0), (2.0, 14.0), (130.0, 145.0)), ((60.0, 75.0), (2.0, 14.0), (130.0, 145.0))),
    ),
    "bent": (((40.0, 85.0), ((-3.0, 12.0), (0.0, 10.0), (0.0, 25.0)), ((-3.0, 12.0), (0.0, 10.0), (0.0, 25.0))),),
}
"""Ways to be low: how far the trunk leans ahead, degrees, and either leg. On the floor with straight legs and
with the knees up, less or more; squatting, on one knee, on both, and on the heels; bent at the hips."""


def draw_seated(source: BodySource, rng: np.random.Generator, arms: str, person: RestBody | None = None) -> TrueBody:
    """Draw somebody who sits and faces x, the lowest vertex at z = 0; ARMS has what the `arms` may do."""
    angles = _draw_upper(rng, arms, rng.uniform(-12, 14))
    bent = rng.uniform(70, 100)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[f"{side}UpLeg"] = (sign * rng.uniform(2, 14), -rng.uniform(78, 90), 0.0)
        angles[f"{side}Leg"] = (0.0, bent + rng.uniform(-12, 12), 0.0)
    return _pose(source, person or source.draw_person(rng), angles)


def draw_standing(source: BodySource, rng: np.random.Generator, arms: str, lean: float = 0.0) -> TrueBody:
    """Draw somebody who stands and faces x, the lowest vertex at z = 0.

    They `lean` back by so many degrees, the feet before the hips.
    """
    angles = _draw_upper(rng, arms, rng.uniform(-3, 5) + lean)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[f"{side}UpLeg"] = (sign * rng.uniform(0, 8), -rng.uniform(0, 6) - lean, 0.0)
        angles[f"{side}Leg"] = (0.0, rng.uniform(0, 10), 0.0)
    return _pose(source, source.draw_person(rng), angles)


def draw_low(source: BodySource, rng: np.random.Generator, way: str) -> TrueBody:
    """Draw somebody who faces x in one of LOW_LEGS, the lowest vertex at z = 0."""
    ways = LOW_LEGS[way]
    trunk, *legs = ways[int(rng.integers(len(ways)))]
    lean = rng.uniform(*trunk)
    angles = _draw_upper(rng, "free" if way != "bent" else "rests", rng.uniform(-5, 12))
    for side, sign, (thigh, aside, knee) in zip(("Left", "Right"), (1.0, -1.0), legs, strict=True):
        angles[f"{side}UpLeg"] = (sign * rng.uniform(*aside), -rng.uniform(*thigh) - lean, 0.0)
        angles[f"{side}Leg"] = (0.0, rng.uniform(*knee), 0.0)
    return _pose(source, source.draw_person(rng), angles, lean)


def draw_lifting(source: BodySource, rng: np.random.Generator) -> TrueBody:
    """Draw somebody who stands, faces x and lifts one arm or both over the head, the lowest vertex at z = 0."""
    angles = _draw_upper(rng, "lifted", rng.uniform(-5, 5))
    if rng.random() < 0.5:
        side, sign = (("Left", 1.0), ("Right", -1.0))[int(rng.integers(2))]
        for part, (x, y, z) in zip(("Arm", "ForeArm"), _hang(rng), strict=True):
            angles[f"{side}{part}"] = (sign * x, y, sign * z)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[f"{side}UpLeg"] = (sign * rng.uniform(0, 8), -rng.uniform(0, 6), 0.0)
        angles[f"{side}Leg"] = (0.0, rng.uniform(0, 10), 0.0)
    return _pose(source, source.draw_person(rng), angles)


def _draw_upper(rng: np.random.Generator, arms: str, bend: float) -> dict[str, tuple[float, float, float]]:
    """Draw the angles of trunk, head and arms; `bend` degrees is forwards."""
    ways = ARMS[arms]
    both = ways[int(rng.integers(len(ways)))](rng) if len(ways) == 1 else None
    angles = {
        "LowerBack": (rng.uniform(-5, 5), 0.7 * bend, rng.uniform(-8, 8)),
        "Spine1": (0.0, 0.3 * bend, rng.uniform(-5, 5)),
        "Head": (0.0, rng.uniform(-8, 15), rng.uniform(-25, 25)),
    }
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        upper, lower = both or ways[int(rng.integers(len(ways)))](rng)
        for part, (x, y, z) in (("Arm", upper), ("ForeArm", lower)):
            angles[f"{side}{part}"] = (sign * x, y, sign * z)
    return angles


def _pose(source: BodySource, person: RestBody, angles: Angles, lean: float = 0.0) -> TrueBody:
    turn = rotation.exp(np.radians([0.0, lean, 0.0]))
    body = source.pose_person(person, {bone: np.radians(vector) for bone, vector in angles.items()}, turn)
    return body.translate(np.array([0.0, 0.0, -body.vertices[:, 2].min()]))
