# SPDX-License-Identifier: Apache-2.0
"""What the report's 3D view shows: the meshes of many stamps and the points around them, small enough for one page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.report.bag_pictures import BodyMesh

FRAMES, POINTS = 240, 2000
BUDGET = 6_000_000
"""Bytes of all meshes and points; with many people or a fine mesh fewer stamps are shown."""
LARGEST = 32767


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The meshes of one stamp's bodies, which share faces and colours, and the points that they were fitted to."""

    seconds: float
    meshes: Sequence[BodyMesh]

    @property
    def points(self) -> np.ndarray:
        """At most 2000 of the points (N, 3), evenly taken."""
        points = self.meshes[0].points
        points = points[np.isfinite(points).all(axis=1)]
        return points[:: max(1, -(-len(points) // POINTS))]


def frames_in_budget(bodies: int, vertices: int) -> int:
    """How many stamps may be shown when each has so many bodies of so many vertices."""
    return max(1, min(FRAMES, BUDGET // (6 * (bodies * vertices + POINTS))))


def scene_data(frames: Sequence[SceneFrame], forward: np.ndarray, up: np.ndarray) -> Mapping[str, Any]:
    """What scene.js reads, for JSON: places as whole numbers of a step, turned so that `up` (3,) is +z.

    `forward` (3,) is where the first person faces and the first view comes from.

    Places are exact to half a step, one 65,534th of the scene's extent.
    """
    turn = _upright(up)
    meshes = [np.concatenate([mesh.vertices for mesh in frame.meshes]) @ turn.T for frame in frames]
    clouds = [frame.points @ turn.T for frame in frames]
    # Stray points far away must not make the bodies coarse.
    low, high = _bounds(meshes)
    margin = 0.25 * float((high - low).max())
    clouds = [cloud[((cloud > low - margin) & (cloud < high + margin)).all(axis=1)] for cloud in clouds]
    low, high = low - margin, high + margin
    step, origin = float((high - low).max()) / (2 * LARGEST), (low + high) / 2
    first = frames[0].meshes[0]

    def whole(places: np.ndarray) -> str:
        return _text(np.rint((places - origin) / step).astype("<i2"))

    floor = float(min(mesh[:, 2].min() for mesh in meshes))
    middle, extent = _bounds(meshes[:1])
    ahead = turn @ forward
    return {
        "azimuth": float(np.arctan2(ahead[1], ahead[0])),
        "step": step,
        "origin": origin.tolist(),
        "vertices": len(first.vertices),
        "faces": _text(first.faces.astype("<u4")),
        "colours": _text(np.rint(first.colours).astype(np.uint8)),
        "centre": ((middle + extent) / 2).tolist(),
        "size": float((extent - middle).max()),
        "floor": floor,
        "frames": [
            {"t": frame.seconds, "bodies": len(frame.meshes), "mesh": whole(mesh), "points": whole(cloud)}
            for frame, mesh, cloud in zip(frames, meshes, clouds, strict=True)
        ],
    }


def _bounds(clouds: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    joined = np.concatenate(clouds)
    return joined.min(axis=0), joined.max(axis=0)


def _text(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _upright(up: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) that takes `up` to +z."""
    up = up / np.linalg.norm(up)
    helper = np.eye(3)[int(np.abs(up).argmin())]
    if up[2] > 0.99:
        helper = np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
