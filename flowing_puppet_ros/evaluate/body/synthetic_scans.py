# SPDX-License-Identifier: Apache-2.0
"""Simulated scans of a mesh: whole scans, single depth views, LiDAR rings, with floor and furniture around.

Every point is the first hit of a ray, so hidden surfaces are never seen. Metres, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.extras import import_extra

VIEW_DIRECTIONS = 40  # number of directions that a whole scan is seen from
VIEW_DISTANCE_M = 5.0  # of a whole scan
HIT_TOLERANCE_M = 0.002  # a ray that ends this close to a surface point has hit it
FOCAL_PX, IMAGE_SIZE_PX = 500.0, (640, 576)  # a time-of-flight camera of 65 x 60 degrees
BEAM_STEP, AZIMUTH_STEP, BEAMS = np.radians(0.4), np.radians(0.2), 64  # of the LiDAR


@dataclass(frozen=True, slots=True, eq=False)
class SensedCloud:
    """A simulated scan.

    Attributes:
        points: (N, 3) m.
        normals: (N, 3) unit normals of the surface, or None.
        viewpoint: (3,) m of the sensor; None for a whole scan.
        on_person: (N,) bool, true for the person's points, false for the surroundings.
    """

    points: np.ndarray
    normals: np.ndarray | None
    viewpoint: np.ndarray | None
    on_person: np.ndarray


@dataclass(frozen=True, slots=True)
class DepthSettings:
    """Noise (metres, standard deviation), quantisation (metres) and number of points of a depth view."""

    noise: float = 0.005
    step: float = 0.005
    points: int = 5000


class RaycastScene:
    """A person's mesh and, optionally, its surroundings, to cast rays at."""

    def __init__(
        self, vertices: np.ndarray, triangles: np.ndarray, around: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    ) -> None:
        """Take the person's vertices (V, 3) and triangles (F, 3), and other meshes of the same form."""
        o3d = import_extra("open3d", "scans", "a scan of synthetic people")

        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self.vertices, self.triangles = vertices, triangles
        for points, faces in ((vertices, triangles), *around):
            self._scene.add_triangles(
                self._tensor(np.ascontiguousarray(points, dtype=np.float32)),
                self._tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
            )

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cast rays along unit vectors; return distances (N,) m, infinite without a hit, and person hits (N,) bool."""
        rays = np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=1, dtype=np.float32)
        hits = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        return hits["t_hit"].numpy().astype(np.float64), hits["geometry_ids"].numpy() == 0


def scan_whole(scene: RaycastScene, rng: np.random.Generator, count: int, noise: float = 0.0) -> SensedCloud:
    """Sample `count` surface points with normals, uniform over the surface that is visible from some side.

    `noise` is the standard deviation in every direction, metres.
    """
    points, normals = sample_surface(scene.vertices, scene.triangles, rng, 3 * count)
    seen = np.zeros(len(points), dtype=bool)
    for direction in _spread_directions():
        hidden = np.flatnonzero(~seen & (normals @ direction > 0))
        distance, _ = scene.cast(points[hidden] + VIEW_DISTANCE_M * direction, np.tile(-direction, (len(hidden), 1)))
        seen[hidden] = np.abs(distance - VIEW_DISTANCE_M) < HIT_TOLERANCE_M
    chosen = np.flatnonzero(seen)[:count]
    sensed = points[chosen] + noise * rng.standard_normal((len(chosen), 3))
    return SensedCloud(sensed, normals[chosen], None, np.ones(len(chosen), dtype=bool))


def scan_depth(scene: RaycastScene, rng: np.random.Generator, eye: np.ndarray, settings: DepthSettings) -> SensedCloud:
    """Simulate a depth camera at `eye` (3,) m that looks at the person; without normals."""
    target = (scene.vertices.min(axis=0) + scene.vertices.max(axis=0)) / 2
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    width, height = IMAGE_SIZE_PX
    u, v = np.meshgrid((np.arange(width) - width / 2) / FOCAL_PX, (np.arange(height) - height / 2) / FOCAL_PX)
    rays = forward + u.reshape(-1, 1) * right + v.reshape(-1, 1) * np.cross(forward, right)
    length = np.linalg.norm(rays, axis=1)
    distance, on_person = scene.cast(eye, rays / length[:, None])
    hit = np.isfinite(distance)
    depth = distance[hit] / length[hit] + settings.noise * rng.standard_normal(int(hit.sum()))
    points = eye + rays[hit] * (settings.step * np.round(depth / settings.step))[:, None]
    chosen = np.sort(rng.permutation(len(points))[: settings.points])
    return SensedCloud(points[chosen], None, eye, on_person[hit][chosen])


def scan_lidar(scene: RaycastScene, rng: np.random.Generator, eye: np.ndarray, noise: float = 0.02) -> SensedCloud:
    """Simulate a spinning LiDAR at `eye` (3,) m: 64 rings 0.4 degrees apart, 0.2 degrees between points of a ring.

    `noise` is the standard deviation of the range, metres.
    """
    ahead = (scene.vertices.min(axis=0) + scene.vertices.max(axis=0)) / 2 - eye
    middle = np.arctan2(ahead[1], ahead[0]) + rng.uniform(0, AZIMUTH_STEP)
    azimuth = middle + AZIMUTH_STEP * np.arange(-150, 151)
    # The rings are spread evenly about the direction to the person's middle.
    elevation = np.arctan2(ahead[2], np.hypot(*ahead[:2])) + BEAM_STEP * (np.arange(BEAMS) - BEAMS / 2 + rng.random())
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    distance, on_person = scene.cast(eye, rays)
    hit = np.isfinite(distance)
    ranged = distance[hit] + noise * rng.standard_normal(int(hit.sum()))
    return SensedCloud(eye + rays[hit] * ranged[:, None], None, eye, on_person[hit])


def draw_sensor_position(
    rng: np.random.Generator, body: np.ndarray, distance: tuple[float, float], height: tuple[float, float]
) -> np.ndarray:
    """Draw a position (3,) m at a horizontal distance from the middle of body vertices (V, 3) m and at a height."""
    middle, angle, away = body.mean(axis=0), rng.uniform(-np.pi, np.pi), rng.uniform(*distance)
    return np.array([middle[0] + away * np.cos(angle), middle[1] + away * np.sin(angle), rng.uniform(*height)])


def make_furniture(rng: np.random.Generator, body: np.ndarray, eye: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Make a floor, a wall behind the person, and boxes beside and behind them that do not hide them from `eye`."""
    middle = body.mean(axis=0) * [1.0, 1.0, 0.0]
    away = (middle - eye) * [1.0, 1.0, 0.0]
    away /= np.linalg.norm(away)
    side = np.array([-away[1], away[0], 0.0])
    frame = np.stack([away, side, [0.0, 0.0, 1.0]], axis=1)
    meshes = [make_box(middle + np.array([0, 0, -0.05]), np.array([12.0, 12.0, 0.1]), frame)]
    meshes.append(
        make_box(middle + rng.uniform(1.2, 2.5) * away + np.array([0, 0, 1.25]), np.array([0.1, 8.0, 2.5]), frame)
    )
    for _ in range(3):
        size = rng.uniform((0.3, 0.3, 0.4), (0.8, 0.8, 1.1))
        beside = rng.choice([-1.0, 1.0]) * rng.uniform(1.2, 1.8)
        place = middle + beside * side + rng.uniform(-0.3, 0.8) * away
        meshes.append(make_box(place + np.array([0, 0, size[2] / 2]), size, frame))
    return meshes


def make_box(middle: np.ndarray, size: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (8, 3) and outward triangles (12, 3) of a box with axes along the columns of `frame` (3, 3)."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return middle + (corners * size) @ frame.T, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def sample_surface(
    vertices: np.ndarray, triangles: np.ndarray, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sample `count` points (N, 3) uniformly over a mesh, in random order, and their unit normals (N, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    owner = rng.choice(len(triangles), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    points = a[owner] + u * (b - a)[owner] + v * (c - a)[owner]
    return points, normal[owner] / area[owner, None]


def _spread_directions() -> np.ndarray:
    """Return directions (VIEW_DIRECTIONS, 3) spread over the sphere on a Fibonacci spiral."""
    index = np.arange(VIEW_DIRECTIONS) + 0.5
    polar, around = np.arccos(1 - 2 * index / VIEW_DIRECTIONS), np.pi * (1 + 5**0.5) * index
    return np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
