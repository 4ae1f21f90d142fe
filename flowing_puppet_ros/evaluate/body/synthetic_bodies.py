# SPDX-License-Identifier: Apache-2.0
"""People to measure fits on: posed Anny bodies, whose every vertex is known and which no puppet generated.

Metres, z up. `evaluate.body.synthetic_scans` makes of them what a scanner, a depth camera or a LiDAR sees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.learn.anny.poses import FROM_MOCAP, MOCAP_JOINTS, PoseSampler
from flowing_puppet_ros.model import rotation, weights

TILT = np.radians(8.0)  # standard deviation of the pelvis against the upright, about each level axis
MOCAP_RATE = 20.0  # frames a second
MOCAP_UNIT = 0.0254 / 0.45  # metres
STILL = 0.01  # metres a frame and joint: slower stretches of motion capture make no test of tracking


@dataclass(frozen=True, slots=True, eq=False)
class TrueBody:
    """A posed person.

    Attributes:
        vertices: (A, 3) of Anny, metres, z up; the soles stand about z = 0 and the hips about x = y = 0.
        joints: (J, 3) metres, named by `BodySource.joint_names`.
        hard: whether the pose was drawn from joint limits alone, not from motion capture.
    """

    vertices: np.ndarray
    joints: np.ndarray
    hard: bool

    def template_vertices(self, model_name: str) -> np.ndarray:
        """Where (V, 3) the vertices of the shipped Stitched Puppet `model_name` truly are."""
        return np.asarray(self.vertices[weights.load("sp", model_name)["anny_vertex"]])

    def moved(self, step: np.ndarray) -> TrueBody:
        """The same body moved by `step` (3,) metres."""
        return replace(self, vertices=self.vertices + step, joints=self.joints + step)


class BodySource:
    """Random people of both genders; `triangles` (F, 3) and `joint_names` are the same for all of them."""

    def __init__(self, mocap: Path | None = None) -> None:
        """Load Anny and the motion capture, if any.

        Raises:
            InputError: when the packages for learning are missing or the motion capture cannot be read.
        """
        self._anny = AnnyBody("neutral")
        self._sampler = PoseSampler(self._anny, mocap)
        self._mocap = mocap
        rest = self._anny.rest(self._anny.mean_phenotype())
        self.triangles = self._anny.triangles
        self.joint_names = tuple(self._anny.landmarks(rest.vertices, rest.joints))

    @property
    def has_mocap(self) -> bool:
        """Whether people can be drawn in poses of motion capture."""
        return self._mocap is not None

    def body(self, rng: np.random.Generator, hard: bool) -> TrueBody:
        """Draw a person of unknown yaw: in a pose of the motion capture, or `hard`, anywhere within joint limits."""
        if not hard and not self.has_mocap:
            raise InputError("poses of people need motion capture; give --mocap expmap_20hz.npz")
        rest = self._anny.rest(self._anny.sample_phenotype(rng))
        pose = self._sampler.sample(rng, 1, limits_share=float(hard))[0]
        pose[0] = _turn(rng) @ rotation.exp(TILT * rng.standard_normal(3))
        body = self._posed(rest, pose, np.zeros(3), hard)
        return body.moved(np.array([0.0, 0.0, -body.vertices[:, 2].min()]))

    def motion(self, rng: np.random.Generator, frames: int, rate: float) -> list[TrueBody]:
        """Draw one person moving through `frames` frames, `rate` a second, interpolated from motion capture.

        Raises:
            InputError: without motion capture that is long enough.
        """
        poses, places = self._stretch(rng, 2 + int(np.ceil((frames - 1) * MOCAP_RATE / rate)))
        rest = self._anny.rest(self._anny.sample_phenotype(rng))
        turn = _turn(rng)
        bodies = []
        for time in np.arange(frames) * MOCAP_RATE / rate:
            key, share = int(time), time - int(time)
            step = rotation.log(np.swapaxes(poses[key], -1, -2) @ poses[key + 1])
            pose = poses[key] @ rotation.exp(share * step)
            pose[0] = turn @ pose[0]
            place = turn @ ((1 - share) * places[key] + share * places[key + 1])
            bodies.append(self._posed(rest, pose, place, hard=False))
        down = np.array([0.0, 0.0, -min(float(body.vertices[:, 2].min()) for body in bodies)])
        return [body.moved(down) for body in bodies]

    def _posed(self, rest: RestBody, pose: np.ndarray, place: np.ndarray, hard: bool) -> TrueBody:
        vertices, bones = self._anny.pose(rest, pose)
        named = self._anny.landmarks(vertices, bones)
        return TrueBody(vertices + place, np.stack([named[name] for name in self.joint_names]) + place, hard)

    def _stretch(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Bone rotations (count, B, 3, 3), with the pelvis's own, and places (count, 3) of a moving person."""
        for sequence in rng.permutation(np.array(self._sequences(), dtype=object)):
            if len(sequence) < count:
                continue
            start = int(rng.integers(0, len(sequence) - count + 1))
            frames = np.asarray(sequence[start : start + count], dtype=np.float64)
            poses = self._sampler.retarget(frames[:, 3:].reshape((-1, MOCAP_JOINTS, 3)))
            pelvis = np.swapaxes(rotation.exp(frames[:, 3:6]), -1, -2)
            poses[:, 0] = FROM_MOCAP @ pelvis @ FROM_MOCAP.T
            places = (frames[:, :3] - frames[0, :3]) @ FROM_MOCAP.T * MOCAP_UNIT
            if self._speed(poses, places) > STILL:
                return poses, places
        raise InputError(f"{self._mocap} holds no motion of {count} frames; give longer motion capture")

    def _sequences(self) -> list[np.ndarray]:
        if self._mocap is None:
            return []
        with np.load(self._mocap, allow_pickle=False) as archive:
            return [archive[name] for name in archive.files]

    def _speed(self, poses: np.ndarray, places: np.ndarray) -> float:
        rest = self._anny.rest(self._anny.mean_phenotype())
        bones = self._anny.pose(rest, poses, np.arange(1))[1] + places[:, None]
        return float(np.linalg.norm(np.diff(bones, axis=0), axis=2).mean())


def _turn(rng: np.random.Generator) -> np.ndarray:
    """A random rotation (3, 3) about the vertical."""
    return rotation.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
