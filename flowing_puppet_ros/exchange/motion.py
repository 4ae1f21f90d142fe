# SPDX-License-Identifier: Apache-2.0
"""The motion of one person as all formats get it: metres, y up, z forward at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.body.scans.scan_frame import rotation_to_z_up
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.exchange.bones import BonePoses, pose_bones
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.units import NANOSECONDS

TO_Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Rotation from x forward, y left, z up to z forward, x left, y up, as glTF, BVH and TRC have it."""
DEFAULT_STEP_NS = NANOSECONDS // 30
"""Time between frames of a motion of one frame."""


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """One person in T frames; metres, y up.

    Attributes:
        name: of the files that are written.
        identity: id of the person, "" for a fit.
        model: the body model.
        stamps_ns: (T,) increasing.
        vertices: (T, V, 3).
        joints: (T, J, 3).
        part_rotation: (T, 16, 3, 3) from the template's pose in the same axes, y up and z forward.
        part_center: (T, 16, 3).
        shape: (T, 16, S) shape coefficients.
        confidence: (T,) 0 to 1.
        reliable: (T,) whether each body can be trusted.
    """

    name: str
    identity: str
    model: StitchedPuppet
    stamps_ns: np.ndarray
    vertices: Array
    joints: Array
    part_rotation: Array
    part_center: Array
    shape: Array
    confidence: Array
    reliable: Array

    @cached_property
    def bones(self) -> BonePoses:
        """The bones in every frame."""
        return pose_bones(self.model, self.vertices, self.joints, self.part_rotation)

    @property
    def step_ns(self) -> int:
        """Median time between frames."""
        return int(np.median(np.diff(self.stamps_ns))) if len(self.stamps_ns) > 1 else DEFAULT_STEP_NS

    def resample(self) -> BodyMotion:
        """Return the same motion with equal times between frames, for formats that have a rate."""
        steps = np.diff(self.stamps_ns)
        if len(steps) < 2 or np.ptp(steps) <= 1:
            return self
        count = round((self.stamps_ns[-1] - self.stamps_ns[0]) / self.step_ns) + 1
        stamps = self.stamps_ns[0] + self.step_ns * np.arange(count)
        stamps[-1] = min(stamps[-1], self.stamps_ns[-1])
        after = np.clip(np.searchsorted(self.stamps_ns, stamps), 1, len(self.stamps_ns) - 1)
        share = (stamps - self.stamps_ns[after - 1]) / (self.stamps_ns[after] - self.stamps_ns[after - 1])

        def blend(values: Array) -> Array:
            weight = share.reshape((-1, *[1] * (values.ndim - 1)))
            return np.asarray((1 - weight) * values[after - 1] + weight * values[after])

        nearest = np.where(share < 0.5, after - 1, after)
        return replace(
            self,
            stamps_ns=stamps,
            vertices=blend(self.vertices),
            joints=blend(self.joints),
            part_rotation=_slerp(self.part_rotation, self.stamps_ns, stamps),
            part_center=blend(self.part_center),
            shape=self.shape[nearest],
            confidence=blend(self.confidence),
            reliable=self.reliable[nearest],
        )


def make_motion(
    name: str,
    identity: str,
    model: StitchedPuppet,
    stamps_ns: Array,
    bodies: dict[str, Array],
    up: Array,
    metres: float = 1.0,
) -> BodyMotion:
    """Return a motion from arrays of `BodyMotion` in a frame of any unit, in which `up` (3,) is up."""
    turn = TO_Y_UP @ rotation_to_z_up(np.asarray(up, float))
    places = ("vertices", "joints", "part_center")
    moved = {key: np.asarray(bodies[key], np.float64) * metres @ turn.T for key in places}
    return BodyMotion(
        name,
        identity,
        model,
        np.asarray(stamps_ns, np.int64),
        part_rotation=turn @ np.asarray(bodies["part_rotation"], np.float64) @ TO_Y_UP.T,
        shape=np.asarray(bodies["shape"], np.float64),
        confidence=np.asarray(bodies["confidence"], np.float64),
        reliable=np.asarray(bodies["reliable"], bool),
        **moved,
    )


def read_fit(path: Path, up: Array | None = None) -> BodyMotion:
    """Read a body that `fit` wrote, as a motion of one frame; `up` (3,) replaces the axis that the fit found.

    InputError when the file is none, or of another model.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = {key: arrays[key] for key in arrays.files}
        model = StitchedPuppet.load(str(found["model"]))
        bodies = {
            "vertices": found["vertices"],
            "joints": found["joints"],
            "part_center": found["part_center"],
            "part_rotation": found["part_rotation"],
            "shape": found["all_shape_coefficients"],
            "confidence": found["confidence"],
            "reliable": found["reliable"],
        }
        scale, axis = float(found["metres_per_unit"]), found["up"]
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InputError(f"{path} is not a fit; give the .npz that `flowing-puppet fit` writes") from error
    if found["vertices"].shape != (len(model.part_of_vertex), 3):
        raise InputError(f"{path} was fitted with another version of the {model.name} model; fit the scan again")
    one = {key: np.asarray(value)[None] for key, value in bodies.items()}
    return make_motion(path.stem, "", model, np.zeros(1), one, axis if up is None else up, scale)


def _slerp(rotations: Array, stamps: Array, wanted: Array) -> F64:
    """Interpolate rotations (T, K, 3, 3) at `stamps` to `wanted` times."""
    times, at = (stamps - stamps[0]) / NANOSECONDS, (wanted - stamps[0]) / NANOSECONDS
    turns = [Slerp(times, Rotation.from_matrix(rotations[:, k]))(at).as_matrix() for k in range(rotations.shape[1])]
    return np.stack(turns, axis=1)
