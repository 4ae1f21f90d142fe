# SPDX-License-Identifier: Apache-2.0
"""A room with somebody who waves and somebody who walks, as the colour and depth cameras of a robot see it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.evaluate.rgbd.rendering import PaintedMesh
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, RgbdStudio, look_along, make_pair, make_registered
from flowing_puppet_ros.model import rotation

RATE_HZ, FINE_RATE_HZ = 10.0, 20.0  # of the images, and of the motions that they are taken from
PLACES_M = ((0.6, 1.3, 0.0), (0.4, -0.6, 0.0))  # of who waves, and of the middle of the way of who walks
YAWS_RAD = (np.pi, 0.75 * np.pi)
LOOKED_AT_M = np.array([0.4, 0.1, 0.0])
START_M, END_M = np.array([-3.6, -0.5, 1.3]), np.array([-2.8, 0.5, 1.3])  # of the way of a robot that drives
SWAY_RAD, SWAY_HZ = np.radians(10.0), 0.4  # of its heading
PITCH_RAD, NOD_RAD, NOD_HZ = 0.12, np.radians(5.0), 0.7  # of its head
NOISE_PX = 5.0  # of the joints


@dataclass(frozen=True, slots=True)
class Sensing:
    """How the people are seen, and how the body fitter is told to see them.

    Attributes:
        drives: whether the robot drives, sways and nods; else it stands in the middle of its way.
        roll: radians, of the cameras about their axes.
        unregistered: whether the colour camera stands 5 cm beside the depth camera, with another size and lens.
        lag: seconds by which the colour images are later.
        fixed_frame: the body fitter's setting.
    """

    drives: bool = False
    roll: float = 0.0
    unregistered: bool = False
    lag: float = 0.0
    fixed_frame: str = ""


SENSINGS = {
    "still": Sensing(),
    "driving, fixed_frame": Sensing(drives=True, fixed_frame="map"),
    "driving": Sensing(drives=True),
    "tilted, fixed_frame": Sensing(roll=0.5, fixed_frame="map"),
    "upside down, fixed_frame": Sensing(roll=np.pi, fixed_frame="map"),
    "unregistered": Sensing(unregistered=True),
    "colour 50 ms later": Sensing(lag=0.05),
}
"""By the names under which they are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotMoment:
    """A depth image and the colour image that belongs to it, at a time in seconds."""

    seconds: float
    frame: RgbdFrame


class RobotView:
    """The same people in the same room for every way of seeing them."""

    def __init__(self, source: BodySource, seed: int, seconds: float) -> None:
        """Pose the people of a seed for some seconds."""
        self.source, self._seed = source, seed
        rng = np.random.default_rng([seed, 200])
        self.count = round(seconds * RATE_HZ)
        fine = round(self.count * FINE_RATE_HZ / RATE_HZ) + 2
        self._people = [
            [body.translate(np.array(place)) for body in pose_motion(source, name, rng, fine, FINE_RATE_HZ, yaw)]
            for name, place, yaw in zip(("waving", "walking"), PLACES_M, YAWS_RAD, strict=True)
        ]

    def look(self, sensing: Sensing) -> Iterator[RobotMoment]:
        """Yield what is seen, image after image."""
        studio = RgbdStudio(self.source, make_pair() if sensing.unregistered else make_registered())
        room = self._furnish(studio)
        rng = np.random.default_rng([self._seed, 300])
        late = round(sensing.lag * FINE_RATE_HZ)
        for number in range(self.count):
            seconds, index = number / RATE_HZ, round(number * FINE_RATE_HZ / RATE_HZ)
            shown = self._at(index + late) if late else None
            cameras = studio.cameras.place(*self.find_pose(sensing, seconds))
            yield RobotMoment(seconds, studio.look(rng, self._at(index), room, cameras, NOISE_PX, shown))

    def find_pose(self, sensing: Sensing, seconds: float) -> tuple[F64, F64]:
        """Return axes (3, 3), as columns, and place (3,) m of the depth camera at a time."""
        share = seconds * RATE_HZ / self.count if sensing.drives else 0.5
        eye = START_M + share * (END_M - START_M)
        ahead, pitch = LOOKED_AT_M - eye, PITCH_RAD
        if sensing.drives:
            sway = SWAY_RAD * np.sin(2 * np.pi * SWAY_HZ * seconds)
            ahead = rotation.exp(np.array([0.0, 0.0, sway])) @ ahead
            pitch += NOD_RAD * np.sin(2 * np.pi * NOD_HZ * seconds)
        return look_along(ahead, pitch, sensing.roll), eye

    def find_velocities(self, seconds: float, window: float) -> F64:
        """Return the mean velocities (P, 3) m/s of the hips during a `window` of seconds up to a time."""
        last, first = (round(each * FINE_RATE_HZ) for each in (seconds, seconds - window))
        rows = [self.source.joint_names.index(f"{side}_hip") for side in ("left", "right")]
        moved = [person[last].joints[rows].mean(axis=0) - person[first].joints[rows].mean(axis=0)
                 for person in self._people]  # fmt: skip
        return np.stack(moved) * FINE_RATE_HZ / (last - first)

    def _at(self, index: int) -> list[TrueBody]:
        return [person[index] for person in self._people]

    def _furnish(self, studio: RgbdStudio) -> list[PaintedMesh]:
        everywhere = [body for person in self._people for body in (person[0], person[len(person) // 2], person[-1])]
        cameras = studio.cameras.place(*self.find_pose(Sensing(), 0.0))
        return studio.furnish(np.random.default_rng([self._seed, 400]), everywhere, cameras)
