# SPDX-License-Identifier: Apache-2.0
"""The people that a scan of a scene is known to show, read from and written to JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError

MAX_BOX_RADIUS_M, BOX_MARGIN_M = 0.5, 0.3
"""Radius about a label's middle and height over its box within which its topmost point is looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPerson:
    """A person in a scan.

    Attributes:
        middle: (2,) metres, x and y.
        floor: metres, z of the floor under the person.
        stature: metres; NaN where it is not known.
        points: number of the scan's points on the person.
        top: metres over the floor of the topmost of these points.
        joints: joints by name, (3,) metres; empty where they are not known.
    """

    middle: np.ndarray
    floor: float
    stature: float
    points: int
    top: float
    joints: dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class LabelledScene:
    """What is known about a scan: its `people`, and where its `sensor` (3,) m is."""

    people: list[LabelledPerson]
    sensor: np.ndarray


def read_labels(path: Path) -> dict[str, Any]:
    """Read the labels of many scans, by the stem of their files.

    Raises:
        InputError: when the file cannot be read or is no table of scans.
    """
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as labels in JSON: {error}") from error
    if not isinstance(table, dict):
        raise InputError(f"{path} holds no table of scans by name; see `flowing-puppet evaluate scenes --help`")
    return table


def label_scene(entry: Any, points: np.ndarray, name: str) -> LabelledScene:
    """Return the labels of one scan with `points` (N, 3) m.

    `entry` is a list of people, or a table with `people` and the place of the `sensor` (x, y, z), the origin if left
    out. A person has `centre` (x, y, z) of the box and `height_width_length` in metres, and may have the number of
    `points` and `joints` by name. Boxes of a `class` other than pedestrian, person or people are ignored.

    Raises:
        InputError: when the entry has another form.
    """
    try:
        boxes = entry["people"] if isinstance(entry, dict) else entry
        sensor = np.array(entry.get("sensor", (0, 0, 0)) if isinstance(entry, dict) else (0, 0, 0), dtype=np.float64)
        people = [_label_person(box, points) for box in boxes if _is_person(box)]
    except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"the label of {name} has another form than expected: {error!r}") from error
    return LabelledScene(people, sensor.reshape(3))


def _is_person(box: dict[str, Any]) -> bool:
    return str(box.get("class", "person")).lower() in ("pedestrian", "person", "people")


def _label_person(box: dict[str, Any], points: np.ndarray) -> LabelledPerson:
    centre = np.array(box["centre"], dtype=np.float64)
    height = float(box["height_width_length"][0])
    floor = float(centre[2]) - height / 2
    near = points[np.hypot(*(points[:, :2] - centre[:2]).T) < MAX_BOX_RADIUS_M]
    near = near[(near[:, 2] >= floor) & (near[:, 2] < floor + height + BOX_MARGIN_M)]
    joints = {str(key): np.array(value, dtype=np.float64) for key, value in box.get("joints", {}).items()}
    return LabelledPerson(
        middle=centre[:2],
        floor=floor,
        stature=float(box.get("stature", height)),
        points=int(box.get("points", len(near))),
        top=float(near[:, 2].max() - floor) if len(near) else 0.0,
        joints=joints,
    )
