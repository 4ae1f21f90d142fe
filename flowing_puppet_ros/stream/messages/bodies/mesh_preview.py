# SPDX-License-Identifier: Apache-2.0
"""A mesh of fewer triangles for viewers, over some of the full mesh's own vertices."""

from __future__ import annotations

import heapq
import math

import numpy as np

from flowing_puppet_ros.arrays import F64, I64

_MIN_TURN_COSINE = 0.2  # between a triangle's normals before and after a collapse


def simplify_mesh(vertices: F64, faces: I64, triangles: int) -> I64:
    """Return about `triangles` faces (F', 3) of a closed mesh of vertices (V, 3) and faces (F, 3).

    Edges are collapsed into one of their ends, cheapest first by the quadric error metric (Garland and Heckbert 1997),
    unless that would fold the mesh or change its topology. The result has the full mesh's pose and shape, since its
    vertices are some of the full mesh's.
    """
    mesh = _Mesh(vertices, faces)
    heap = [(mesh.cost(a, b), a, b) for a in range(len(vertices)) for b in mesh.neighbours(a)]
    heapq.heapify(heap)
    while heap and mesh.count > triangles:
        cost, gone, kept = heapq.heappop(heap)
        if not mesh.has_edge(gone, kept):
            continue
        now = mesh.cost(gone, kept)
        if now > cost:  # a quadric has grown since
            heapq.heappush(heap, (now, gone, kept))
        elif mesh.can_collapse(gone, kept):
            mesh.collapse(gone, kept)
            for other in mesh.neighbours(kept):
                heapq.heappush(heap, (mesh.cost(kept, other), kept, other))
                heapq.heappush(heap, (mesh.cost(other, kept), other, kept))
    return mesh.faces()


class _Mesh:
    """A mesh whose edges collapse: the faces of every vertex, and the quadric of its planes."""

    def __init__(self, vertices: F64, faces: I64) -> None:
        self.count = len(faces)
        # Lists of floats: for single vertices they are ten times as fast as arrays.
        self._points = [tuple(map(float, vertex)) for vertex in vertices]
        self._corners = [tuple(map(int, face)) for face in faces]
        self._around: list[set[int]] = [set() for _ in vertices]
        for number, face in enumerate(self._corners):
            for vertex in face:
                self._around[vertex].add(number)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1, keepdims=True) / 2
        normal /= np.maximum(2 * area, 1e-30)
        plane = np.concatenate([normal, -(normal * a).sum(axis=1, keepdims=True)], axis=1)
        row, column = np.triu_indices(4)
        quadrics = np.zeros((len(vertices), len(row)))
        for k in range(3):
            np.add.at(quadrics, faces[:, k], area * plane[:, row] * plane[:, column] * np.where(row == column, 1, 2))
        self._quadrics = quadrics.tolist()

    def cost(self, gone: int, kept: int) -> float:
        """Return the squared distances (m^4, by area) of the vertex that stays from the planes of both."""
        x, y, z = self._points[kept]
        a, b = self._quadrics[gone], self._quadrics[kept]
        # Written out, it takes a quarter of the time of a sum over terms, and it is called 70,000 times.
        cost = (a[0] + b[0]) * (x * x) + (a[1] + b[1]) * (x * y) + (a[2] + b[2]) * (x * z) + (a[3] + b[3]) * x
        cost += (a[4] + b[4]) * (y * y)
        cost += (a[5] + b[5]) * (y * z)
        cost += (a[6] + b[6]) * y
        cost += (a[7] + b[7]) * (z * z)
        cost += (a[8] + b[8]) * z
        return cost + (a[9] + b[9])

    def neighbours(self, vertex: int) -> list[int]:
        """Return the vertices that share a face with `vertex`, in ascending order."""
        return sorted({other for face in self._around[vertex] for other in self._corners[face]} - {vertex})

    def has_edge(self, a: int, b: int) -> bool:
        """Return whether two vertices are still there and neighbours."""
        return any(b in self._corners[face] for face in self._around[a])

    def can_collapse(self, gone: int, kept: int) -> bool:
        """Return whether the mesh stays a closed surface without folds."""
        if len(set(self.neighbours(gone)) & set(self.neighbours(kept))) != 2:
            return False
        for face in self._around[gone]:
            before = self._corners[face]
            if kept not in before:
                after = tuple(kept if vertex == gone else vertex for vertex in before)
                old, new = self._normal(before), self._normal(after)
                if _dot(old, new) <= _MIN_TURN_COSINE * math.sqrt(_dot(old, old) * _dot(new, new)):
                    return False
        return True

    def collapse(self, gone: int, kept: int) -> None:
        """Move `gone` into `kept`; the two faces between them vanish."""
        for face in list(self._around[gone]):
            if kept in self._corners[face]:
                for vertex in self._corners[face]:
                    self._around[vertex].discard(face)
                self.count -= 1
            else:
                self._corners[face] = tuple(kept if vertex == gone else vertex for vertex in self._corners[face])
                self._around[kept].add(face)
        self._around[gone].clear()
        self._quadrics[kept] = [a + b for a, b in zip(self._quadrics[kept], self._quadrics[gone], strict=True)]

    def faces(self) -> I64:
        """Return the faces (F', 3) that are left, in the order of the full mesh's."""
        left = sorted(set().union(*self._around))
        return np.array([self._corners[face] for face in left], np.int64).reshape(-1, 3)

    def _normal(self, face: tuple[int, ...]) -> tuple[float, float, float]:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (self._points[vertex] for vertex in face)
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
