# SPDX-License-Identifier: Apache-2.0
"""The JSON files that `track` and `pose` write.

    {"joint_names": [...], "fps": f, "frames": [{"index", "path", "stamp_ns", "puppets": [...]}]}

Pixels of the input, person's left and right; NaN is written as null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.model.tree import PartTree

DECIMALS = 2  # of a pixel


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
