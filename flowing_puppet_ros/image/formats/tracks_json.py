# SPDX-License-Identifier: Apache-2.0
"""JSON files of the command line: keypoints that start and re-anchor people, and the resulting tracks.

    keypoints.json  {"joint_names": [...], "frames": {"0": [[[x, y, confidence], ...], ...]}}   people per frame
    tracks.json     {"joint_names": [...], "fps": f, "frames": [{"index", "path", "stamp_ns", "puppets": [...]}]}

Pixels of the input, person's left and right; NaN is written as null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints, normalise_name
from flowing_puppet_ros.image.formats.stick_regression import StickRegression
from flowing_puppet_ros.image.formats.stickmen import read_sticks
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.model.tree import PartTree

DECIMALS = 2  # of a pixel
MAX_INDEX_DIGITS = 18  # of a frame's index; longer ones are refused


class PuppetLike(Protocol):
    """The fields of one person in one image that the files hold, see `tracker.TrackedPuppet`."""

    @property
    def id(self) -> str:
        """Name of the person."""
        ...

    @property
    def view(self) -> View:
        """Side that the camera sees."""
        ...

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        ...

    @property
    def energy(self) -> float:
        """Energy in nats; lower is more likely."""
        ...

    @property
    def joints(self) -> F64:
        """Joints (J, 2) px."""
        ...

    @property
    def confidence(self) -> F64:
        """Confidence (J,) in [0, 1]."""
        ...

    @property
    def contours(self) -> tuple[F64, ...]:
        """Outline (K_i, 2) px of each part."""
        ...

    @property
    def depth(self) -> tuple[int, ...]:
        """Paint order of each part, 0 is farthest."""
        ...


def read_keypoints(path: str | Path) -> dict[int, list[Keypoints]]:
    """Read keypoints.json or sticks.txt: {frame index: people}. No detector ran on a frame that is not listed.

    Sticks are converted to puppets, see `stick_regression`. InputError, naming the entry, for any other file.
    """
    if Path(path).suffix.lower() == ".txt":
        regression = StickRegression(DeformableStructures.load())
        return {
            number: [regression.to_keypoints(sticks) for sticks in people]
            for number, people in read_sticks(Path(path)).items()
        }
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("frames"), dict):
        raise InputError(f'{path} needs "joint_names" and "frames": {{"0": [[[x, y, confidence], ...], ...]}}')
    names = data.get("joint_names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f'{path} needs "joint_names", a list of strings')
    if not any(normalise_name(name) for name in names):
        raise InputError(f"{path} has no known joint name, only {names[:3]} and the like")
    frames: dict[int, list[Keypoints]] = {}
    for key, people in data["frames"].items():
        if not key.isdecimal() or len(key) > MAX_INDEX_DIGITS or not isinstance(people, list):
            raise InputError(f"{path}: frame {key[:MAX_INDEX_DIGITS]!r} must be an index with a list of people")
        frames[int(key)] = [_parse_person(tuple(names), rows, f"{path}, frame {key}") for rows in people]
    if not any(frames.values()):
        raise InputError(f"{path} has no person in any frame")
    return frames


def _parse_person(names: tuple[str, ...], rows: Any, where: str) -> Keypoints:
    try:
        # null, the JSON for an unknown number, becomes NaN.
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (len(names), 3):
        raise InputError(f"{where}: a person needs {len(names)} entries [x, y, confidence], one per joint name")
    return Keypoints(names, values[:, :2], np.nan_to_num(values[:, 2]))


def puppet_to_json(puppet: PuppetLike, tree: PartTree) -> dict[str, Any]:
    """Convert a puppet to its JSON object."""
    joints = [
        [_round_or_null(x), _round_or_null(y), _round_or_null(confidence, 3)]
        for (x, y), confidence in zip(puppet.joints, puppet.confidence, strict=True)
    ]
    parts = [
        {"name": name, "contour": [[_round_or_null(x), _round_or_null(y)] for x, y in contour], "depth": depth}
        for name, contour, depth in zip(tree.names, puppet.contours, puppet.depth, strict=True)
    ]
    scale, energy = _round_or_null(puppet.scale), _round_or_null(puppet.energy, 4)
    return {"id": puppet.id, "view": puppet.view, "scale": scale, "energy": energy, "joints": joints, "parts": parts}


def _round_or_null(value: float, decimals: int = DECIMALS) -> float | None:
    return round(float(value), decimals) if math.isfinite(value) else None


def write_tracks(path: str | Path, joint_names: tuple[str, ...], fps: float, frames: Iterable[dict[str, Any]]) -> None:
    """Write tracks.json frame by frame and move it into place once complete; InputError when it cannot be written."""
    place = Path(path)
    draft = place.with_name(f".{place.name}.part")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("w", encoding="utf-8") as file:
            file.write(f'{{"joint_names": {json.dumps(list(joint_names))}, "fps": {json.dumps(fps)}, "frames": [')
            for number, frame in enumerate(frames):
                file.write(("," if number else "") + "\n" + json.dumps(frame, allow_nan=False))
            file.write("\n]}\n")
        draft.replace(place)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        draft.unlink(missing_ok=True)
