# SPDX-License-Identifier: Apache-2.0
"""The nearest neighbours of every point of a cloud, and the normals of the planes that lie best in them.

Cells are so large that a point's neighbours lie in its cell and the 26 around it, which are read once for all points of
the cell.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from flowing_puppet_ros.evidence.cloud.nearest import find_bounds, gap_beyond_rings, sort_by_cell

MEAN_SHARE = 0.4
"""Points in a point's own cell, in neighbours, on the mean."""
MAX_CELLS = 300_000  # of the grid's bounding box; larger boxes get larger cells
MAX_SHARE = 20
"""Points of the fullest cell, in neighbours, from which on a k-d tree is faster."""
BINS = 64  # of squared distances
MAX_RINGS = 3
"""Rings of cells around a cell that are read before the k-d tree is used."""


def find_neighbours(points: np.ndarray, count: int, every: int = 1) -> np.ndarray:
    """Return the indices (M, K) of the K nearest of `points` (N, 3) to each, in any order, itself among them.

    K is `count`, or N where there are fewer points. M is N, or as many as there are of `every` second, third ... point.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    count = min(count, len(points))
    low, high = find_bounds(points)
    min_cell = max(float(np.prod((high - low) / MAX_CELLS ** (1 / 3))) ** (1 / 3), 1e-9)
    # First as if the cloud were as wide as high, then by the points that are really in the cells of that size.
    cell = max(float((high - low).max()) * np.sqrt(MEAN_SHARE * count / len(points)), min_cell)
    shape, rows, start = _make_grid(points, low, high, cell)
    held = np.diff(start)
    cell = max(cell * float(np.sqrt(MEAN_SHARE * count * len(points) / (held @ held))), min_cell)
    shape, rows, start = _make_grid(points, low, high, cell)
    held = np.diff(start)
    if held.max() <= MAX_SHARE * count:
        found = _find_in_grid(points[rows], rows, start, low, cell, shape, count, every)
        open_rows = np.flatnonzero(found[:, 0] < 0)
    else:
        found = np.empty((len(points[::every]), count), dtype=np.int64)
        open_rows = np.arange(len(found))
    if len(open_rows):
        found[open_rows] = cKDTree(points).query(points[every * open_rows], k=count)[1].reshape(-1, count)
    return found


def fit_normals(points: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return unit normals (N, 3), of either sign, of the planes through each point's `neighbours` (N, K).

    They are the eigenvectors of the smallest eigenvalues of the neighbours' covariances; z where all are in one place.
    """
    return _fit_normals(np.ascontiguousarray(points, dtype=np.float64), neighbours)


def _make_grid(
    points: np.ndarray, low: np.ndarray, high: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the number of cells along each axis, the rows (N,) sorted by cell, and where each cell's begin."""
    shape = np.floor((high - low) / cell).astype(np.int64) + 1
    return shape, *sort_by_cell(points, low, cell, shape)


@njit(cache=True, nogil=True)
def _find_in_grid(points, rows, start, low, cell, shape, count, every):  # type: ignore[no-untyped-def]
    """Return the neighbours of each row; -1 where they may lie beyond the cells around. `points` are sorted by cell."""
    found = np.full(((len(points) + every - 1) // every, count), -1, np.int64)
    nx, ny, nz = shape[0], shape[1], shape[2]
    places, around_xyz = np.empty(len(points), np.int64), np.empty((3, len(points)))
    squared, bins = np.empty(len(points)), np.empty(len(points), np.int64)
    for a in range(nx):
        for b in range(ny):
            for c in range(nz):
                home = (a * ny + b) * nz + c
                missing = 0
                for own in range(start[home], start[home + 1]):
                    missing += rows[own] % every == 0
                for ring in range(1, MAX_RINGS + 1):
                    if missing == 0:
                        break
                    around = 0
                    for i in range(max(a - ring, 0), min(a + ring + 1, nx)):
                        for j in range(max(b - ring, 0), min(b + ring + 1, ny)):
                            column = (i * ny + j) * nz
                            first, last = start[column + max(c - ring, 0)], start[column + min(c + ring, nz - 1) + 1]
                            for place in range(first, last):
                                places[around] = rows[place]
                                for axis in range(3):
                                    around_xyz[axis, around] = points[place, axis]
                                around += 1
                    for own in range(start[home], start[home + 1]):
                        if rows[own] % every or found[rows[own] // every, 0] >= 0:
                            continue
                        x, y, z = points[own, 0], points[own, 1], points[own, 2]
                        gap = min(
                            gap_beyond_rings(x, low[0], cell, nx, a, ring),
                            gap_beyond_rings(y, low[1], cell, ny, b, ring),
                            gap_beyond_rings(z, low[2], cell, nz, c, ring),
                        )
                        for k in range(around):
                            squared[k] = (
                                (x - around_xyz[0, k]) ** 2 + (y - around_xyz[1, k]) ** 2 + (z - around_xyz[2, k]) ** 2
                            )
                        limit = min(gap * abs(gap), (2 * ring + 1) ** 2 * 3 * cell * cell)
                        missing -= _select_smallest(
                            squared[:around], limit, count, bins, places, found[rows[own] // every]
                        )
    return found


@njit(cache=True, nogil=True)
def _select_smallest(keys, limit, count, bins, values, chosen):  # type: ignore[no-untyped-def]
    """Write the values of the `count` smallest keys, and return whether as many are at most `limit`.

    Bins find the key that divides them; only its bin is sorted.
    """
    width = max(limit, 1e-300) / BINS
    held = np.zeros(BINS + 1, np.int64)
    for k in range(len(keys)):
        bins[k] = int(min(keys[k] / width, float(BINS)))
    for k in range(len(keys)):
        held[bins[k]] += 1
    below, border = 0, 0
    while border < BINS and below + held[border] < count:
        below += held[border]
        border += 1
    if border == BINS:
        return False
    kept, equal = 0, 0
    edge_keys, edge_values = np.empty(held[border]), np.empty(held[border], np.int64)
    for k in range(len(keys)):
        if bins[k] < border:
            chosen[kept] = values[k]
            kept += 1
        elif bins[k] == border:
            # In order, by insertion: one or two points.
            place = equal
            while place > 0 and edge_keys[place - 1] > keys[k]:
                edge_keys[place], edge_values[place] = edge_keys[place - 1], edge_values[place - 1]
                place -= 1
            edge_keys[place], edge_values[place] = keys[k], values[k]
            equal += 1
    chosen[kept:] = edge_values[: count - kept]
    return True


@njit(cache=True, nogil=True)
def _fit_normals(points: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    normals = np.empty((len(neighbours), 3))
    for row in range(len(neighbours)):
        mx, my, mz = 0.0, 0.0, 0.0
        for k in neighbours[row]:
            mx += points[k, 0]
            my += points[k, 1]
            mz += points[k, 2]
        count = neighbours.shape[1]
        mx, my, mz = mx / count, my / count, mz / count
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in neighbours[row]:
            x, y, z = points[k, 0] - mx, points[k, 1] - my, points[k, 2] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
        normals[row, 0], normals[row, 1], normals[row, 2] = _smallest_axis(xx, xy, xz, yy, yz, zz)
    return normals


@njit(cache=True, nogil=True)
def _smallest_axis(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, float]:
    """Return the unit eigenvector of the smallest eigenvalue of a symmetric matrix.

    The eigenvalue by the trigonometric solution of the cubic (Smith, Communications of the ACM 1961), the vector as the
    longest product of two rows of the matrix less that value; z for a multiple of the identity.
    """
    mean = (xx + yy + zz) / 3
    size = max(mean, 1e-300)
    a, b, c, d, e, f = (xx - mean) / size, xy / size, xz / size, (yy - mean) / size, yz / size, (zz - mean) / size
    spread = np.sqrt((a * a + d * d + f * f + 2 * (b * b + c * c + e * e)) / 6)
    if spread < 1e-12:
        return 0.0, 0.0, 1.0
    half = (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)) / (2 * spread**3)
    angle = np.arccos(min(max(half, -1.0), 1.0)) / 3
    smallest = 2 * spread * np.cos(angle + 2 * np.pi / 3)
    a, d, f = a - smallest, d - smallest, f - smallest
    best, length = (0.0, 0.0, 1.0), 0.0
    for x, y, z in (
        (b * e - c * d, b * c - a * e, a * d - b * b),
        (b * f - c * e, c * c - a * f, a * e - b * c),
        (d * f - e * e, c * e - b * f, b * e - c * d),
    ):
        squared = x * x + y * y + z * z
        if squared > length:
            best, length = (x, y, z), squared
    if length < 1e-24:
        return _any_perpendicular(a, b, c, d, e, f)
    norm = np.sqrt(length)
    return best[0] / norm, best[1] / norm, best[2] / norm


@njit(cache=True, nogil=True)
def _any_perpendicular(a: float, b: float, c: float, d: float, e: float, f: float) -> tuple[float, float, float]:
    """Return a unit vector at a right angle to the longest row of a symmetric matrix of rank 1: points on a line."""
    x, y, z = a, b, c
    if b * b + d * d + e * e > x * x + y * y + z * z:
        x, y, z = b, d, e
    if c * c + e * e + f * f > x * x + y * y + z * z:
        x, y, z = c, e, f
    u, v, w = (-y, x, 0.0) if abs(z) < max(abs(x), abs(y)) else (0.0, -z, y)
    norm = np.sqrt(u * u + v * v + w * w)
    return u / norm, v / norm, w / norm
