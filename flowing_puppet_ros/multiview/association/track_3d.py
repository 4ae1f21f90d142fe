# SPDX-License-Identifier: Apache-2.0
"""What is remembered of a person in space: where the joints were and went, how large, what colours, whose tracks."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.exchange import ExchangedLimbs
from flowing_puppet_ros.multiview.triangulation import Expectation

_VELOCITY_SHARE = 0.3  # of the newest displacement in the smoothed velocity
_MAX_SPEED_M_S = 4.0
_MAX_EXTRAPOLATION_S = 0.5
_JOINT_NOISE_M, _JOINT_SPEED_M_S = 0.08, 2.0  # of a joint about where its body has carried it
_SIZES = 101  # in the running median of sizes
_MIN_SIZES = 10  # of a bone, before its length is known
_UPDATES_PER_LENGTH = 10  # after which the lengths of bones are measured again
_BONES = (
    *(("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip"), ("hip", "knee"), ("knee", "ankle")),
    *(("shoulder", "shoulder"), ("hip", "hip")),
)


@dataclass(slots=True, eq=False)
class PersonTrack3D:
    """A person in space.

    Attributes:
        id: unique in the run.
        joints: (J, 3) m where they were last placed, NaN where never.
        stamp: ns, when two views last agreed.
        velocity: (3,) m/s of the body.
        members: camera -> id in that camera's tracker, of the last set.
        votes: (camera, id in it) -> sets in which they were this person.
        colours: camera -> histogram of the torso.
        bones: pairs of joints whose distance does not change.
        exchanged: in which cameras left and right are exchanged.
    """

    id: str
    joints: F64
    stamp: int
    velocity: F64 = field(default_factory=lambda: np.zeros(3))
    members: dict[str, str] = field(default_factory=dict)
    votes: dict[tuple[str, str], int] = field(default_factory=dict)
    colours: dict[str, F64] = field(default_factory=dict)
    bones: Sequence[tuple[int, int]] = ()
    exchanged: ExchangedLimbs = field(default_factory=lambda: ExchangedLimbs(()))
    _sizes: deque[F64] = field(default_factory=lambda: deque(maxlen=_SIZES))
    _placed: F64 = field(init=False)  # (J,) ns, when each joint was last placed
    _lengths: F64 = field(init=False)  # (B,) m of the bones, NaN where unknown
    _updates: int = 0

    def __post_init__(self) -> None:
        """Take the joints as placed now."""
        self._lengths = np.full(len(self.bones), np.nan)
        self._placed = np.full(len(self.joints), float(self.stamp))

    @property
    def centre(self) -> F64:
        """Middle (3,) of the joints, m."""
        return np.asarray(np.nanmedian(self.joints, axis=0))

    def predict(self, stamp: int) -> F64:
        """Return the joints (J, 3) m expected at a stamp, ns."""
        seconds = min(max(0.0, (stamp - self.stamp) * 1e-9), _MAX_EXTRAPOLATION_S)
        return self.joints + self.velocity * seconds

    def expect(self, stamp: int) -> Expectation:
        """Return the joints expected at a stamp, ns, and the lengths of the bones as far as they are known."""
        seconds = np.maximum(0.0, (stamp - self._placed) * 1e-9)
        tolerance = _JOINT_NOISE_M + _JOINT_SPEED_M_S * seconds
        return Expectation(self.predict(stamp), tolerance, np.array(self.bones, np.int64).reshape(-1, 2), self._lengths)

    def update(self, stamp: int, joints: F64) -> None:
        """Take joints (J, 3) m, NaN where unknown: those keep moving with the body."""
        seconds = (stamp - self.stamp) * 1e-9
        known = np.isfinite(joints).all(axis=1)
        if 0 < seconds < _MAX_EXTRAPOLATION_S:
            both = known & np.isfinite(self.joints).all(axis=1)
            if both.any():
                newest = np.median((joints - self.joints)[both], axis=0) / seconds
                speed = float(np.linalg.norm(newest))
                newest *= min(1.0, _MAX_SPEED_M_S / max(speed, 1e-9))
                self.velocity = (1 - _VELOCITY_SHARE) * self.velocity + _VELOCITY_SHARE * newest
        else:
            self.velocity = np.zeros(3)
        self.joints = np.where(known[:, None], joints, self.predict(stamp))
        self._placed[known] = stamp
        self.stamp = stamp
        self._sizes.append(measure_sizes(joints, self.bones))
        self._updates += 1
        if self._updates % _UPDATES_PER_LENGTH == 0:
            sizes = np.stack(self._sizes)
            known = np.isfinite(sizes).sum(axis=0) >= _MIN_SIZES
            self._lengths[known] = np.nanmedian(sizes[:, known], axis=0)

    def relocate(self, stamp: int, joints: F64) -> None:
        """Start again somewhere else, as the same person."""
        self.joints, self.stamp, self.velocity = joints.copy(), stamp, np.zeros(3)
        self.members = {}
        self._placed[:] = stamp

    def compare_size(self, joints: F64) -> float:
        """Return the median relative difference of joint distances to a person with joints (J, 3) m; NaN if unknown."""
        if not self._sizes:
            return np.nan
        with np.errstate(all="ignore"):
            own = np.nanmedian(np.stack(self._sizes), axis=0)
            ratio = np.abs(np.log(measure_sizes(joints, self.bones) / own))
        ratio = ratio[np.isfinite(ratio)]
        return float(np.median(ratio)) if len(ratio) else np.nan


def find_bones(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return the pairs of joints, by their places in `names`, between which a bone or the stiff trunk lies."""
    place = {name: index for index, name in enumerate(names)}
    pairs = []
    for first, second in _BONES:
        for side in ("left", "right"):
            other = "right" if first == second else side
            ends = f"{side}_{first}", f"{other}_{second}"
            if ends[0] != ends[1] and all(end in place for end in ends):
                pairs.append((place[ends[0]], place[ends[1]]))
    return pairs


def measure_sizes(joints: F64, bones: Sequence[tuple[int, int]]) -> F64:
    """Return the lengths (B,) m of bones between joints (J, 3), NaN where unknown."""
    if not bones:
        return np.zeros(0)
    first, second = np.array(bones).T
    return np.asarray(np.linalg.norm(joints[first] - joints[second], axis=1))
