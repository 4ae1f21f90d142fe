# SPDX-License-Identifier: Apache-2.0
"""The data of the report's 3D view: meshes and points of many stamps, small enough for one page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowing_puppet_ros.report.pictures.bag_pictures import BodyMesh

MAX_FRAMES, MAX_POINTS = 240, 2000  # stamps, and points of each
MAX_BYTES = 6_000_000
"""Maximum bytes of all meshes and points; with many people or a fine mesh fewer stamps are shown."""
MAX_STEPS = 32767  # steps of a position from the centre: 16-bit integers


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The meshes of one stamp's bodies, which share faces and colours, and the points that they were fitted to."""

    seconds: float
    meshes: Sequence[BodyMesh]

    @property
    def points(self) -> np.ndarray:
        """At most MAX_POINTS of the points (N, 3), evenly sampled."""
        points = self.meshes[0].points
        points = points[np.isfinite(points).all(axis=1)]
        return points[:: max(1, -(-len(points) // MAX_POINTS))]


def count_affordable_frames(bodies: int, vertices: int) -> int:
    """Return how many stamps can be shown if each has this many bodies of this many vertices."""
    return max(1, min(MAX_FRAMES, MAX_BYTES // (6 * (bodies * vertices + MAX_POINTS))))


def make_scene_data(frames: Sequence[SceneFrame], forward: np.ndarray, up: np.ndarray) -> Mapping[str, Any]:
    """Return the data for scene.js, ready for JSON: positions as whole steps, rotated so that `up` (3,) is +z.

    `forward` (3,) is where the first person faces and the first view comes from. Positions are exact to half a step,
    which is one 65,534th of the scene's extent.
    """
    rotation = _rotation_to_z_up(up)
    meshes = [np.concatenate([mesh.vertices for mesh in frame.meshes]) @ rotation.T for frame in frames]
    clouds = [frame.points @ rotation.T for frame in frames]
    # Distant outliers must not reduce the resolution of the bodies.
    low, high = _bounds(meshes)
    margin = 0.25 * float((high - low).max())
    clouds = [cloud[((cloud > low - margin) & (cloud < high + margin)).all(axis=1)] for cloud in clouds]
    low, high = low - margin, high + margin
    step, origin = float((high - low).max()) / (2 * MAX_STEPS), (low + high) / 2
    first = frames[0].meshes[0]

    def quantise(points: np.ndarray) -> str:
        return _encode_base64(np.rint((points - origin) / step).astype("<i2"))

    floor = float(min(mesh[:, 2].min() for mesh in meshes))
    first_low, first_high = _bounds(meshes[:1])
    ahead = rotation @ forward
    return {
        "azimuth": float(np.arctan2(ahead[1], ahead[0])),
        "step": step,
        "origin": origin.tolist(),
        "vertices": len(first.vertices),
        "faces": _encode_base64(first.faces.astype("<u4")),
        "colours": _encode_base64(np.rint(first.colours).astype(np.uint8)),
        "centre": ((first_low + first_high) / 2).tolist(),
        "size": float((first_high - first_low).max()),
        "floor": floor,
        "frames": [
            {"t": frame.seconds, "bodies": len(frame.meshes), "mesh": quantise(mesh), "points": quantise(cloud)}
            for frame, mesh, cloud in zip(frames, meshes, clouds, strict=True)
        ],
    }


def _bounds(clouds: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    joined = np.concatenate(clouds)
    return joined.min(axis=0), joined.max(axis=0)


def _encode_base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _rotation_to_z_up(up: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that takes `up` to +z."""
    up = up / np.linalg.norm(up)
    helper = np.eye(3)[int(np.abs(up).argmin())]
    if up[2] > 0.99:
        helper = np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
