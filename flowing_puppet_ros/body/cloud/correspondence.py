# SPDX-License-Identifier: Apache-2.0
"""Two-way correspondences between a body and a cloud, as one quadratic per vertex, and the two-way distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numba.extending import register_jitable

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig

# Weight of a pair's squared length beside its squared distance along the cloud's normal.
TANGENTIAL_WEIGHT = 0.05
# Cosine between the normals of a pair; pairs below it are dropped.
MIN_NORMAL_COSINE = 0.2
# Distance that a normal rotated by one radian adds in the search for the closest point, so that the other side of a
# finger, or of an arm on the hip, is farther away.
NORMAL_LENGTH_M = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """A cloud to fit, seen from all sides or from one viewpoint.

    Attributes:
        points: (N, 3) metres.
        normals: (N, 3) unit normals, outward.
        nearest: index of `points`.
        viewpoint: (3,) position of the sensor in metres, None when the body was seen from all sides.
        field: what the sensor at the viewpoint, or those around the body, can know; None where one sees everything.
    """

    points: np.ndarray
    normals: np.ndarray
    nearest: NearestPoints
    viewpoint: np.ndarray | None
    field: SensorField | SensorRig | None

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray | None = None) -> Cloud:
        """Index a cloud."""
        return cls(points, normals, NearestPoints(points), viewpoint, None)

    @property
    def noise(self) -> float:
        """Deviation of the points along their normals, metres; 0 where it was not measured."""
        return 0.0

    def sees(self, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return which vertices (V,) face the viewpoint and are in its field; all when there is no viewpoint."""
        if self.viewpoint is None:
            return np.ones(len(vertices), dtype=bool)
        if isinstance(self.field, SensorRig):
            return self.field.find_facing(vertices, normals)
        facing = ((self.viewpoint - vertices) * normals).sum(axis=1) > 0
        return facing if self.field is None else facing & ~self.field.find_unknown(vertices)


@dataclass(frozen=True, slots=True, eq=False)
class VertexQuadratic:
    """sum_v (x_v - v)^T A_v (x_v - v) + 2 b_v^T (x_v - v) over vertices v, square metres.

    Attributes:
        matrix: (V, 3, 3), A.
        vector: (V, 3), b.
    """

    matrix: np.ndarray
    vector: np.ndarray

    @classmethod
    def sum(cls, terms: Sequence[VertexQuadratic]) -> VertexQuadratic:
        """Return the sum of one or more quadratics of the same vertices."""
        total = terms[0]
        for term in terms[1:]:
            total = cls(total.matrix + term.matrix, total.vector + term.vector)
        return total


class TwoWayCorrespondence:
    """Correspondences in both directions between a cloud and the bodies of one fit."""

    def __init__(self, cloud: Cloud, max_points: int | None = None, alternate: int = 1) -> None:
        """Index a cloud; of more than `max_points` points only every second, third ... is matched to a vertex.

        `alternate` is the number of sets that `attract` takes in turns.
        """
        self._cloud = cloud
        self._nearest = NearestPoints(cloud.points, cloud.normals, NORMAL_LENGTH_M)
        step = 1 if max_points is None else max(1, -(-len(cloud.points) // max_points))
        self._matched = np.arange(0, len(cloud.points), step)
        self._alternate = alternate
        # The last answers, from which the next body's are found faster.
        self._to_cloud = np.empty(0, dtype=np.int64)
        self._to_body = np.zeros(len(self._matched), dtype=np.int64)

    def attract(self, vertices: np.ndarray, faces: np.ndarray, sigma: float, turn: int = 0) -> VertexQuadratic:
        """Match both ways and return the quadratic that attracts the vertices to the cloud.

        Every vertex that the sensor sees is matched to its closest cloud point, every cloud point to its closest
        vertex, where opposite normals add 6 cm; pairs whose normals disagree are dropped. A pair costs its squared
        distance along the cloud's normal plus 0.05 of its squared length, times `geman_mcclure`. Each direction has
        a total weight of 1.

        Args:
            vertices: (V, 3) metres.
            faces: (F, 3), outward.
            sigma: width of the robust kernel, metres.
            turn: number of the step; where sets alternate, it chooses the one that is matched.
        """
        cloud, first, step = self._cloud, turn % self._alternate, self._alternate
        normals = vertex_normals(vertices, faces)
        seen = first + step * np.flatnonzero(cloud.sees(vertices[first::step], normals[first::step]))
        if len(self._to_cloud) != len(vertices):
            self._to_cloud = np.zeros(len(vertices), dtype=np.int64)
        to_cloud = self._nearest.query(vertices[seen], normals[seen], self._to_cloud[seen])[1]
        body, matched = NearestPoints(vertices, normals, NORMAL_LENGTH_M), self._matched[first::step]
        to_body = body.query(cloud.points[matched], cloud.normals[matched], self._to_body[first::step])[1]
        self._to_cloud[seen], self._to_body[first::step] = to_cloud, to_body
        quadratic = VertexQuadratic(np.zeros((len(vertices), 3, 3)), np.zeros((len(vertices), 3)))
        for pairs in ((seen, to_cloud), (to_body, matched)):
            _add_pairs(
                pairs, (vertices, normals), (cloud.points, cloud.normals), sigma**2, 1 / max(len(pairs[1]), 1),
                (quadratic.matrix, quadratic.vector),
            )  # fmt: skip
        return quadratic

    def find_nearest(self, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Measure how far vertices (V, 3) and cloud are apart where opposite normals add 6 cm.

        Returns:
            Distances (V,) to the cloud, and for every matched cloud point its nearest vertex and the distance to it.
        """
        normals, matched = vertex_normals(vertices, faces), self._matched
        body = NearestPoints(vertices, normals, NORMAL_LENGTH_M)
        to_body, vertex = body.query(self._cloud.points[matched], self._cloud.normals[matched])
        return self._nearest.query(vertices, normals)[0], vertex, to_body


@register_jitable(inline="always")
def geman_mcclure[Numbers: (float, np.ndarray)](squared_distance: Numbers, squared_width: float) -> Numbers:
    """Return the Geman-McClure weight (w^2 / (w^2 + d^2))^2, 1 at distance 0 and a quarter at the width.

    Args:
        squared_distance: d^2, a number or an array of any shape; in Python and within compiled kernels.
        squared_width: w^2.
    """
    return (squared_width / (squared_width + squared_distance)) ** 2


@njit(cache=True, nogil=True)
def _add_pairs(pairs, body, cloud, squared_width, share, quadratic):  # type: ignore[no-untyped-def]
    """Add the pairs (vertices (K,), points (K,)) of a body and a cloud (points and normals each) to a quadratic."""
    (vertex, point), (vertices, normals), (points, point_normals) = pairs, body, cloud
    matrix, vector = quadratic
    gap = np.empty(3)
    for k in range(len(vertex)):
        v, p = vertex[k], point[k]
        cosine, along, squared = 0.0, 0.0, 0.0
        for i in range(3):
            gap[i] = vertices[v, i] - points[p, i]
            cosine += normals[v, i] * point_normals[p, i]
            along += gap[i] * point_normals[p, i]
            squared += gap[i] ** 2
        if cosine <= MIN_NORMAL_COSINE:
            continue
        weight = share * geman_mcclure(squared, squared_width)
        for i in range(3):
            vector[v, i] += weight * (along * point_normals[p, i] + TANGENTIAL_WEIGHT * gap[i])
            matrix[v, i, i] += weight * TANGENTIAL_WEIGHT
            for j in range(3):
                matrix[v, i, j] += weight * point_normals[p, i] * point_normals[p, j]


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceDistances:
    """Distances in metres between a cloud of N points and a body's surface points: V vertices, then F face centres.

    Attributes:
        seen: (V + F,) which surface points the sensor sees.
        to_cloud: distances of those to the cloud, in their order.
        nearest: indices of the cloud's points nearest to them.
        to_body: (N,) distances of the cloud's points to the nearest surface point, seen or not.
        to_vertex: (N,) distances of the cloud's points to the nearest vertex, or the nearest of the nearest face.
    """

    seen: np.ndarray
    to_cloud: np.ndarray
    nearest: np.ndarray
    to_body: np.ndarray
    to_vertex: np.ndarray

    @property
    def two_way(self) -> float:
        """Mean distance over both directions, metres; infinite when nothing is seen."""
        to_cloud = self.to_cloud.mean() if len(self.to_cloud) else np.inf
        return float((to_cloud + self.to_body.mean()) / 2)


def measure_distances(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, cloud: Cloud) -> SurfaceDistances:
    """Measure how far a body and a cloud are apart.

    Args:
        vertices: (V, 3) metres.
        normals: (V, 3) unit normals of the vertices.
        faces: (F, 3), outward.
        cloud: the cloud.
    """
    surface, directions = _add_faces(np.ascontiguousarray(vertices), normals, faces)
    seen = cloud.sees(surface, directions)
    count = int(np.count_nonzero(seen[: len(vertices)]))
    first, rows = cloud.nearest.query(surface[seen][:count])
    # A face's centre is near what its first corner is near.
    at_vertex = np.zeros(len(vertices), dtype=np.int64)
    at_vertex[seen[: len(vertices)]] = rows
    rest, others = cloud.nearest.query(surface[seen][count:], guess=at_vertex[faces[seen[len(vertices) :], 0]])
    to_cloud, nearest = np.concatenate([first, rest]), np.concatenate([rows, others])
    to_body, place = NearestPoints(surface).query(cloud.points)
    to_vertex, at_face = to_body.copy(), np.flatnonzero(place >= len(vertices))
    gaps = vertices[faces[place[at_face] - len(vertices)]] - cloud.points[at_face][:, None]
    to_vertex[at_face] = np.sqrt((gaps**2).sum(axis=2).min(axis=1))
    return SurfaceDistances(seen, to_cloud, nearest, to_body, to_vertex)


@njit(cache=True, nogil=True)
def _add_faces(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and then centres of faces (V + F, 3), and the directions (V + F, 3) that they face."""
    count = len(vertices)
    places, directions = np.empty((count + len(faces), 3)), np.empty((count + len(faces), 3))
    places[:count], directions[:count] = vertices, normals
    for face in range(len(faces)):
        a, b, c = vertices[faces[face, 0]], vertices[faces[face, 1]], vertices[faces[face, 2]]
        for axis in range(3):
            places[count + face, axis] = (a[axis] + b[axis] + c[axis]) / 3
            i, j = (axis + 1) % 3, (axis + 2) % 3
            directions[count + face, axis] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
    return places, directions


def two_way_distance(vertices: np.ndarray, faces: np.ndarray, cloud: Cloud) -> float:
    """Return the mean distance in metres, over both directions, between the body's surface points and the cloud.

    The surface is sampled at vertices and face centres; for a one-sided cloud only where it faces the sensor.
    """
    return measure_distances(vertices, vertex_normals(vertices, faces), faces, cloud).two_way
