# SPDX-License-Identifier: Apache-2.0
"""Random poses of the Anny body: frames of the CMU motion capture with noise, or joint limits alone.

The motion capture (http://mocap.cs.cmu.edu, created with funding from NSF EIA-0196217) is read from an .npz with one
(T, 117) array per sequence: root translation, then exponential maps of 38 joints whose matrices act on row vectors.
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
# Rest directions of the motion-capture skeleton in our axes: a T-pose with the legs 20 degrees apart. The elbow bends
# about T_HINGE.
T_ARM, T_LEG = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.342, -0.94])
T_HINGE = np.array([0.5, 0.0, -0.866])

# Minimum and maximum rotation-vector components, from the rest pose, in body axes, for bones of the left side and the
# midline: x positive lifts a left limb sideways, y positive bends forward or swings a hanging limb back.
JOINT_LIMITS_DEG = {
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
ELBOW_LIMITS_DEG = (-30.0, 95.0)  # about the hinge, from the rest pose, in which the elbow is already bent
ELBOW_TWIST_DEG = 25.0  # maximum, either way about the lower arm
FINGER_CURL_DEG = (-15.0, 55.0)  # minimum and maximum
NOISE_DEG = 5.0  # standard deviation of the noise added to a frame of motion capture


class PoseSampler:
    """Random poses for `AnnyBody.pose`: bone rotations (B, 3, 3) relative to the parent bone, identity at the root."""

    def __init__(self, body: AnnyBody, mocap: Path | None = None) -> None:
        """Read the motion capture at `mocap`, if any; InputError if it is not in the expected form."""
        self._body = body
        self._rest = body.make_rest_body(body.mean_phenotype())
        self.frames = np.empty((0, MOCAP_JOINTS, 3)) if mocap is None else _read_mocap(mocap)
        self._hinge = normalise(
            np.cross(_bone_direction(body, self._rest, "LeftArm", "LeftForeArm"), self._forearm_direction)
        )
        self._low, self._high = self._make_limit_table()

    @property
    def _forearm_direction(self) -> Array:
        return _bone_direction(self._body, self._rest, "LeftForeArm", "LeftHand")

    def sample(self, rng: np.random.Generator, n: int, limits_share: float = 0.25) -> Array:
        """Draw poses (n, B, 3, 3), `limits_share` of them from joint limits alone (all, without motion capture)."""
        if not len(self.frames):
            limits_share = 1.0
        from_limits = rng.random(n) < limits_share
        poses = np.empty((n, len(self._body.bone_names), 3, 3))
        poses[from_limits] = self.sample_from_limits(rng, int(from_limits.sum()))
        chosen = rng.integers(0, max(len(self.frames), 1), int((~from_limits).sum()))
        poses[~from_limits] = self.retarget(self.frames[chosen])
        noise = np.radians(NOISE_DEG) * rng.standard_normal((n, len(self._body.bone_names), 3))
        noise *= np.where(from_limits, 0.0, rng.random(n))[:, None, None]
        noise[:, [self._body.bone_index(name) for name in ("Hips", "LHipJoint", "RHipJoint")]] = 0.0
        poses = poses @ rotation.exp(noise)
        self._curl_fingers(rng, poses)
        return poses

    def sample_from_limits(self, rng: np.random.Generator, n: int) -> Array:
        """Draw poses (n, B, 3, 3) whose joints are independent, bell-shaped and within their limits."""
        # The mean of two uniform draws keeps the whole range and favours its middle.
        share = (rng.random((n, *self._low.shape)) + rng.random((n, *self._low.shape))) / 2
        vectors = self._low + share * (self._high - self._low)
        poses = rotation.exp(vectors)
        bend = np.radians(rng.uniform(*ELBOW_LIMITS_DEG, size=(n, 2)))
        twist = np.radians(rng.uniform(-ELBOW_TWIST_DEG, ELBOW_TWIST_DEG, size=(n, 2)))
        for side, name in enumerate(("LeftForeArm", "RightForeArm")):
            sign = np.array([1.0, 1.0, 1.0]) if side == 0 else np.array([-1.0, 1.0, -1.0])
            hinge = rotation.exp(bend[:, side, None] * self._hinge * sign)
            poses[:, self._body.bone_index(name)] = hinge @ rotation.exp(
                twist[:, side, None] * self._forearm_direction * sign
            )
        return poses

    def _make_limit_table(self) -> tuple[Array, Array]:
        low, high = np.zeros((len(self._body.bone_names), 3)), np.zeros((len(self._body.bone_names), 3))
        for name, (lows, highs) in JOINT_LIMITS_DEG.items():
            bone = self._body.bone_index(name)
            low[bone], high[bone] = np.radians(lows), np.radians(highs)
            other = self._body.mirror_bone[bone]
            if other != bone:  # a mirrored rotation vector changes the signs of x and z
                low[other] = [-high[bone, 0], low[bone, 1], -high[bone, 2]]
                high[other] = [-low[bone, 0], high[bone, 1], -low[bone, 2]]
        return low, high

    def _curl_fingers(self, rng: np.random.Generator, poses: Array) -> None:
        body, rest = self._body, self._rest
        along = _bone_direction(body, rest, "LeftFingerBase", "LeftHandFinger1")
        across = normalise(np.cross(along, np.cross(self._hinge, along)))
        for side, initial, sign in (("Left", "L", 1.0), ("Right", "R", -1.0)):
            curl = np.radians(rng.uniform(*FINGER_CURL_DEG, size=(len(poses), 1)))
            poses[:, body.bone_index(f"{side}HandFinger1")] = rotation.exp(curl * across * [sign, 1.0, sign])
            poses[:, body.bone_index(f"{initial}Thumb")] = poses[:, body.bone_index(f"{side}FingerBase")]

    def retarget(self, frames: Array) -> Array:
        """Return bone rotations (n, B, 3, 3) that align Anny's bones with motion-capture frames (n, 38, 3)."""
        local = np.swapaxes(rotation.exp(frames), -1, -2)
        world = np.empty_like(local)
        for joint, parent in enumerate(MOCAP_PARENTS):
            world[:, joint] = local[:, joint] if parent < 0 else world[:, parent] @ local[:, joint]
        world = FROM_MOCAP @ np.linalg.inv(world[:, :1]) @ world @ FROM_MOCAP.T
        body, align = self._body, self._align_rest_poses()
        rotations = np.empty((len(frames), len(body.bone_names), 3, 3))
        for bone, name in enumerate(body.bone_names):
            source = MOCAP_OF_BONE.get(name)
            rotations[:, bone] = (
                rotations[:, body.bone_parents[bone]]
                if source is None
                else world[:, source] @ align.get(name, np.eye(3))
            )
        relative = rotations.copy()
        for bone, parent in enumerate(body.bone_parents):
            if parent >= 0:
                relative[:, bone] = np.swapaxes(rotations[:, parent], -1, -2) @ rotations[:, bone]
        return relative

    def _align_rest_poses(self) -> dict[str, Array]:
        # From Anny's rest pose to the T-pose: arms by direction and elbow hinge, legs by
        # direction only; hands follow the lower arm; spine and clavicles point alike in both.
        body, rest = self._body, self._rest
        upper = _bone_direction(body, rest, "LeftArm", "LeftForeArm")
        align = {"LeftArm": _make_frame(T_ARM, T_HINGE) @ _make_frame(upper, self._hinge).T}
        align["LeftForeArm"] = _make_frame(T_ARM, T_HINGE) @ _make_frame(self._forearm_direction, self._hinge).T
        align["LeftHand"] = align["LeftFingerBase"] = align["LeftForeArm"]
        for name, below in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot")):
            align[name] = _rotation_between(_bone_direction(body, rest, name, below), normalise(T_LEG))
        # The motion capture has no sideways ankle tilt, so the feet of the T-pose are square to the legs too.
        shin = _bone_direction(body, rest, "LeftLeg", "LeftFoot") * [0.0, 1.0, 1.0]
        align["LeftFoot"] = align["LeftToeBase"] = _rotation_between(normalise(shin), normalise(T_LEG))
        flip = np.diag([1.0, -1.0, 1.0])
        return align | {name.replace("Left", "Right"): flip @ turn @ flip for name, turn in align.items()}


def _read_mocap(path: Path) -> Array:
    try:
        with np.load(path, allow_pickle=False) as archive:
            sequences = [archive[key] for key in archive.files]
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} cannot be read as motion capture (.npz of exponential maps): {error}") from error
    if not sequences or any(s.ndim != 2 or s.shape[1] != 3 + 3 * MOCAP_JOINTS for s in sequences):
        raise InputError(f"{path} has no (T, {3 + 3 * MOCAP_JOINTS}) arrays of exponential maps; give expmap_20hz.npz")
    return np.concatenate(sequences)[:, 3:].reshape((-1, MOCAP_JOINTS, 3)).astype(np.float64)


def normalise(vector: Array) -> Array:
    """Return a vector scaled to unit length."""
    return np.asarray(vector / np.linalg.norm(vector))


def _bone_direction(body: AnnyBody, rest: RestBody, bone: str, below: str) -> Array:
    return normalise(rest.joints[body.bone_index(below)] - rest.joints[body.bone_index(bone)])


def _make_frame(first: Array, second: Array) -> Array:
    first = normalise(first)
    second = normalise(second - first * (first @ second))
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _rotation_between(start: Array, end: Array) -> Array:
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, start @ end)
    return rotation.exp(axis / sine * angle) if sine > 1e-12 else np.eye(3)
