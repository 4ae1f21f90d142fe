# SPDX-License-Identifier: Apache-2.0
"""The template mesh of the Stitched Puppet: a closed, exactly symmetric surface over a subset of Anny's vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.learn.anny.segmentation import assign_vertices_to_parts
from flowing_puppet_ros.learn.sp.decimate import decimate
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree

TEMPLATE_VERTICES = 3800  # approximate number
SPACING_M = 0.025  # between neighbouring vertices
SPACING_FACTORS = {"head": 0.6, "hand": 0.6, "foot": 0.75}  # by the last word of the part's name
RAY_COUNT = 60  # directions in which a vertex of the head may see the outside
MIN_OPEN_SHARE = 0.1  # share of directions in which a vertex of the outer surface sees the outside; 0.5 on a plane
MIDLINE_TOLERANCE_M = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The template's topology; coordinates come from the posed Anny body.

    Attributes:
        anny_vertex: (V,) index of each vertex in Anny.
        faces: (F, 3) int32, oriented outwards.
        part_of_vertex: (V,) uint8, index into SP_PARENTS.
        part_of_face: (F,) uint8, index into SP_PARENTS.
        mirror_vertex: (V,) vertex on the other side of the body.
    """

    anny_vertex: Array
    faces: Array
    part_of_vertex: Array
    part_of_face: Array
    mirror_vertex: Array


def make_template(body: AnnyBody, vertices: int = TEMPLATE_VERTICES) -> Template:
    """Decimate the left half of the average body to about `vertices` / 2, and join it with its mirror image."""
    rest = body.make_rest_body(body.mean_phenotype()).vertices
    part = assign_vertices_to_parts(body)
    half = _select_left_half(rest, _select_skin(body.triangles, len(rest)))
    head = half[(part[half] == tuple(SP_PARENTS).index("head")).all(axis=1)]
    inner = _find_inside(rest, head)
    words = [name.split("_")[-1] for name in SP_PARENTS]
    spacing = SPACING_M * np.array([SPACING_FACTORS.get(word, 1.0) for word in words])[part]
    coarse = decimate(rest, half, spacing, part, inner, vertices // 2)
    template = _join_halves(rest, coarse, part, body.mirror_vertex)
    _check_contacts(template)
    return template


def _select_skin(triangles: Array, n: int) -> Array:
    # The largest connected surface, which leaves out eyeballs and tongue.
    edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    labels = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n)), directed=False)[1]
    return triangles[labels[triangles[:, 0]] == np.bincount(labels).argmax()]


def _select_left_half(vertices: Array, triangles: Array) -> Array:
    return triangles[vertices[triangles, 1].mean(axis=1) > MIDLINE_TOLERANCE_M]


def _find_inside(vertices: Array, head: Array) -> Array:
    """Return a mask (V,) bool of vertices on the left half of the head that see (nearly) only its inside."""
    mirrored = vertices * [1.0, -1.0, 1.0]
    corners = np.concatenate([vertices[head], mirrored[head]])
    index = np.arange(RAY_COUNT) + 0.5
    polar, around = np.arccos(1 - 2 * index / RAY_COUNT), np.pi * (1 + 5**0.5) * index
    rays = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=1)
    ids = np.unique(head)
    inside = np.zeros(len(vertices), dtype=np.bool_)
    inside[ids] = _open_share(vertices[ids], np.ascontiguousarray(corners), rays) < MIN_OPEN_SHARE
    return inside


@njit(cache=True, nogil=True)
def _open_share(points, corners, rays):  # type: ignore[no-untyped-def]
    # Moller and Trumbore 1997, in scalars for speed; hits closer than a millimetre are the point's own faces.
    free = np.zeros(len(points))
    for p in range(len(points)):
        for r in range(len(rays)):
            x, y, z = rays[r]
            blocked = False
            for f in range(len(corners)):
                a, b, c = corners[f]
                ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
                vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
                hx, hy, hz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
                det = ux * hx + uy * hy + uz * hz
                if abs(det) < 1e-14:
                    continue
                sx, sy, sz = points[p, 0] - a[0], points[p, 1] - a[1], points[p, 2] - a[2]
                first = (sx * hx + sy * hy + sz * hz) / det
                if first < 0.0 or first > 1.0:
                    continue
                qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
                second = (x * qx + y * qy + z * qz) / det
                if second >= 0.0 and first + second <= 1.0 and (vx * qx + vy * qy + vz * qz) / det > 1e-3:
                    blocked = True
                    break
            if not blocked:
                free[p] += 1.0
    return free / len(rays)


def _join_halves(rest: Array, half: Array, part: Array, across: Array) -> Template:
    left = np.unique(half)
    middle = np.abs(rest[left, 1]) < MIDLINE_TOLERANCE_M
    mirror = np.concatenate([np.zeros(len(left), np.int64), np.flatnonzero(~middle)])
    mirror[: len(left)] = np.where(middle, np.arange(len(left)), len(left) + np.cumsum(~middle) - 1)
    new_number = np.full(len(rest), -1, dtype=np.int64)
    new_number[left] = np.arange(len(left))
    faces = new_number[half]
    faces = np.concatenate([faces, mirror[faces][:, ::-1]])
    tree = PartTree.from_parents(SP_PARENTS)
    owner = np.concatenate([part[left], np.array(tree.mirror)[part[left][~middle]]]).astype(np.uint8)
    return Template(
        anny_vertex=np.concatenate([left, across[left[~middle]]]),
        faces=faces.astype(np.int32),
        part_of_vertex=owner,
        part_of_face=_assign_faces(owner[faces], np.array(tree.parents)),
        mirror_vertex=mirror,
    )


def _assign_faces(owners: Array, parents: Array) -> Array:
    # The part with two corners; where three parts meet, the neighbour of the other two in the tree.
    a, b, c = owners.T
    chosen = np.where(b == c, b, a)
    for face in np.flatnonzero((a != b) & (b != c) & (a != c)):
        trio = owners[face]
        links = [sum(parents[x] == y or parents[y] == x for y in trio) for x in trio]
        chosen[face] = trio[int(np.argmax(links))]
    return chosen.astype(np.uint8)


def _check_contacts(template: Template) -> None:
    tree = PartTree.from_parents(SP_PARENTS)
    touching = np.zeros((len(template.part_of_vertex), len(tree)), dtype=np.int64)
    for corner in template.faces.T:
        touching[corner, template.part_of_face] = 1
    contact = touching.T @ touching
    for i, j in zip(*np.nonzero(np.triu(contact, 1)), strict=True):
        if tree.parents[j] != i:
            names = tree.names[i], tree.names[j]
            raise PuppetError(f"{names[0]} and {names[1]} touch in the template; make the part between them wider")
