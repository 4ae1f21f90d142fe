# SPDX-License-Identifier: Apache-2.0
"""The people who were really there, from a file or a bag, and the bodies of a replay's bag set against them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from flowing_puppet_ros.bag.paths import is_bag
from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.body.scans.scan_correspondence import closest_on_mesh
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Joints, Recording, body_joints, read_recording
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns

FAR = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """One person at one stamp: joints by our names, and the vertices (V, 3) of their surface or None; metres."""

    joints: Joints
    vertices: np.ndarray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class People:
    """People {stamp in ns: those of the stamp}, and the triangles (F, 3) that every surface has."""

    at: dict[int, list[Person]]
    triangles: np.ndarray


def read_truth(path: Path) -> People:
    """Read who was there from a bag with BodyArray messages, or from JSON.

    The JSON is {"stamp in ns": {"joint": [x, y, z in metres]}}, or with a list of such people a stamp. InputError when
    it has another form.
    """
    if is_bag(path):
        with open_bag(path, salvage=True) as bag:
            return people_of(bag, read_recording(bag, bag))
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        at = {}
        for stamp, given in data.items():
            listed = given if isinstance(given, list) else [given]
            at[int(stamp)] = [Person({str(name): _place(place) for name, place in one.items()}) for one in listed]
        return People(at, np.zeros((0, 3), np.int64))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f'{path} is not of the form {{"stamp in ns": {{"joint": [x, y, z]}}}}') from error


def people_of(bag: Bag, recording: Recording) -> People:
    """The bodies of a bag with their surfaces, as far as it has `body_vertices` and `body_topology`."""
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
            Person(body_joints(body), surface[count * k : count * (k + 1)] if whole else None)
            for k, body in enumerate(bodies)
        ]
    return People(at, recording.triangles)


def matched(found: People, truth: People) -> list[tuple[int, Person, Person | None]]:
    """Every true person (stamp, truth, found) with the nearest body of their stamp, no body twice; None when missed."""
    pairs: list[tuple[int, Person, Person | None]] = []
    for stamp in sorted(truth.at):
        true, bodies = truth.at[stamp], found.at.get(stamp, [])
        cost = np.array([[_apart(one.joints, body.joints) for body in bodies] for one in true])
        rows, columns = linear_sum_assignment(cost) if bodies else ((), ())
        chosen = {row: bodies[column] for row, column in zip(rows, columns, strict=True) if cost[row, column] < FAR}
        pairs += [(stamp, person, chosen.get(row)) for row, person in enumerate(true)]
    return pairs


def to_surface(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Mean distance of points (N, 3) to a mesh, in their unit."""
    found = closest_on_mesh(points, None, vertices, triangles).points(vertices, triangles)
    return float(np.linalg.norm(found - points, axis=1).mean())


def _apart(joints: Joints, other: Joints) -> float:
    common = [name for name in joints if name in other]
    return float(np.mean([np.linalg.norm(joints[name] - other[name]) for name in common])) if common else FAR


def _place(values: Any) -> np.ndarray:
    place = np.array(values, dtype=np.float64)
    if place.shape != (3,):
        raise ValueError("a place has three coordinates")
    return place
