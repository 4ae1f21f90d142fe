# SPDX-License-Identifier: Apache-2.0
"""The true people, from a file or a bag, matched with the bodies of a replay's bag."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.bag.reader import Bag, is_bag, open_bag
from flowing_puppet_ros.body.scans.scan_correspondence import find_closest_on_mesh
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Joints, Recording, body_joints, read_recording
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns

MISSED_COST = 1e6  # metres: distance between people without a common joint


@dataclass(frozen=True, slots=True, eq=False)
class PersonGeometry:
    """One person at one stamp: `joints` by our names, and surface `vertices` (V, 3) or None, in metres."""

    joints: Joints
    vertices: np.ndarray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PeopleByStamp:
    """People by stamp in ns, and the `triangles` (F, 3) of every surface."""

    at: dict[int, list[PersonGeometry]]
    triangles: np.ndarray


def read_truth(path: Path) -> PeopleByStamp:
    """Read the true people from a bag with BodyArray messages, or from JSON.

    The JSON is {"stamp in ns": {"joint": [x, y, z in metres]}}, or has a list of such people per stamp. InputError if
    it has another form.
    """
    if is_bag(path):
        with open_bag(path, salvage=True) as bag:
            return read_bodies(bag, read_recording(bag, bag))
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        at = {}
        for stamp, given in data.items():
            listed = given if isinstance(given, list) else [given]
            at[int(stamp)] = [
                PersonGeometry({str(name): _parse_point(place) for name, place in one.items()}) for one in listed
            ]
        return PeopleByStamp(at, np.zeros((0, 3), np.int64))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f'{path} is not of the form {{"stamp in ns": {{"joint": [x, y, z]}}}}') from error


def read_bodies(bag: Bag, recording: Recording) -> PeopleByStamp:
    """Read the bodies of a bag, with their surfaces if it has `body_vertices` and `body_topology`."""
    vertices: dict[int, np.ndarray] = {}
    topic = recording.cloud_topics.get("body_vertices")
    if topic and len(recording.triangles):
        vertices = {stamp_ns(record.message): decode_cloud(record.message)[0] for record in bag.messages([topic])}
    count = int(recording.triangles.max()) + 1 if len(recording.triangles) else 0
    at = {}
    for stamp, bodies in recording.bodies.items():
        surface = vertices.get(stamp, np.zeros((0, 3)))
        whole = count > 0 and len(surface) == count * len(bodies)
        at[stamp] = [
            PersonGeometry(body_joints(body), surface[count * k : count * (k + 1)] if whole else None)
            for k, body in enumerate(bodies)
        ]
    return PeopleByStamp(at, recording.triangles)


def match_bodies(found: PeopleByStamp, truth: PeopleByStamp) -> list[tuple[int, PersonGeometry, PersonGeometry | None]]:
    """Match true people and bodies of a stamp one to one; return (stamp, truth, found), found None if missed."""
    pairs: list[tuple[int, PersonGeometry, PersonGeometry | None]] = []
    for stamp in sorted(truth.at):
        true, bodies = truth.at[stamp], found.at.get(stamp, [])
        cost = np.array([[_mean_joint_distance(one.joints, body.joints) for body in bodies] for one in true])
        rows, columns = linear_sum_assignment(cost) if bodies else ((), ())
        chosen = {
            row: bodies[column] for row, column in zip(rows, columns, strict=True) if cost[row, column] < MISSED_COST
        }
        pairs += [(stamp, person, chosen.get(row)) for row, person in enumerate(true)]
    return pairs


def distance_to_surface(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Return the mean distance of points (N, 3) from a mesh, in their unit."""
    found = find_closest_on_mesh(points, None, vertices, triangles).interpolate(vertices, triangles)
    return float(np.linalg.norm(found - points, axis=1).mean())


def _mean_joint_distance(joints: Joints, other: Joints) -> float:
    common = [name for name in joints if name in other]
    return float(np.mean([np.linalg.norm(joints[name] - other[name]) for name in common])) if common else MISSED_COST


def _parse_point(values: Any) -> np.ndarray:
    place = np.array(values, dtype=np.float64)
    if place.shape != (3,):
        raise ValueError("a point has three coordinates")
    return place
