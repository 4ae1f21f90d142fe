# SPDX-License-Identifier: Apache-2.0
"""People who move before a camera that stands still: of motion capture, or of `motions`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.rgbd.clothing import paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.rendering import PaintedMesh
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdStudio

FINE_RATE_HZ = 60.0  # of the motion, of which frames are every so many
FAST_M = 0.055  # per frame of the motion capture, mean motion of the joints: about 1.1 m/s
SEAT_M = (0.42, 0.42)  # of a chair


def draw_moving(
    studio: RgbdStudio,
    rng: np.random.Generator,
    seconds: float,
    rate: float,
    min_speed: float = FAST_M,
    lag: float = 0.0,
    noise: float = 5.0,
) -> Iterator[RgbdFrame]:
    """Yield the frames, at `rate` Hz, of one person in a motion of the motion capture.

    `lag` is by how many seconds colour images are later than depth images; `min_speed` as in `BodySource.draw_motion`.
    """
    fine = studio.source.draw_motion(rng, int(FINE_RATE_HZ * (seconds + lag)) + 1, FINE_RATE_HZ, min_speed)
    yield from watch(studio, rng, [fine], rate, lag, noise)


def watch(
    studio: RgbdStudio,
    rng: np.random.Generator,
    people: Sequence[Sequence[TrueBody]],
    rate: float,
    lag: float = 0.0,
    noise: float = 5.0,
    extra: Sequence[PaintedMesh] = (),
) -> Iterator[RgbdFrame]:
    """Yield the frames of people given at FINE_RATE_HZ, before a camera that sees all of them, and of `extra`.

    Raises:
        InputError: if the rate does not divide FINE_RATE_HZ.
    """
    step, late = FINE_RATE_HZ / rate, round(lag * FINE_RATE_HZ)
    if step != round(step):
        raise InputError(f"the rate is {rate:g} Hz; give one that divides {FINE_RATE_HZ:g} Hz")
    everywhere = [body for person in people for body in (person[0], person[len(person) // 2], person[-1])]
    angle = rng.uniform(-np.pi, np.pi)
    cameras = studio.place_cameras(rng, everywhere, "whole", np.array([np.cos(angle), np.sin(angle), 0.0]))
    room = [*studio.furnish(rng, everywhere, cameras), *extra]
    for index in range(0, min(len(person) for person in people) - late, round(step)):
        shown = [person[index + late] for person in people] if late else None
        yield studio.look(rng, [person[index] for person in people], room, cameras, noise, shown)


def make_chair(source: BodySource, body: TrueBody, rng: np.random.Generator) -> list[PaintedMesh]:
    """Return a chair under a person who sits, with its back behind them."""
    joint = dict(zip(source.joint_names, body.joints, strict=True))
    hips = (joint["left_hip"] + joint["right_hip"]) / 2
    ahead = (joint["left_knee"] + joint["right_knee"]) / 2 - hips
    ahead *= [1, 1, 0]
    ahead /= np.linalg.norm(ahead)
    frame = np.stack([ahead, np.array([-ahead[1], ahead[0], 0.0]), [0.0, 0.0, 1.0]], axis=1)
    middle = (hips + 0.08 * ahead) * [1, 1, 0]
    over = np.abs((body.vertices - middle) @ frame)[:, :2] < np.array(SEAT_M) / 2
    legs = np.isin(np.array(source.bone_names)[source.bone_of_vertex], ("Hips", "LeftUpLeg", "RightUpLeg"))
    top = float(body.vertices[over.all(axis=1) & legs, 2].min())
    back = middle - (SEAT_M[0] / 2 + 0.03) * ahead + np.array([0, 0, top + 0.2])
    boxes = [
        make_box(middle + np.array([0, 0, top - 0.03]), np.array([*SEAT_M, 0.06]), frame),
        make_box(middle + np.array([0, 0, top / 2 - 0.03]), np.array([0.08, 0.08, top - 0.06]), frame),
        make_box(back, np.array([0.04, SEAT_M[1], 0.4]), frame),
    ]
    return paint_surroundings(boxes, rng)
