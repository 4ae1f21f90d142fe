# SPDX-License-Identifier: Apache-2.0
"""Accuracy and jitter of the joints in tracks.json or poses.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Joints, find_nearest
from flowing_puppet_ros.evaluate.joints import jitter, name_points
from flowing_puppet_ros.image.formats.keypoints import Keypoints

GROUPS = ("wrist", "elbow", "shoulder", "hip", "knee", "ankle")


@dataclass(frozen=True, slots=True, eq=False)
class JointMisses:
    """Distances `distance` (P, J) px of P true people's joints; NaN if the truth is unknown, infinite if missed."""

    names: tuple[str, ...]
    distance: np.ndarray

    def accuracy(self, thresholds: np.ndarray) -> dict[str, np.ndarray]:
        """Return the percentage (T,) of the true joints within `thresholds` (T,) px, by joint and for "all"."""
        columns = {name: self.distance[:, k] for k, name in enumerate(self.names)} | {"all": self.distance.ravel()}
        known = {name: column[~np.isnan(column)] for name, column in columns.items()}
        return {
            name: 100 * (column[:, None] <= thresholds).mean(axis=0) for name, column in known.items() if len(column)
        }

    def group(self) -> dict[str, np.ndarray]:
        """Group the known distances (n,) px by kind of joint (wrists, elbows, ...), and for all joints."""
        found = {
            f"{group}s": self.distance[:, [k for k, name in enumerate(self.names) if name.endswith(f"_{group}")]]
            for group in GROUPS
        } | {"all joints": self.distance}
        known = {name: values[~np.isnan(values)] for name, values in found.items()}
        return {name: values for name, values in known.items() if len(values)}


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """A tracks.json or poses.json.

    Attributes:
        frames: frame index -> known joints {our name: (2,) px} of each puppet.
        people: id -> frame index -> joints; empty for single images, which have no tracks.
    """

    frames: dict[int, list[Joints]]
    people: dict[str, dict[int, Joints]]

    def jitter(self) -> float:
        """Return the mean length of the joints' second difference over three successive frames, px; NaN without any."""
        lengths = [jitter(frames, 1) for frames in self.people.values()]
        joined = np.concatenate(lengths) if lengths else np.empty(0)
        return float(joined.mean()) if joined.size else float("nan")


def read_tracks(path: Path) -> Tracks:
    """Read tracks.json or poses.json.

    Raises:
        InputError: if the file cannot be read or has another form.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        names = [str(name) for name in data["joint_names"]]
        frames: dict[int, list[Joints]] = {}
        people: dict[str, dict[int, Joints]] = {}
        for frame in data["frames"]:
            index = int(frame["index"])
            frames[index] = [_read_joints(names, puppet) for puppet in frame["puppets"]]
            if "path" not in frame:
                for puppet, joints in zip(frame["puppets"], frames[index], strict=True):
                    people.setdefault(str(puppet.get("id", "")), {})[index] = joints
        return Tracks(frames, people)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is not a tracks.json or poses.json as written by `track` or `pose`") from error


def measure_misses(
    found: Mapping[int, Sequence[Joints]], truth: Mapping[int, Iterable[Keypoints]], names: Sequence[str] = ()
) -> JointMisses:
    """Compare every true person with the nearest puppet of their frame.

    Args:
        found: puppets by frame; absent frames have none.
        truth: people by frame.
        names: joints to measure; without any, all that are known somewhere on both sides.

    Raises:
        InputError: if no joint is known on both sides.
    """
    people = [(found.get(index, []), _known_joints(person)) for index, persons in truth.items() for person in persons]
    true_names = dict.fromkeys(name for _, known in people for name in known)
    found_names = {name for puppets in found.values() for puppet in puppets for name in puppet}
    chosen = tuple(names) or tuple(name for name in true_names if name in found_names)
    if not any(name in true_names for name in chosen):
        raise InputError("tracks and truth have no joint in common; check the names and the frames of both")
    distance = np.full((len(people), len(chosen)), np.nan)
    for row, (puppets, known) in enumerate(people):
        index = find_nearest(known, puppets)
        puppet = {} if index is None else puppets[index]
        for column, name in enumerate(chosen):
            if name in known:
                distance[row, column] = np.linalg.norm(puppet[name] - known[name]) if name in puppet else np.inf
    return JointMisses(chosen, distance)


def _known_joints(person: Keypoints) -> Joints:
    return {name: np.array(point[:2]) for name, point in person.select_usable().items()}


def _read_joints(names: list[str], puppet: dict[str, Any]) -> Joints:
    return name_points(names, np.array(puppet["joints"], dtype=np.float64)[:, :2])
