# SPDX-License-Identifier: Apache-2.0
"""How well surface points explain a cloud: closest points by a voxel grid, and the data term (thesis Eqs. 52-54).

A grid cell stores the cloud point nearest to its centre, so a look-up is one array access. The distance is then
computed exactly to that point; what is approximate is only which point is taken, by at most a cell's diagonal. The
cells are filled by a vector distance transform (Danielsson, Euclidean Distance Mapping, 1980): each takes the best of
the points that the cells around it have taken, which may miss the nearest one by some millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints

MAX_CELLS = 2_000_000  # a grid of more would take too much memory; its cells are made larger instead
DISTANCE_OFFSET = 0.001  # square metres, of Eq. 53 ...
DISTANCE_POWER = 0.45  # ... whose robust distance is (d^2 + offset)^power
MISMATCH_COSINE = np.cos(0.75 * np.pi)  # normals farther apart contradict each other (R of Eq. 52)


class DataCost(Protocol):
    """A cloud that surface points are compared with."""

    def data_cost(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return costs as `CloudGrid.data_cost` does."""


@dataclass(frozen=True, slots=True, eq=False)
class ExactCloud:
    """A cloud whose nearest points are found exactly: for one body rather than many particles.

    Attributes:
        points: (N, 3) metres.
        normals: (N, 3) unit vectors pointing out of the body.
        tree: of `points`.
    """

    points: np.ndarray
    normals: np.ndarray
    tree: NearestPoints

    def data_cost(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as `CloudGrid.data_cost`, with the exact closest points (Eqs. 53 and 54)."""
        distance, index = self.tree.query(points.reshape(-1, 3))
        distance, index = distance.reshape(points.shape[:-1]), index.reshape(points.shape[:-1])
        cosine = (normals * self.normals[index]).sum(axis=-1)
        cost = ((distance**2 + DISTANCE_OFFSET) ** DISTANCE_POWER).mean(axis=-1)
        return cost, (cosine < MISMATCH_COSINE).mean(axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class CloudGrid:
    """A cloud with its grid of nearest points.

    Attributes:
        points: (N, 3) float64 metres.
        normals: (N, 3) float64 unit vectors pointing out of the body.
        origin: (3,) centre of the first cell, metres.
        cell: edge of a cell, metres.
        nearest: (nx, ny, nz) int32, index of the point nearest to the cell's centre.
    """

    points: np.ndarray
    normals: np.ndarray
    origin: np.ndarray
    cell: float
    nearest: np.ndarray

    @classmethod
    def build(cls, points: np.ndarray, normals: np.ndarray, cell: float = 0.025, margin: float = 0.25) -> CloudGrid:
        """Index a cloud.

        Args:
            points: (N, 3) metres, N > 0.
            normals: (N, 3) unit normals.
            cell: edge of a cell in metres; made larger if the grid would have more than MAX_CELLS.
            margin: how far the grid reaches beyond the cloud, metres; a point farther out is looked up at the border.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        cell = max(cell, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
        shape = np.ceil((high - low) / cell).astype(np.int64) + 1
        nearest = fill_nearest(points, low, cell, shape)
        return cls(points, np.ascontiguousarray(normals, dtype=np.float64), low, cell, nearest)

    def data_cost(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Eq. 53 and the share of normals that contradict the cloud's, for many sets of surface points at once.

        Args:
            points: (P, K, 3) metres.
            normals: (P, K, 3) unit normals.

        Returns:
            Mean robust distance (P,), (d^2 + 0.001)^0.45 with d of Eq. 54 in metres, and (P,) the fraction of points
            whose normal is more than 3/4 pi away from that of the closest cloud point (0 to 1; the indicator of R in
            Eq. 52 divided by the number of points, so that it does not depend on the template's resolution).
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        normals = np.ascontiguousarray(normals, dtype=np.float64)
        return _data_cost(self.points, self.normals, self.nearest, self.origin, self.cell, points, normals)


def fill_nearest(points: np.ndarray, low: np.ndarray, cell: float, shape: np.ndarray) -> np.ndarray:
    """Return for each cell of a grid (shape, int32) the point nearest to its centre, give or take some millimetres.

    Args:
        points: (N, 3), within the grid.
        low: (3,) centre of the first cell.
        cell: edge of a cell.
        shape: (3,) number of cells along each axis.
    """
    nearest, distance = np.full(shape, -1, dtype=np.int32), np.full(shape, np.inf)
    _scatter(points, low, cell, nearest, distance)
    _sweep(points, low, cell, nearest, distance)
    return nearest


@njit(cache=True, nogil=True)
def _scatter(points: np.ndarray, low: np.ndarray, cell: float, nearest: np.ndarray, distance: np.ndarray) -> None:
    """Store every point in its cell and the 26 around it if it is nearer to their centres than the stored one."""
    for p in range(len(points)):
        home = (
            int(np.floor((points[p, 0] - low[0]) / cell + 0.5)),
            int(np.floor((points[p, 1] - low[1]) / cell + 0.5)),
            int(np.floor((points[p, 2] - low[2]) / cell + 0.5)),
        )
        for i in range(max(home[0] - 1, 0), min(home[0] + 2, nearest.shape[0])):
            for j in range(max(home[1] - 1, 0), min(home[1] + 2, nearest.shape[1])):
                for k in range(max(home[2] - 1, 0), min(home[2] + 2, nearest.shape[2])):
                    x = low[0] + cell * i - points[p, 0]
                    y = low[1] + cell * j - points[p, 1]
                    z = low[2] + cell * k - points[p, 2]
                    squared = x * x + y * y + z * z
                    if squared < distance[i, j, k]:
                        distance[i, j, k], nearest[i, j, k] = squared, p


@njit(cache=True, nogil=True)
def _list_half(layers: int) -> np.ndarray:
    """Return the steps (13, 3) to the cells around one that come before it, (4, 3) in a grid of one layer."""
    steps, count = np.empty((13, 3), np.int64), 0
    for a in (-1, 0):
        for b in range(-1, 2 if a else 1):
            for c in range(-1, 2 if a or b else 0):
                if layers > 1 or c == 0:
                    steps[count, 0], steps[count, 1], steps[count, 2] = a, b, c
                    count += 1
    return steps[:count]


@njit(cache=True, nogil=True)
def _sweep(points: np.ndarray, low: np.ndarray, cell: float, nearest: np.ndarray, distance: np.ndarray) -> None:
    """Give every cell the nearest of the points of the 26 around it, once through the grid and once back.

    A pass looks at the half of them that it has already been to.
    """
    nx, ny, nz = nearest.shape
    steps = _list_half(nz)
    for way in (1, -1):
        for i in range(nx) if way == 1 else range(nx - 1, -1, -1):
            for j in range(ny) if way == 1 else range(ny - 1, -1, -1):
                for k in range(nz) if way == 1 else range(nz - 1, -1, -1):
                    best, least = nearest[i, j, k], distance[i, j, k]
                    for s in range(len(steps)):
                        x, y, z = i + way * steps[s, 0], j + way * steps[s, 1], k + way * steps[s, 2]
                        if not (0 <= x < nx and 0 <= y < ny and 0 <= z < nz):
                            continue
                        found = nearest[x, y, z]
                        if found < 0 or found == best:
                            continue
                        dx = low[0] + cell * i - points[found, 0]
                        dy = low[1] + cell * j - points[found, 1]
                        dz = low[2] + cell * k - points[found, 2]
                        squared = dx * dx + dy * dy + dz * dz
                        if squared < least:
                            best, least = found, squared
                    nearest[i, j, k], distance[i, j, k] = best, least


@njit(cache=True, inline="always")
def look_up(nearest: np.ndarray, origin: np.ndarray, cell: float, x: float, y: float, z: float) -> int:
    """Return the index that the grid stores for the cell of (x, y, z), clamped to the grid."""
    i = min(max(int(np.floor((x - origin[0]) / cell + 0.5)), 0), nearest.shape[0] - 1)
    j = min(max(int(np.floor((y - origin[1]) / cell + 0.5)), 0), nearest.shape[1] - 1)
    k = min(max(int(np.floor((z - origin[2]) / cell + 0.5)), 0), nearest.shape[2] - 1)
    return nearest[i, j, k]


@njit(cache=True, nogil=True)
def _data_cost(
    cloud: np.ndarray,
    cloud_normals: np.ndarray,
    nearest: np.ndarray,
    origin: np.ndarray,
    cell: float,
    points: np.ndarray,
    normals: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    particles, count = points.shape[:2]
    cost = np.zeros(particles)
    mismatch = np.zeros(particles)
    for p in range(particles):
        for k in range(count):
            x, y, z = points[p, k, 0], points[p, k, 1], points[p, k, 2]
            found = look_up(nearest, origin, cell, x, y, z)
            dx, dy, dz = x - cloud[found, 0], y - cloud[found, 1], z - cloud[found, 2]
            cost[p] += (dx * dx + dy * dy + dz * dz + DISTANCE_OFFSET) ** DISTANCE_POWER
            cosine = 0.0
            for axis in range(3):
                cosine += normals[p, k, axis] * cloud_normals[found, axis]
            if cosine < MISMATCH_COSINE:
                mismatch[p] += 1.0
        cost[p] /= count
        mismatch[p] /= count
    return cost, mismatch
