# SPDX-License-Identifier: Apache-2.0
"""Motions made of joint angles over time: a person who walks up and down, one who waves, one who sits and gestures.

Unlike motion capture they may be part of a recording that is passed on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.model import rotation

Angles = Mapping[str, tuple[float, float, float]]
"""Rotation vectors in degrees by bone, from the rest pose, as `learn.anny.poses.JOINT_LIMITS_DEG` describes them."""

ARM_DOWN_DEG = 38.0  # by which a hanging arm is lower than in the rest pose
STEP_HZ, WALK_LENGTH_M, WALK_SPEED_M_S = 0.9, 2.4, 0.9  # of whole cycles; of the line; along it
WAVE_HZ, NOD_HZ = 1.2, 0.5


def walk(seconds: float) -> Angles:
    """Return the angles of somebody who walks."""
    phase = 2 * np.pi * STEP_HZ * seconds
    angles: dict[str, tuple[float, float, float]] = {"Spine": (0.0, 3.0, 4 * np.sin(phase))}
    for side, sign, shift in (("Left", 1.0, 0.0), ("Right", -1.0, np.pi)):
        swing = np.sin(phase + shift)
        lifted = max(0.0, np.cos(phase + shift))
        angles[f"{side}UpLeg"] = (0.0, -5.0 - 24 * swing, 0.0)
        angles[f"{side}Leg"] = (0.0, 8.0 + 48 * lifted, 0.0)
        angles[f"{side}Foot"] = (0.0, 6 * swing, 0.0)
        angles[f"{side}Arm"] = (-sign * ARM_DOWN_DEG, 22 * swing, 0.0)
    return angles


def wave(seconds: float) -> Angles:
    """Return the angles of somebody who stands and waves with the right hand, swaying a little."""
    phase = 2 * np.pi * WAVE_HZ * seconds
    sway = 3 * np.sin(2 * np.pi * 0.3 * seconds)
    return {
        "LowerBack": (sway, 0.0, 0.0),
        "Head": (0.0, 4 * np.sin(2 * np.pi * NOD_HZ * seconds), 6.0),
        "LeftArm": (-ARM_DOWN_DEG, 0.0, 0.0),
        "RightArm": (-70.0 - 8 * np.sin(phase), -10.0, -10.0),
        "RightForeArm": (-55.0 - 25 * np.sin(phase), -30.0, -20.0),
    }


def sit(seconds: float) -> Angles:
    """Return the angles of somebody who sits and moves the lower arms as in talking."""
    phase = 2 * np.pi * 0.7 * seconds
    angles: dict[str, tuple[float, float, float]] = {
        "LowerBack": (0.0, 4 * np.sin(0.4 * phase), 0.0),
        "Head": (0.0, 5 * np.sin(0.8 * phase), 8 * np.sin(0.5 * phase)),
    }
    for side, sign, shift in (("Left", 1.0, 0.0), ("Right", -1.0, 1.9)):
        angles[f"{side}UpLeg"] = (sign * 6.0, -84.0, 0.0)
        angles[f"{side}Leg"] = (0.0, 82.0, 0.0)
        angles[f"{side}Arm"] = (-sign * ARM_DOWN_DEG, -22.0, 0.0)
        angles[f"{side}ForeArm"] = (0.0, -42.0 - 22 * np.sin(phase + shift), 0.0)
    return angles


MOTIONS: dict[str, Callable[[float], Angles]] = {"walking": walk, "waving": wave, "seated": sit}


def pose_motion(
    source: BodySource, name: str, rng: np.random.Generator, frames: int, rate: float, yaw: float = 0.0
) -> list[TrueBody]:
    """Return one random person in one of MOTIONS for `frames` frames at `rate` Hz, with the lowest vertex at z = 0.

    The person faces `yaw` rad from x; who walks goes up and down a line through x = y = 0 in that direction and turns
    at its ends.
    """
    person = source.draw_person(rng)
    bodies = []
    for index in range(frames):
        seconds = index / rate
        angles = {bone: np.radians(vector) for bone, vector in MOTIONS[name](seconds).items()}
        place, heading = _walked(seconds) if name == "walking" else (0.0, 0.0)
        turn = rotation.exp(np.array([0.0, 0.0, yaw + heading]))
        along = place * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        body = source.pose_person(person, angles, turn)
        bodies.append(body.translate(along - [0.0, 0.0, body.vertices[:, 2].min()]))
    return bodies


def _walked(seconds: float) -> tuple[float, float]:
    """Return the place along the line, metres, and the heading, rad, at a time; a turn takes half a second."""
    pass_s, turn_s = WALK_LENGTH_M / WALK_SPEED_M_S, 0.5
    passes, left = divmod(seconds, pass_s + turn_s)
    way = min(left, pass_s) * WALK_SPEED_M_S - WALK_LENGTH_M / 2
    turned = np.pi * (passes + max(0.0, left - pass_s) / turn_s)
    return (way if passes % 2 == 0 else -way), float(turned)
