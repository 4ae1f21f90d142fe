# SPDX-License-Identifier: Apache-2.0
"""Random poses of the Anny body: frames of the CMU motion capture with noise, or joint limits alone.

The motion capture (http://mocap.cs.cmu.edu, created with funding from NSF EIA-0196217) is read from an .npz with one
(T,117) array a sequence: root translation, then exponential maps of 38 joints whose matrices act on row vectors.
"""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.model import rotation

MOCAP_JOINTS = 38
MOCAP_PARENTS = (
    *(-1, 0, 1, 2, 3, 4, 5, 0, 7, 8, 9, 10, 11, 0, 13, 14, 15, 16, 17, 18),
    *(15, 20, 21, 22, 23, 24, 25, 23, 27, 15, 29, 30, 31, 32, 33, 34, 32, 36),
)
MOCAP_OF_BONE = {
    **{"Hips": 0, "LHipJoint": 1, "LeftUpLeg": 2, "LeftLeg": 3, "LeftFoot": 4, "LeftToeBase": 5},
    **{"RHipJoint": 7, "RightUpLeg": 8, "RightLeg": 9, "RightFoot": 10, "RightToeBase": 11},
    **{"LowerBack": 13, "Spine": 14, "Spine1": 15, "Neck": 16, "Neck1": 17, "Head": 18},
    **{"LeftShoulder": 20, "LeftArm": 21, "LeftForeArm": 22, "LeftHand": 23, "LeftFingerBase": 24},
    **{"RightShoulder": 29, "RightArm": 30, "RightForeArm": 31, "RightHand": 32, "RightFingerBase": 33},
}
# Rows map the axes of the motion capture (x left, y up, z forward) to ours.
FROM_MOCAP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# Rest directions of the motion-capture skeleton in our axes: it stands in a T-pose with its legs 20 degrees apart.
# Its elbow bends about T_HINGE.
T_ARM, T_LEG = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.342, -0.94])
T_HINGE = np.array([0.5, 0.0, -0.866])

# Low and high rotation-vector components in degrees, from the rest pose, in body axes, for bones of the left side and
# the midline: x positive lifts a left limb sideways, y positive bends forward or swings a hanging limb back.
LIMITS = {
    "LowerBack": ((-10, -10, -12), (10, 25, 12)),
    "Spine": ((-10, -8, -12), (10, 22, 12)),
    "Spine1": ((-8, -8, -12), (8, 18, 12)),
    "Neck": ((-12, -15, -22), (12, 18, 22)),
    "Neck1": ((-8, -10, -15), (8, 12, 15)),
    "Head": ((-12, -15, -25), (12, 18, 25)),
    "LeftShoulder": ((-8, -8, -15), (25, 8, 15)),
    "LeftArm": ((-45, -80, -75), (125, 35, 55)),
    "LeftUpLeg": ((-20, -115, -35), (50, 25, 35)),
    "LeftLeg": ((-4, 0, -6), (4, 135, 6)),
    "LeftFoot": ((-14, -22, -18), (14, 38, 18)),
    "LeftToeBase": ((0, -25, 0), (0, 15, 0)),
    "LeftHand": ((-12, -12, -15), (12, 12, 15)),
    "LeftFingerBase": ((-25, -20, -25), (25, 20, 25)),
}
ELBOW_LIMITS = (-30.0, 95.0)  # degrees about the hinge, from the rest pose, in which the elbow is already bent
ELBOW_TWIST = 25.0  # degrees either way about the lower arm
FINGER_CURL = (-15.0, 55.0)  # degrees
NOISE = 5.0  # degrees: standard deviation of what is added to a frame of motion capture


class PoseSampler:
    """Random poses for `AnnyBody.pose`: bone rotations (B,3,3) relative to the parent bone, identity at the root."""

    def __init__(self, body: AnnyBody, mocap: Path | None = None) -> None:
        """Read the motion capture at `mocap`, if any; InputError when it is not in the expected form."""
        self._body = body
        self._rest = body.rest(body.mean_phenotype())
        self.frames = np.empty((0, MOCAP_JOINTS, 3)) if mocap is None else _read_mocap(mocap)
        self._hinge = _unit(np.cross(_direction(body, self._rest, "LeftArm", "LeftForeArm"), self._fore))
        self._low, self._high = self._limit_table()

    @property
    def _fore(self) -> Array:
        return _direction(self._body, self._rest, "LeftForeArm", "LeftHand")

    def sample(self, rng: np.random.Generator, n: int, limits_share: float = 0.25) -> Array:
        """Draw (n,B,3,3) poses; `limits_share` of them from joint limits alone (all without motion capture)."""
        if not len(self.frames):
            limits_share = 1.0
        from_limits = rng.random(n) < limits_share
        poses = np.empty((n, len(self._body.bone_names), 3, 3))
        poses[from_limits] = self.from_limits(rng, int(from_limits.sum()))
        chosen = rng.integers(0, max(len(self.frames), 1), int((~from_limits).sum()))
        poses[~from_limits] = self.retarget(self.frames[chosen])
        noise = np.radians(NOISE) * rng.standard_normal((n, len(self._body.bone_names), 3))
        noise *= np.where(from_limits, 0.0, rng.random(n))[:, None, None]
        noise[:, [self._body.bone(name) for name in ("Hips", "LHipJoint", "RHipJoint")]] = 0.0
        poses = poses @ rotation.exp(noise)
        self._curl(rng, poses)
        return poses

    def from_limits(self, rng: np.random.Generator, n: int) -> Array:
        """Draw (n,B,3,3) poses whose every joint is independent, bell-shaped and inside its limits."""
        # The mean of two uniform draws keeps the whole range and favours its middle.
        share = (rng.random((n, *self._low.shape)) + rng.random((n, *self._low.shape))) / 2
        vectors = self._low + share * (self._high - self._low)
        poses = rotation.exp(vectors)
        bend = np.radians(rng.uniform(*ELBOW_LIMITS, size=(n, 2)))
        twist = np.radians(rng.uniform(-ELBOW_TWIST, ELBOW_TWIST, size=(n, 2)))
        for side, name in enumerate(("LeftForeArm", "RightForeArm")):
            sign = np.array([1.0, 1.0, 1.0]) if side == 0 else np.array([-1.0, 1.0, -1.0])
            hinge = rotation.exp(bend[:, side, None] * self._hinge * sign)
            poses[:, self._body.bone(name)] = hinge @ rotation.exp(twist[:, side, None] * self._fore * sign)
        return poses

    def _limit_table(self) -> tuple[Array, Array]:
        low, high = np.zeros((len(self._body.bone_names), 3)), np.zeros((len(self._body.bone_names), 3))
        for name, (lows, highs) in LIMITS.items():
            bone = self._body.bone(name)
            low[bone], high[bone] = np.radians(lows), np.radians(highs)
            other = self._body.mirror_bone[bone]
            if other != bone:  # a mirrored rotation vector changes the signs of x and z
                low[other] = [-high[bone, 0], low[bone, 1], -high[bone, 2]]
                high[other] = [-low[bone, 0], high[bone, 1], -low[bone, 2]]
        return low, high

    def _curl(self, rng: np.random.Generator, poses: Array) -> None:
        body, rest = self._body, self._rest
        along = _direction(body, rest, "LeftFingerBase", "LeftHandFinger1")
        across = _unit(np.cross(along, np.cross(self._hinge, along)))
        for side, initial, sign in (("Left", "L", 1.0), ("Right", "R", -1.0)):
            curl = np.radians(rng.uniform(*FINGER_CURL, size=(len(poses), 1)))
            poses[:, body.bone(f"{side}HandFinger1")] = rotation.exp(curl * across * [sign, 1.0, sign])
            poses[:, body.bone(f"{initial}Thumb")] = poses[:, body.bone(f"{side}FingerBase")]

    def retarget(self, frames: Array) -> Array:
        """Bone rotations (n,B,3,3) in which Anny's bones point as those of the motion-capture frames (n,38,3)."""
        local = np.swapaxes(rotation.exp(frames), -1, -2)
        world = np.empty_like(local)
        for joint, parent in enumerate(MOCAP_PARENTS):
            world[:, joint] = local[:, joint] if parent < 0 else world[:, parent] @ local[:, joint]
        world = FROM_MOCAP @ np.linalg.inv(world[:, :1]) @ world @ FROM_MOCAP.T
        body, align = self._body, self._alignment()
        turned = np.empty((len(frames), len(body.bone_names), 3, 3))
        for bone, name in enumerate(body.bone_names):
            source = MOCAP_OF_BONE.get(name)
            turned[:, bone] = (
                turned[:, body.bone_parents[bone]] if source is None else world[:, source] @ align.get(name, np.eye(3))
            )
        relative = turned.copy()
        for bone, above in enumerate(body.bone_parents):
            if above >= 0:
                relative[:, bone] = np.swapaxes(turned[:, above], -1, -2) @ turned[:, bone]
        return relative

    def _alignment(self) -> dict[str, Array]:
        # From Anny's rest pose to the T-pose: arms by direction and elbow hinge, legs by
        # direction only; hands follow the lower arm; spine and clavicles point alike in both.
        body, rest = self._body, self._rest
        upper = _direction(body, rest, "LeftArm", "LeftForeArm")
        align = {"LeftArm": _frame(T_ARM, T_HINGE) @ _frame(upper, self._hinge).T}
        align["LeftForeArm"] = _frame(T_ARM, T_HINGE) @ _frame(self._fore, self._hinge).T
        align["LeftHand"] = align["LeftFingerBase"] = align["LeftForeArm"]
        for name, below in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot")):
            align[name] = _between(_direction(body, rest, name, below), _unit(T_LEG))
        # The motion capture has no sideways tilt of the ankle, so the feet of the T-pose are as square to the legs.
        shin = _direction(body, rest, "LeftLeg", "LeftFoot") * [0.0, 1.0, 1.0]
        align["LeftFoot"] = align["LeftToeBase"] = _between(_unit(shin), _unit(T_LEG))
        flip = np.diag([1.0, -1.0, 1.0])
        return align | {name.replace("Left", "Right"): flip @ turn @ flip for name, turn in align.items()}


def _read_mocap(path: Path) -> Array:
    try:
        with np.load(path, allow_pickle=False) as archive:
            sequences = [archive[key] for key in archive.files]
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} cannot be read as motion capture (.npz of exponential maps): {error}") from error
    if not sequences or any(s.ndim != 2 or s.shape[1] != 3 + 3 * MOCAP_JOINTS for s in sequences):
        raise InputError(f"{path} holds no (T,{3 + 3 * MOCAP_JOINTS}) arrays of exponential maps; give expmap_20hz.npz")
    return np.concatenate(sequences)[:, 3:].reshape((-1, MOCAP_JOINTS, 3)).astype(np.float64)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _direction(body: AnnyBody, rest: RestBody, bone: str, below: str) -> Array:
    return _unit(rest.joints[body.bone(below)] - rest.joints[body.bone(bone)])


def _frame(first: Array, second: Array) -> Array:
    first = _unit(first)
    second = _unit(second - first * (first @ second))
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _between(start: Array, end: Array) -> Array:
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, start @ end)
    return rotation.exp(axis / sine * angle) if sine > 1e-12 else np.eye(3)
