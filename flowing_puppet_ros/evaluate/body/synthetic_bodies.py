# SPDX-License-Identifier: Apache-2.0
"""Posed Anny bodies to evaluate fits on: every vertex is known, and no puppet model generated them.

Metres, z up. `evaluate.body.synthetic_scans` simulates a scanner, a depth camera or a LiDAR that sees them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import AGE, AnnyBody, RestBody
from flowing_puppet_ros.learn.anny.poses import FROM_MOCAP, MOCAP_JOINTS, PoseSampler
from flowing_puppet_ros.model import rotation, weights

TILT_DEVIATION = np.radians(8.0)  # rad, of the pelvis from upright, about each horizontal axis
MOCAP_RATE_HZ = 20.0
MOCAP_UNIT_M = 0.0254 / 0.45
MIN_SPEED_M = 0.01  # mean motion of a joint per frame; slower motion capture does not test tracking
CHILD_AGE = (0.3, 0.42)  # of Anny, whose adults are from 0.6 on
STANDING_BONES, MAX_STANDING_M = ("LeftFoot", "RightFoot", "Hips"), 0.15
"""Bones of people who stand, and how far from their first place these are at most."""
STANDING_WINDOWS = 5  # of motion capture, of which the one that moves least is taken


@dataclass(frozen=True, slots=True, eq=False)
class TrueBody:
    """A posed person.

    Attributes:
        vertices: (A, 3) m of Anny, z up; the soles are near z = 0 and the hips near x = y = 0.
        joints: (J, 3) m, named by `BodySource.joint_names`.
        hard: whether the pose was drawn from joint limits alone, not from motion capture.
        stature: m, of the person standing.
        rest: the same person in Anny's rest pose.
        pose: (B, 3, 3) rotations of the bones; None where they are not known.
    """

    vertices: np.ndarray
    joints: np.ndarray
    hard: bool
    stature: float
    rest: RestBody | None = None
    pose: np.ndarray | None = None

    def template_vertices(self, model_name: str) -> np.ndarray:
        """Return the true positions (V, 3) m of the vertices of the shipped Stitched Puppet `model_name`."""
        return np.asarray(self.vertices[weights.load("sp", model_name)["anny_vertex"]])

    def translate(self, step: np.ndarray) -> TrueBody:
        """Return the body translated by `step` (3,) m."""
        return replace(self, vertices=self.vertices + step, joints=self.joints + step)


class BodySource:
    """Random people of both genders.

    The same for all of them: `triangles` (F, 3), `joint_names`, `bone_names`, `bone_of_vertex` (V,), which moves each
    vertex most, and `rest_vertices` (V, 3) m, an average person's in the rest pose.
    """

    def __init__(self, mocap: Path | None = None) -> None:
        """Load Anny and the motion capture, if any.

        Raises:
            InputError: if the packages for learning are missing or the motion capture cannot be read.
        """
        self._anny = AnnyBody("neutral")
        self._sampler = PoseSampler(self._anny, mocap)
        self._mocap = mocap
        rest = self._anny.make_rest_body(self._anny.mean_phenotype())
        self.triangles = self._anny.triangles
        self.joint_names = tuple(self._anny.locate_landmarks(rest.vertices, rest.joints))
        self.bone_names = self._anny.bone_names
        self.bone_of_vertex = self._anny.skin_weights.argmax(axis=1)
        self.rest_vertices = rest.vertices

    @property
    def has_mocap(self) -> bool:
        """Whether people can be drawn in poses of motion capture."""
        return self._mocap is not None

    def draw_body(self, rng: np.random.Generator, hard: bool) -> TrueBody:
        """Draw a person of random yaw in a pose of the motion capture or, if `hard`, anywhere within joint limits."""
        if not hard and not self.has_mocap:
            raise InputError("poses of people need motion capture; give --mocap expmap_20hz.npz")
        rest = self.draw_person(rng)
        pose = self._sampler.sample(rng, 1, limits_share=float(hard))[0]
        pose[0] = _draw_yaw(rng) @ rotation.exp(TILT_DEVIATION * rng.standard_normal(3))
        body = self._pose(rest, pose, np.zeros(3), hard)
        return body.translate(np.array([0.0, 0.0, -body.vertices[:, 2].min()]))

    def draw_person(self, rng: np.random.Generator) -> RestBody:
        """Draw the shape of a person."""
        return self._anny.make_rest_body(self._anny.sample_phenotype(rng))

    def draw_child(self, rng: np.random.Generator) -> RestBody:
        """Draw the shape of a child of about 1.1 to 1.45 m, with a child's proportions."""
        phenotype = self._anny.sample_phenotype(rng)
        phenotype[AGE] = rng.uniform(*CHILD_AGE)
        return self._anny.make_rest_body(phenotype)

    def pose_person(self, person: RestBody, angles: Mapping[str, np.ndarray], turn: np.ndarray) -> TrueBody:
        """Pose a person by rotation vectors (3,) rad by bone, from the rest pose; `turn` (3, 3) is the pelvis's."""
        vectors = np.zeros((len(self.bone_names), 3))
        for bone, vector in angles.items():
            vectors[self.bone_names.index(bone)] = vector
        pose = rotation.exp(vectors)
        pose[0] = turn
        return self._pose(person, pose, np.zeros(3), hard=False)

    def draw_motion(
        self, rng: np.random.Generator, frames: int, rate: float, min_speed: float = MIN_SPEED_M
    ) -> list[TrueBody]:
        """Draw one person moving for `frames` frames at `rate` Hz, interpolated from motion capture.

        `min_speed` is the least mean motion of a joint in metres per frame of the motion capture.

        Raises:
            InputError: if no motion capture is long enough.
        """
        poses, places = self._draw_sequence(rng, 2 + int(np.ceil((frames - 1) * MOCAP_RATE_HZ / rate)), min_speed)
        rest = self.draw_person(rng)
        turn = _draw_yaw(rng)
        bodies = []
        for time in np.arange(frames) * MOCAP_RATE_HZ / rate:
            key, share = int(time), time - int(time)
            step = rotation.log(np.swapaxes(poses[key], -1, -2) @ poses[key + 1])
            pose = poses[key] @ rotation.exp(share * step)
            pose[0] = turn @ pose[0]
            place = turn @ ((1 - share) * places[key] + share * places[key + 1])
            bodies.append(self._pose(rest, pose, place, hard=False))
        down = np.array([0.0, 0.0, -min(float(body.vertices[:, 2].min()) for body in bodies)])
        return [body.translate(down) for body in bodies]

    def sway(self, rng: np.random.Generator, body: TrueBody, frames: int, rate: float) -> list[TrueBody]:
        """Return a body that stands there for `frames` frames at `rate` Hz, moving as little as people who stand do.

        What motion capture of one of them does to each joint is done to the body's, to and fro where it is too short.
        InputError if nobody stands in the motion capture.
        """
        turns, steps = self._draw_standing(rng, 2 + int(np.ceil((frames - 1) * MOCAP_RATE_HZ / rate)))
        assert body.rest is not None and body.pose is not None
        start = self._pose(body.rest, body.pose, np.zeros(3), body.hard)
        place = (body.joints - start.joints).mean(axis=0)
        low = float(body.vertices[:, 2].min())
        bodies = []
        for key in np.round(np.arange(frames) * MOCAP_RATE_HZ / rate).astype(np.int64):
            period = max(2 * len(turns) - 2, 1)
            key = min(key % period, period - key % period)
            moved = self._pose(body.rest, body.pose @ turns[key], place + body.pose[0] @ steps[key], body.hard)
            bodies.append(moved.translate(np.array([0.0, 0.0, low - float(moved.vertices[:, 2].min())])))
        return bodies

    def _draw_standing(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw how bones turn (K, B, 3, 3) from the first frame on, and where the pelvis goes (K, 3) m in its frame.

        K is `count` or as many frames as there are.
        """
        rest = self._anny.make_rest_body(self._anny.mean_phenotype())
        feet = [self.bone_names.index(name) for name in STANDING_BONES]
        found = []
        for sequence in rng.permutation(np.array(self._read_sequences(), dtype=object)):
            size = min(count, len(sequence))
            start = int(rng.integers(0, len(sequence) - size + 1))
            poses, places = self._retarget(sequence[start : start + size])
            bones = self._anny.pose(rest, poses, np.arange(1))[1] + places[:, None]
            away = np.linalg.norm(bones[:, feet] - bones[:1, feet], axis=2).max()
            if size >= min(count, MOCAP_RATE_HZ) and away < MAX_STANDING_M:
                found.append((float(np.linalg.norm(np.diff(bones, axis=0), axis=2).mean()), poses, places))
            if len(found) == STANDING_WINDOWS:
                break
        if not found:
            raise InputError(f"nobody stands in {self._mocap}; give motion capture of people who do")
        _, poses, places = min(found, key=lambda each: each[0])
        return np.swapaxes(poses[0], -1, -2) @ poses, (places - places[0]) @ poses[0, 0]

    def _pose(self, rest: RestBody, pose: np.ndarray, place: np.ndarray, hard: bool) -> TrueBody:
        vertices, bones = self._anny.pose(rest, pose)
        named = self._anny.locate_landmarks(vertices, bones)
        return TrueBody(
            vertices + place,
            np.stack([named[name] for name in self.joint_names]) + place,
            hard,
            rest.stature,
            rest,
            pose,
        )

    def _draw_sequence(self, rng: np.random.Generator, count: int, min_speed: float) -> tuple[np.ndarray, np.ndarray]:
        """Draw bone rotations (count, B, 3, 3), pelvis included, and positions (count, 3) m of a moving person."""
        for sequence in rng.permutation(np.array(self._read_sequences(), dtype=object)):
            if len(sequence) < count:
                continue
            start = int(rng.integers(0, len(sequence) - count + 1))
            poses, places = self._retarget(sequence[start : start + count])
            if self._mean_speed(poses, places) > min_speed:
                return poses, places
        raise InputError(
            f"{self._mocap} holds no motion of {count} frames that is fast enough; give longer motion capture"
        )

    def _retarget(self, sequence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bone rotations (K, B, 3, 3), pelvis included, and positions (K, 3) m from the first on, of frames."""
        frames = np.asarray(sequence, dtype=np.float64)
        poses = self._sampler.retarget(frames[:, 3:].reshape((-1, MOCAP_JOINTS, 3)))
        pelvis = np.swapaxes(rotation.exp(frames[:, 3:6]), -1, -2)
        poses[:, 0] = FROM_MOCAP @ pelvis @ FROM_MOCAP.T
        return poses, (frames[:, :3] - frames[0, :3]) @ FROM_MOCAP.T * MOCAP_UNIT_M

    def _read_sequences(self) -> list[np.ndarray]:
        if self._mocap is None:
            return []
        with np.load(self._mocap, allow_pickle=False) as archive:
            return [archive[name] for name in archive.files]

    def _mean_speed(self, poses: np.ndarray, places: np.ndarray) -> float:
        rest = self._anny.make_rest_body(self._anny.mean_phenotype())
        bones = self._anny.pose(rest, poses, np.arange(1))[1] + places[:, None]
        return float(np.linalg.norm(np.diff(bones, axis=0), axis=2).mean())


def _draw_yaw(rng: np.random.Generator) -> np.ndarray:
    """Draw a random rotation (3, 3) about the vertical."""
    return rotation.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
