# SPDX-License-Identifier: Apache-2.0
"""What stands in synthetic rooms, streets and halls: boxes and prisms, some as large as people, or as thin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box

HALF_SIZE_M = {"room": (4.0, 5.0), "street": (22.0, 12.0), "hall": (16.0, 10.0)}  # x and y
MAX_TRIES = 200  # for a free place

Mesh = tuple[np.ndarray, np.ndarray]
Disc = tuple[float, float, float]  # x, y and radius, metres


def make_prism(middle: Sequence[float] | np.ndarray, radius: float, low: float, high: float, sides: int = 12) -> Mesh:
    """Return vertices and triangles of an upright prism about (x, y) from z `low` to `high`."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle)], axis=1)
    ends = [np.column_stack([ring, np.full(sides, z)]) for z in (low, high)]
    vertices = np.concatenate([*ends, [[middle[0], middle[1], low], [middle[0], middle[1], high]]])
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    sets = [
        (here, after, here + sides),
        (after, after + sides, here + sides),
        (after, here, bottom),
        (here + sides, after + sides, top),
    ]
    return vertices, np.concatenate([np.stack(each, axis=1) for each in sets])


def stand_box(x: float, y: float, z: float, size: Sequence[float] | np.ndarray, yaw: float = 0.0) -> Mesh:
    """Return a box that stands on z."""
    frame = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    return make_box(np.array([x, y, z + size[2] / 2]), np.array(size), frame)


def find_place(rng: np.random.Generator, place: str, blocked: list[Disc], radius: float) -> tuple[float, float]:
    """Return a free place (x, y) for something of a radius, and add it to those `blocked`."""
    half = HALF_SIZE_M[place]
    for _ in range(MAX_TRIES):
        x, y = rng.uniform(-half[0], half[0]), rng.uniform(-half[1], half[1])
        if np.hypot(x, y) > 1.2 + radius and all(np.hypot(x - a, y - b) > radius + r - 0.3 for a, b, r in blocked):
            break
    blocked.append((x, y, radius + 0.35))
    return float(x), float(y)


def _make_room(rng: np.random.Generator) -> tuple[list[Mesh], list[Disc]]:
    """Make a room: walls, cupboards, tables, chairs, a coat stand, a plant, a column."""
    w, d = HALF_SIZE_M["room"]
    blocked: list[Disc] = []
    meshes = [stand_box(0, 0, -0.1, (2 * w, 2 * d, 0.1)), stand_box(0, 0, 2.7, (2 * w, 2 * d, 0.1))]
    for x, y, size in (
        (w, 0, (0.1, 2 * d, 2.7)),
        (-w, 0, (0.1, 2 * d, 2.7)),
        (0, d, (2 * w, 0.1, 2.7)),
        (0, -d, (2 * w, 0.1, 2.7)),
    ):
        meshes.append(stand_box(x, y, 0, size))
    for _ in range(3):
        side, along = rng.choice([-1, 1]), rng.uniform(-d + 1, d - 1)
        meshes.append(stand_box(side * (w - 0.3), along, 0, (0.5, rng.uniform(0.5, 1.4), rng.uniform(0.8, 2.0))))
        blocked.append((side * (w - 0.3), along, 0.9))
    for _ in range(rng.integers(1, 4)):
        x, y = find_place(rng, "room", blocked, 0.8)
        yaw = rng.uniform(0, np.pi)
        meshes.append(stand_box(x, y, 0.7, (1.4, 0.8, 0.04), yaw))
        meshes.extend(make_prism((x + 0.5 * np.cos(yaw) * s, y + 0.5 * np.sin(yaw) * s), 0.04, 0, 0.7) for s in (-1, 1))
        if rng.random() < 0.7:  # a screen
            meshes.append(stand_box(x, y, 0.75, (0.5, 0.05, 0.4), yaw))
        chair = rng.uniform(0, 2 * np.pi)
        a, b = x + 0.9 * np.cos(chair), y + 0.9 * np.sin(chair)
        meshes += [
            stand_box(a, b, 0.42, (0.45, 0.45, 0.06), chair),
            stand_box(a, b, 0, (0.08, 0.08, 0.42)),
            stand_box(a + 0.2, b, 0.45, (0.06, 0.42, rng.uniform(0.4, 0.75)), chair),
        ]
    for _ in range(rng.integers(1, 3)):
        x, y = find_place(rng, "room", blocked, 0.3)
        meshes += _person_like(rng, x, y)
    return meshes, blocked


def _make_street(rng: np.random.Generator) -> tuple[list[Mesh], list[Disc]]:
    """Make a street: houses, kerbs, parked cars, lamp posts, trees, bins, signs, bushes."""
    w, d = HALF_SIZE_M["street"]
    blocked: list[Disc] = []
    meshes = [stand_box(0, 0, -0.2, (120, 120, 0.2))]
    for side in (-1, 1):
        meshes.append(stand_box(0, side * 8.5, 0, (120, 5.0, 0.13)))
        meshes.append(stand_box(0, side * (d + 3), 0, (120, 4.0, 9.0)))
        for _ in range(rng.integers(2, 6)):
            x, y = rng.uniform(-w, w), side * 4.9
            meshes += [stand_box(x, y, 0.25, (4.3, 1.75, 0.65)), stand_box(x - 0.2, y, 0.9, (2.2, 1.6, 0.6))]
            meshes.extend(make_prism((x + a, y + b), 0.3, 0, 0.5) for a in (-1.3, 1.3) for b in (-0.7, 0.7))
            blocked += [(x - 1.2, y, 1.4), (x + 1.2, y, 1.4)]
    for _ in range(rng.integers(3, 7)):
        x, y = find_place(rng, "street", blocked, 0.4)
        meshes.append(make_prism((x, y), rng.uniform(0.04, 0.2), 0, 5.0))
        if rng.random() < 0.5:  # a crown
            for _ in range(6):
                a, b = rng.normal(0, 0.8, 2)
                meshes.append(
                    make_prism((x + a, y + b), rng.uniform(0.3, 0.8), rng.uniform(1.9, 3), rng.uniform(3.2, 5))
                )
    for _ in range(rng.integers(3, 8)):
        x, y = find_place(rng, "street", blocked, 0.4)
        meshes += _person_like(rng, x, y)
    return meshes, blocked


def _make_hall(rng: np.random.Generator) -> tuple[list[Mesh], list[Disc]]:
    """Make a factory hall: walls, columns, machines with consoles, racks, pallets, barrels."""
    w, d = HALF_SIZE_M["hall"]
    blocked: list[Disc] = []
    meshes = [stand_box(0, 0, -0.1, (2 * w, 2 * d, 0.1))]
    for x, y, size in (
        (w, 0, (0.2, 2 * d, 6)),
        (-w, 0, (0.2, 2 * d, 6)),
        (0, d, (2 * w, 0.2, 6)),
        (0, -d, (2 * w, 0.2, 6)),
    ):
        meshes.append(stand_box(x, y, 0, size))
    for x in (-8.0, 0.0, 8.0):
        for y in (-5.0, 5.0):
            meshes.append(stand_box(x + rng.normal(0, 0.3), y, 0, (0.4, 0.4, 6)))
            blocked.append((x, y, 0.6))
    for _ in range(rng.integers(4, 8)):
        x, y = find_place(rng, "hall", blocked, 1.3)
        yaw = rng.uniform(0, np.pi)
        for _ in range(rng.integers(2, 6)):
            a, b = rng.uniform(-0.9, 0.9, 2)
            meshes.append(stand_box(x + a, y + b, 0, rng.uniform((0.2, 0.2, 0.4), (1.0, 1.0, 2.1)), yaw))
        meshes.append(stand_box(x + 1.0, y, 0.9, (0.35, 0.2, 0.5), yaw))
        meshes.append(make_prism((x + 1.0, y), 0.05, 0, 0.9))
    for _ in range(rng.integers(1, 4)):
        x, y = find_place(rng, "hall", blocked, 1.2)
        for z in (0.2, 1.0, 1.8):
            meshes.append(stand_box(x, y, z, (2.0, 0.6, 0.05)))
            meshes.extend(
                stand_box(x + a, y, z + 0.05, rng.uniform((0.2, 0.2, 0.2), (0.5, 0.5, 0.6)))
                for a in rng.uniform(-0.8, 0.8, 2)
            )
        meshes.extend(stand_box(x + a, y + b, 0, (0.06, 0.06, 2.3)) for a in (-1, 1) for b in (-0.3, 0.3))
    for _ in range(rng.integers(2, 6)):
        x, y = find_place(rng, "hall", blocked, 0.4)
        meshes += _person_like(rng, x, y)
    return meshes, blocked


def _person_like(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make something of a person's size at (x, y)."""
    kind, height = rng.integers(0, 6), rng.uniform(1.2, 2.0)
    if kind == 0:  # a bin or barrel, with something on it
        radius = rng.uniform(0.2, 0.35)
        return [make_prism((x, y), radius, 0, height - 0.5), make_prism((x, y), 0.6 * radius, height - 0.5, height)]
    if kind == 1:  # a coat stand
        return [
            make_prism((x, y), 0.03, 0, height),
            make_prism((x, y), rng.uniform(0.12, 0.22), height - 0.9, height - 0.1),
        ]
    if kind == 2:  # a cabinet
        return [stand_box(x, y, 0, (rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.6), height), rng.uniform(0, np.pi))]
    if kind == 3:  # a plant
        pot = [make_prism((x, y), 0.2, 0, 0.35)]
        return pot + [
            make_prism(
                (x + rng.normal(0, 0.15), y + rng.normal(0, 0.15)),
                rng.uniform(0.05, 0.15),
                rng.uniform(0.3, 0.9),
                rng.uniform(1.0, height),
            )
            for _ in range(8)
        ]
    if kind == 4:  # a sign on a post
        return [
            make_prism((x, y), 0.04, 0, height),
            stand_box(x, y, height - 0.5, (0.5, 0.04, 0.5), rng.uniform(0, np.pi)),
        ]
    return [
        stand_box(x, y, z, (*rng.uniform(0.25, 0.5, 2), 0.3), rng.uniform(0, np.pi))
        for z in np.arange(0, height - 0.2, 0.32)
    ]


MAKERS = {"room": _make_room, "street": _make_street, "hall": _make_hall}
