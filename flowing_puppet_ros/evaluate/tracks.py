# SPDX-License-Identifier: Apache-2.0
"""How many joints of tracks.json or poses.json lie within a threshold of the true ones, threshold by threshold."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.from_bag import Joints, nearest
from flowing_puppet_ros.evaluate.joints import named_points
from flowing_puppet_ros.image.keypoints import Keypoints


@dataclass(frozen=True, slots=True, eq=False)
class JointMisses:
    """Distances (P, J) in pixels of P true people's joints; NaN where the truth is unknown, infinite where missed."""

    names: tuple[str, ...]
    distance: np.ndarray

    def accuracy(self, thresholds: np.ndarray) -> dict[str, np.ndarray]:
        """Percent (T,) of the true joints found within `thresholds` (T,) px, by joint and under "all"."""
        columns = {name: self.distance[:, k] for k, name in enumerate(self.names)} | {"all": self.distance.ravel()}
        known = {name: column[~np.isnan(column)] for name, column in columns.items()}
        return {
            name: 100 * (column[:, None] <= thresholds).mean(axis=0) for name, column in known.items() if len(column)
        }


def read_tracks(path: Path) -> dict[int, list[Joints]]:
    """Read tracks.json or poses.json: {frame index: known joints {our name: (2,) px} of each puppet}.

    Raises:
        InputError: when the file cannot be read or has another form.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        names = [str(name) for name in data["joint_names"]]
        return {
            int(frame["index"]): [_joints(names, puppet) for puppet in frame["puppets"]] for frame in data["frames"]
        }
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is no tracks.json or poses.json as `track` and `pose` write them") from error


def joint_misses(
    found: Mapping[int, Sequence[Joints]], truth: Mapping[int, Iterable[Keypoints]], names: Sequence[str] = ()
) -> JointMisses:
    """Compare every true person with the puppet of their frame that is nearest.

    Args:
        found: as `read_tracks` returns it; a frame that it lacks has nobody.
        truth: people by frame.
        names: joints to measure; without any, all that both sides know somewhere.

    Raises:
        InputError: when no joint is known on both sides.
    """
    people = [(found.get(index, []), _known(person)) for index, persons in truth.items() for person in persons]
    true_names = dict.fromkeys(name for _, known in people for name in known)
    found_names = {name for puppets in found.values() for puppet in puppets for name in puppet}
    chosen = tuple(names) or tuple(name for name in true_names if name in found_names)
    if not any(name in true_names for name in chosen):
        raise InputError("tracks and truth have no joint in common; check the names and the frames of both")
    distance = np.full((len(people), len(chosen)), np.nan)
    for row, (puppets, known) in enumerate(people):
        index = nearest(known, puppets)
        puppet = {} if index is None else puppets[index]
        for column, name in enumerate(chosen):
            if name in known:
                distance[row, column] = np.linalg.norm(puppet[name] - known[name]) if name in puppet else np.inf
    return JointMisses(chosen, distance)


def _known(person: Keypoints) -> Joints:
    return {name: np.array(point[:2]) for name, point in person.usable().items()}


def _joints(names: list[str], puppet: dict[str, Any]) -> Joints:
    return named_points(names, np.array(puppet["joints"], dtype=np.float64)[:, :2])
