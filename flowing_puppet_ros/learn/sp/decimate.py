# SPDX-License-Identifier: Apache-2.0
"""Coarser triangle meshes whose vertices are a subset of the fine mesh's: half-edge collapses, then edge flips.

A collapse moves one vertex onto a neighbour under the link condition (Dey et al. 1999), so a manifold stays a manifold
and a boundary a boundary. Vertices keep their places, so poses and shapes of the fine mesh also fit the coarse one.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array

MAX_VALENCE = 60  # size of the table of faces around a vertex
MAX_GOOD_VALENCE = 9  # faces around a vertex after a collapse
SURFACE_WEIGHT = 8.0  # cost of distance from the fine surface, relative to edge length
MAX_EDGE_RATIO = 2.0  # of an edge, relative to the wanted spacing
MIN_NORMAL_COSINE = 0.5  # between a face's normals before and after a collapse: at most 60 degrees
MIN_FLIP_COSINE = 0.9  # between the normals of the two faces of an edge to flip


def decimate(vertices: Array, faces: Array, spacing: Array, group: Array, inner: Array, count: int) -> Array:
    """Decimate a mesh to about `count` of its vertices, which keep their numbers; return the new faces (F', 3).

    Boundary vertices stay on the boundary, and no inner edge joins two of them, so that two halves can be welded there;
    more vertices remain if no further collapse is possible.

    Args:
        vertices: (V, 3) m.
        faces: (F, 3) of an oriented manifold with or without boundary.
        spacing: (V,) m, wanted edge length.
        group: (V,), a vertex only collapses onto a vertex of its group.
        inner: (V,) bool, vertices to remove first, at any cost in quality (the inside of a mouth).
        count: number of vertices to keep.
    """
    faces = np.ascontiguousarray(faces, dtype=np.int64).copy()
    boundary = find_boundary_vertices(len(vertices), faces)
    fan = _make_fans(len(vertices), faces)
    alive = np.ones(len(faces), dtype=np.bool_)
    arguments = (np.ascontiguousarray(vertices, dtype=np.float64), faces, fan, alive, boundary)
    _collapse_edges(*arguments, spacing.astype(np.float64), group.astype(np.int64), inner.astype(np.bool_), count)
    kept = np.ascontiguousarray(faces[alive])
    _flip_edges(arguments[0], kept, boundary)
    return kept


def find_boundary_vertices(n_vertices: int, faces: Array) -> Array:
    """Return a mask (V,) bool of the vertices on an edge that only one of the faces (F, 3) has."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    boundary = np.zeros(n_vertices, dtype=np.bool_)
    boundary[unique[counts == 1]] = True
    return boundary


def _make_fans(n_vertices: int, faces: Array) -> Array:
    # Row v: number of faces around v, then their indices.
    fan = np.full((n_vertices, MAX_VALENCE + 1), -1, dtype=np.int64)
    fan[:, 0] = 0
    for index, face in enumerate(faces):
        for vertex in face:
            fan[vertex, 0] += 1
            fan[vertex, fan[vertex, 0]] = index
    return fan


@njit(cache=True, nogil=True)
def _collect_ring(vertex, faces, fan, out):  # type: ignore[no-untyped-def]
    count = 0
    for k in range(1, fan[vertex, 0] + 1):
        for corner in range(3):
            other = faces[fan[vertex, k], corner]
            if other == vertex:
                continue
            seen = False
            for i in range(count):
                if out[i] == other:
                    seen = True
                    break
            if not seen:
                out[count] = other
                count += 1
    return count


@njit(cache=True, nogil=True)
def _normal(vertices, a, b, c):  # type: ignore[no-untyped-def]
    # Its length is twice the area. A tuple, since small arrays would cost more than the arithmetic.
    p, q, r = vertices[a], vertices[b], vertices[c]
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _cosine(a, b):  # type: ignore[no-untyped-def]
    size = np.sqrt(_dot(a, a) * _dot(b, b))
    return _dot(a, b) / size if size > 0 else -1.0


@njit(cache=True, nogil=True)
def _distance(vertices, a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for axis in range(3):
        total += (vertices[a, axis] - vertices[b, axis]) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _shape(vertices, a, b, c):  # type: ignore[no-untyped-def]
    # 1 for an equilateral triangle, 0 for a sliver: area against the sum of squared edges.
    normal = _normal(vertices, a, b, c)
    total = _distance(vertices, a, b) ** 2 + _distance(vertices, b, c) ** 2 + _distance(vertices, c, a) ** 2
    return 2 * np.sqrt(3.0 * _dot(normal, normal)) / total if total > 0 else 0.0


@njit(cache=True, nogil=True)
def _quadrics(vertices, faces):  # type: ignore[no-untyped-def]
    # Per vertex the area-weighted sum of squared distances to its faces' planes (Garland and Heckbert 1997), as the
    # coefficients of 1, x, y, z, xx, xy, xz, yy, yz, zz; and the sum of the weights.
    quadrics = np.zeros((len(vertices), 11))
    for face in faces:
        normal = _normal(vertices, face[0], face[1], face[2])
        size = np.sqrt(_dot(normal, normal))
        if size == 0:
            continue
        x, y, z = normal[0] / size, normal[1] / size, normal[2] / size
        d = -_dot((x, y, z), vertices[face[0]])
        terms = (d * d, 2 * d * x, 2 * d * y, 2 * d * z, x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 1.0)
        for corner in range(3):
            for k in range(11):
                quadrics[face[corner], k] += size * terms[k]
    return quadrics


@njit(cache=True, nogil=True)
def _plane_distance(quadric, point):  # type: ignore[no-untyped-def]
    x, y, z = point
    terms = (1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
    total = 0.0
    for k in range(10):
        total += quadric[k] * terms[k]
    return np.sqrt(max(total, 0.0) / max(quadric[10], 1e-300))


@njit(cache=True, nogil=True)
def _collapse_cost(u, v, vertices, faces, fan, boundary, spacing, inner, quadric):  # type: ignore[no-untyped-def]
    ring_u, ring_v = np.empty(4 * MAX_VALENCE, np.int64), np.empty(4 * MAX_VALENCE, np.int64)
    n_u, n_v = _collect_ring(u, faces, fan, ring_u), _collect_ring(v, faces, fan, ring_v)
    shared_faces, common, longest, worst = 0, 0, 0.0, 1.0
    for k in range(1, fan[u, 0] + 1):
        face = faces[fan[u, k]]
        if face[0] == v or face[1] == v or face[2] == v:
            shared_faces += 1
            continue
        a, b, c = (v if face[0] == u else face[0]), (v if face[1] == u else face[1]), (v if face[2] == u else face[2])
        worst = min(worst, _shape(vertices, a, b, c))
        before, after = _normal(vertices, face[0], face[1], face[2]), _normal(vertices, a, b, c)
        if not inner and _cosine(before, after) < MIN_NORMAL_COSINE:
            return np.inf
    for i in range(n_u):
        near = False
        for j in range(n_v):
            if ring_u[i] == ring_v[j]:
                near = True
        if near:
            common += 1
        elif ring_u[i] != v:
            if boundary[v] and boundary[ring_u[i]] and not boundary[u]:
                return np.inf
            longest = max(longest, _distance(vertices, v, ring_u[i]))
    if common != shared_faces or (boundary[u] and not (boundary[v] and shared_faces == 1)):
        return np.inf
    valence = fan[u, 0] + fan[v, 0] - 2 * shared_faces
    if valence >= MAX_VALENCE or (valence > MAX_GOOD_VALENCE and not inner):
        return np.inf
    if longest > MAX_EDGE_RATIO * spacing[u] and not inner:
        return np.inf
    error = _plane_distance(quadric, vertices[v])
    cost = (longest + 0.5 * _distance(vertices, u, v) + SURFACE_WEIGHT * error) / spacing[u] + 1.5 * (1.0 - worst)
    return cost - 1e6 if inner else cost


@njit(cache=True, nogil=True)
def _find_best_collapse(u, vertices, faces, fan, boundary, spacing, group, inner, quadrics):  # type: ignore[no-untyped-def]
    ring = np.empty(4 * MAX_VALENCE, np.int64)
    best, target = np.inf, -1
    for i in range(_collect_ring(u, faces, fan, ring)):
        if group[ring[i]] == group[u]:
            cost = _collapse_cost(u, ring[i], vertices, faces, fan, boundary, spacing, inner[u], quadrics[u])
            if cost < best:
                best, target = cost, ring[i]
    return best, target


@njit(cache=True, nogil=True)
def _remove_face(vertex, face, fan):  # type: ignore[no-untyped-def]
    for k in range(1, fan[vertex, 0] + 1):
        if fan[vertex, k] == face:
            fan[vertex, k] = fan[vertex, fan[vertex, 0]]
            fan[vertex, 0] -= 1
            return


@njit(cache=True, nogil=True)
def _collapse_edge(u, v, faces, fan, alive):  # type: ignore[no-untyped-def]
    for k in range(1, fan[u, 0] + 1):
        index = fan[u, k]
        if faces[index, 0] == v or faces[index, 1] == v or faces[index, 2] == v:
            alive[index] = False
            for corner in range(3):
                if faces[index, corner] != u:
                    _remove_face(faces[index, corner], index, fan)
        else:
            for corner in range(3):
                if faces[index, corner] == u:
                    faces[index, corner] = v
            fan[v, 0] += 1
            fan[v, fan[v, 0]] = index
    fan[u, 0] = 0


@njit(cache=True, nogil=True)
def _collapse_edges(vertices, faces, fan, alive, boundary, spacing, group, inner, count):  # type: ignore[no-untyped-def]
    n = len(vertices)
    costs, targets, remaining = np.full(n, np.inf), np.full(n, -1), 0
    quadrics = _quadrics(vertices, faces)
    for u in range(n):
        if fan[u, 0] > 0:
            remaining += 1
            costs[u], targets[u] = _find_best_collapse(
                u, vertices, faces, fan, boundary, spacing, group, inner, quadrics
            )
    first, second = np.empty(4 * MAX_VALENCE, np.int64), np.empty(4 * MAX_VALENCE, np.int64)
    while True:
        u = int(np.argmin(costs))
        if costs[u] == np.inf or (remaining <= count and costs[u] > -1e5):
            return
        v = targets[u]
        _collapse_edge(u, v, faces, fan, alive)
        if not inner[u]:
            quadrics[v] += quadrics[u]
        costs[u] = np.inf
        remaining -= 1
        for i in range(_collect_ring(v, faces, fan, first)):
            for j in range(_collect_ring(first[i], faces, fan, second)):
                w = second[j]
                costs[w], targets[w] = _find_best_collapse(
                    w, vertices, faces, fan, boundary, spacing, group, inner, quadrics
                )


def _flip_edges(vertices: Array, faces: Array, boundary: Array, rounds: int = 10) -> None:
    # Flip inner edges, in place, where that improves the worse of the two triangles and keeps the surface.
    for _ in range(rounds):
        wings: dict[tuple[int, int], list[int]] = {}
        for index, face in enumerate(faces):
            for corner in range(3):
                a, b = int(face[corner]), int(face[(corner + 1) % 3])
                wings.setdefault((min(a, b), max(a, b)), []).append(index)
        touched: set[int] = set()
        edges = set(wings)
        for (a, b), pair in wings.items():
            if len(pair) != 2 or touched & set(pair):
                continue
            c, d = (int(next(x for x in faces[p] if x not in (a, b))) for p in pair)
            if (min(c, d), max(c, d)) in edges or (boundary[c] and boundary[d]):
                continue
            if _flip_improves(vertices, faces[pair[0]], faces[pair[1]], a, b, c, d):
                faces[pair[0]] = np.where(faces[pair[0]] == b, d, faces[pair[0]])
                faces[pair[1]] = np.where(faces[pair[1]] == a, c, faces[pair[1]])
                edges.add((min(c, d), max(c, d)))
                touched |= set(pair)
        if not touched:
            return


@njit(cache=True, nogil=True)
def _flip_improves(vertices, first, second, a, b, c, d):  # type: ignore[no-untyped-def]
    first_old = _normal(vertices, first[0], first[1], first[2])
    second_old = _normal(vertices, second[0], second[1], second[2])
    if _cosine(first_old, second_old) < MIN_FLIP_COSINE:
        return False
    mean = first_old[0] + second_old[0], first_old[1] + second_old[1], first_old[2] + second_old[2]
    before, after = 1.0, 1.0
    for t in (first, second):
        before = min(before, _shape(vertices, t[0], t[1], t[2]))
    for t in (np.where(first == b, d, first), np.where(second == a, c, second)):
        if _cosine(_normal(vertices, t[0], t[1], t[2]), mean) < MIN_FLIP_COSINE:
            return False
        after = min(after, _shape(vertices, t[0], t[1], t[2]))
    return after > before + 1e-9
