# SPDX-License-Identifier: Apache-2.0
"""Accuracy and jitter of the joints in tracks.json or poses.json, and the people in each image."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Joints, find_nearest
from flowing_puppet_ros.evaluate.joints import jitter, measure_pck, name_points
from flowing_puppet_ros.evaluate.people import PeopleTally, Unmatched, rate_people
from flowing_puppet_ros.evaluate.precision import measure_precision
from flowing_puppet_ros.evaluate.similarity import SIGMAS
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name

GROUPS = ("wrist", "elbow", "shoulder", "hip", "knee", "ankle")


@dataclass(frozen=True, slots=True, eq=False)
class JointMisses:
    """Distances of P true people's joints from the nearest puppet's.

    Attributes:
        names: of the J joints.
        distance: (P, J) px; NaN if the truth is unknown, infinite if missed.
        torso, head: (P,) px, lengths of each true person's; NaN if unknown.
    """

    names: tuple[str, ...]
    distance: np.ndarray
    torso: np.ndarray
    head: np.ndarray

    def pck(self) -> dict[str, float]:
        """Return PCK@0.2 and PCKh@0.5 in percent, see `measure_pck`."""
        return measure_pck(self.distance, self.torso, self.head)

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
        names: joints that any puppet has; without puppets, those that the file could have.
        frames: frame index -> known joints {our name: (2,) px} of each puppet.
        scores: frame index -> mean confidence of the joints of each puppet.
        files: path of the image -> frame index; empty for videos.
        people: id -> frame index -> joints; empty for single images, which have no tracks.
    """

    names: tuple[str, ...]
    frames: dict[int, list[Joints]]
    scores: dict[int, list[float]]
    files: dict[str, int]
    people: dict[str, dict[int, Joints]]

    def jitter(self) -> float:
        """Return the mean length of the joints' second difference over three successive frames, px; NaN without any."""
        lengths = [jitter(frames, 1) for frames in self.people.values()]
        joined = np.concatenate(lengths) if lengths else np.empty(0)
        return float(joined.mean()) if joined.size else float("nan")

    def number(self, truth: Mapping[int | str, Sequence[Keypoints]]) -> dict[int, Sequence[Keypoints]]:
        """Return the true people by frame index, from people by index or by the end of the image's path.

        An image that the run lacks gets an index below zero. InputError if the run has no image that the truth names,
        or two of one name.
        """
        numbered: dict[int, Sequence[Keypoints]] = {}
        for place, (key, people) in enumerate(truth.items()):
            index = self._find(key) if isinstance(key, str) else key
            if index in numbered:
                raise InputError(f"the truth names the image {key} twice; give all people of an image together")
            numbered[-1 - place if index is None else index] = people
        if truth and all(index < 0 for index in numbered):
            raise InputError(f"tracks and truth have no image in common; the truth has {next(iter(truth))}")
        return numbered

    def _find(self, key: str) -> int | None:
        found = [index for path, index in self.files.items() if path == key or path.endswith(f"/{key}")]
        if len(found) > 1:
            raise InputError(f"the run has {len(found)} images {key}; name the images of the truth with their folders")
        return found[0] if found else None


def read_tracks(path: Path) -> Tracks:
    """Read tracks.json or poses.json.

    Raises:
        InputError: if the file cannot be read or has another form.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        names = [str(name) for name in data["joint_names"]]
        frames: dict[int, list[Joints]] = {}
        scores: dict[int, list[float]] = {}
        files: dict[str, int] = {}
        people: dict[str, dict[int, Joints]] = {}
        for frame in data["frames"]:
            index = int(frame["index"])
            frames[index] = [_read_joints(names, puppet) for puppet in frame["puppets"]]
            scores[index] = [read_score(puppet) for puppet in frame["puppets"]]
            if "path" in frame:
                files[Path(frame["path"]).as_posix()] = index
            else:
                for puppet, joints in zip(frame["puppets"], frames[index], strict=True):
                    people.setdefault(str(puppet.get("id", "")), {})[index] = joints
        listed = dict.fromkeys(name for puppets in frames.values() for joints in puppets for name in joints)
        known = (name for name in map(normalise_name, names) if name is not None)
        return Tracks(tuple(listed or dict.fromkeys(known)), frames, scores, files, people)
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
    people = [(found.get(index, []), known_joints(person)) for index, persons in truth.items() for person in persons]
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
    torso, head = (np.array([measure(known) for _, known in people]) for measure in (torso_length, head_length))
    return JointMisses(chosen, distance, torso, head)


def measure_people(tracks: Tracks, truth: Mapping[int, Sequence[Keypoints]], unmatched: Unmatched) -> dict[str, float]:
    """Return OKS AP and AR over the joints that COCO knows, and counts of people, over the images of the truth."""
    tally, images = PeopleTally(), []
    names = [name for name in tracks.names if name in SIGMAS]
    for index, persons in truth.items():
        true = [known_joints(person) for person in persons]
        found, score = tracks.frames.get(index, []), np.array(tracks.scores.get(index, []))
        tally.add(found, true, tracks.names)
        images.append(rate_people(found, score, true, names, unmatched))
    return measure_precision(images) | tally.summarise(unmatched)


def count_by_image(tracks: Tracks, named: Mapping[int | str, Sequence[Keypoints]]) -> dict[str, dict[str, float]]:
    """Return the counts of people in each image of the truth, by its key."""
    counts = {}
    for key, (index, persons) in zip(named, tracks.number(named).items(), strict=True):
        tally = PeopleTally()
        tally.add(tracks.frames.get(index, []), [known_joints(person) for person in persons], tracks.names)
        counts[str(key)] = tally.list_counts()
    return counts


def torso_length(joints: Joints) -> float:
    """Return the distance from a shoulder to the other side's hip, the mean of both if both are known; NaN without."""
    ends = (("left_shoulder", "right_hip"), ("right_shoulder", "left_hip"))
    known = [np.linalg.norm(joints[a] - joints[b]) for a, b in ends if a in joints and b in joints]
    return float(np.mean(known)) if known else float("nan")


def head_length(joints: Joints) -> float:
    """Return the distance from the top of the head to the upper neck; NaN if either is unknown."""
    if "head_top" not in joints or "upper_neck" not in joints:
        return float("nan")
    return float(np.linalg.norm(joints["head_top"] - joints["upper_neck"]))


def known_joints(person: Keypoints) -> Joints:
    """Return the joints (2,) px of keypoints by our names."""
    return {name: np.array(point[:2]) for name, point in person.select_usable().items()}


def read_score(puppet: Mapping[str, Any]) -> float:
    """Return the mean confidence of a puppet's joints in a tracks.json or poses.json; 1 if the file has none."""
    confidence = [row[2] for row in puppet["joints"] if len(row) > 2 and row[2] is not None]
    return float(np.mean(confidence)) if confidence else 1.0


def _read_joints(names: list[str], puppet: dict[str, Any]) -> Joints:
    return name_points(names, np.array(puppet["joints"], dtype=np.float64)[:, :2])
