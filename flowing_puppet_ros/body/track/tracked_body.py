# SPDX-License-Identifier: Apache-2.0
"""A body with its id, and what its earlier places tell: whether it is new, and how fast it moves."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.model import rotation

VELOCITY_WINDOW_NS = 500_000_000
"""Time over which a velocity is measured: shorter ones show the noise of the fits, longer ones lag behind a turn."""
MAX_TURN_RAD_PER_S, MAX_SPEED_M_PER_S = 10.0, 12.0
"""Of a torso: somebody who turns on the spot takes half a second for it; a sprinter runs with 12 m/s."""
MAX_TURN_ERROR_RAD, MAX_PLACE_ERROR_M = 1.0, 0.3
"""By which a torso's pose may be wrong without being a jump."""
MIN_WALK_NS, MIN_WALK_M_PER_S, MAX_BACKWARD_COSINE = 300_000_000, 0.5, -0.5
"""Time and speed from which somebody walks, and cosine between where they go and face below which it is backwards."""
JUMP_CONFIDENCE = 0.3
"""Maximum confidence of a body that is where the person cannot have got since the body before."""


class TrackStatus(IntEnum):
    """How a body came to be; the values are those of the message Body."""

    TRACKED = 0
    HIDDEN = 1
    NEW = 2


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBody:
    """A body of a person with an `id`; `velocity` (3,) m/s of the torso, in the frame of the fit, 0 while unknown."""

    id: str
    fit: BodyFit
    status: TrackStatus = TrackStatus.NEW
    velocity: F64 = field(default_factory=lambda: np.zeros(3))

    def move(self, rotation: F64, translation: F64) -> TrackedBody:
        """Return it in a frame to which `rotation` (3, 3) and then `translation` (3,) m lead.

        The velocity turns with it, and stays that against the frame in which the person was tracked.
        """
        fit, state = self.fit, self.fit.state
        center, vertices, joints = (
            points @ rotation.T + translation for points in (state.center, fit.vertices, fit.joints)
        )
        state = replace(state, center=center, rotation=rotation @ state.rotation)
        moved = replace(fit, state=state, vertices=vertices, joints=joints)
        return replace(self, fit=moved, velocity=rotation @ self.velocity)


class TorsoMotion:
    """The places of a person's torso in the last half second."""

    def __init__(self) -> None:
        """Start without any."""
        self._places: deque[tuple[int, F64]] = deque()
        self._last: BodyFit | None = None

    def add(self, identity: str, stamp: int, fit: BodyFit, hidden: bool = False) -> TrackedBody:
        """Take the person's body at a stamp (ns) and return it with its status and velocity.

        The velocity is the slope of the line that fits the places best. A stamp that is not later than the last starts
        anew. After a jump that no person can make one of the two bodies is wrong: this one is not reliable, until the
        next agrees with it.
        """
        if self._places and stamp <= self._places[-1][0]:
            self._places.clear()
        known, before = bool(self._places), self._last
        self._last = fit
        if known and before is not None and _is_jump(before, fit, stamp - self._places[-1][0]):
            self._places.clear()
            fit = replace(fit, reliable=False, confidence=min(fit.confidence, JUMP_CONFIDENCE))
        while self._places and stamp - self._places[0][0] > VELOCITY_WINDOW_NS:
            self._places.popleft()
        self._places.append((stamp, fit.state.center[0].copy()))
        status = TrackStatus.HIDDEN if hidden else TrackStatus.TRACKED if known else TrackStatus.NEW
        return TrackedBody(identity, fit, status, self._measure_velocity())

    def walks_backwards(self) -> bool:
        """Return whether the torso has moved fast enough, for long enough, to where its back is."""
        if self._last is None or len(self._places) < 2:
            return False
        velocity, facing = self._measure_velocity()[:2], self._last.state.rotation[0, :2, 0]
        speed = float(np.linalg.norm(velocity))
        lasted = self._places[-1][0] - self._places[0][0] >= MIN_WALK_NS
        return lasted and speed > MIN_WALK_M_PER_S and bool(velocity @ facing < MAX_BACKWARD_COSINE * speed)

    def allow_turn(self) -> None:
        """Take the next body as it is, however much it is turned."""
        self._last = None

    def _measure_velocity(self) -> F64:
        if len(self._places) < 2:
            return np.zeros(3)
        seconds = 1e-9 * np.array([stamp - self._places[0][0] for stamp, _ in self._places])
        places = np.stack([place for _, place in self._places])
        apart = seconds - seconds.mean()
        return np.asarray(apart @ (places - places.mean(axis=0)) / (apart @ apart))


def _is_jump(before: BodyFit, after: BodyFit, nanoseconds: int) -> bool:
    """Return whether a torso cannot have moved or turned so far in that time."""
    seconds = 1e-9 * nanoseconds
    moved = np.linalg.norm(after.state.center[0] - before.state.center[0])
    turned = np.linalg.norm(rotation.log(before.state.rotation[0].T @ after.state.rotation[0]))
    return bool(
        moved > MAX_PLACE_ERROR_M + MAX_SPEED_M_PER_S * seconds
        or turned > MAX_TURN_ERROR_RAD + MAX_TURN_RAD_PER_S * seconds
    )
