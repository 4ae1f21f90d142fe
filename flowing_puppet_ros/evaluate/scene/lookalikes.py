# SPDX-License-Identifier: Apache-2.0
"""Things that stand as people do and are none: to learn from, beside those that every synthetic scene has.

Each is made of solids of revolution, some of them flattened, and of boxes, with sizes drawn anew. Metres, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowing_puppet_ros.evaluate.scene.scene_meshes import Disc, Mesh, find_place, make_prism, stand_box

SIDES = 14


def add_lookalikes(rng: np.random.Generator, place: str, blocked: list[Disc], count: int) -> list[Mesh]:
    """Return `count` things at free places, and add these to those `blocked`; some stand in pairs."""
    meshes: list[Mesh] = []
    for _ in range(count):
        x, y = find_place(rng, place, blocked, 0.4)
        make = KINDS[int(rng.integers(len(KINDS)))]
        meshes += make(rng, x, y)
        if rng.random() < 0.15:
            angle, gap = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 0.9)
            meshes += make(rng, x + gap * np.cos(angle), y + gap * np.sin(angle))
    return meshes


def turn_profile(
    middle: Sequence[float] | np.ndarray, profile: Sequence[tuple[float, float]], flat: float = 1.0, yaw: float = 0.0
) -> Mesh:
    """Return a solid of revolution about (x, y): radii at ascending heights, one axis scaled by `flat`, then turned."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    across = np.stack([np.cos(angle), flat * np.sin(angle)], axis=1)
    across = across @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    rings = [np.column_stack([np.array(middle[:2]) + radius * across, np.full(SIDES, z)]) for radius, z in profile]
    ends = np.array([[*middle[:2], profile[0][1]], [*middle[:2], profile[-1][1]]])
    here, after = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    sets = []
    for level in range(len(profile) - 1):
        low, high = level * SIDES, (level + 1) * SIDES
        sets += [(here + low, after + low, here + high), (after + low, after + high, here + high)]
    last, first = (len(profile) - 1) * SIDES, len(profile) * SIDES
    sets.append((after, here, np.full(SIDES, first)))
    sets.append((here + last, after + last, np.full(SIDES, first + 1)))
    return np.concatenate([*rings, ends]), np.concatenate([np.stack(each, axis=1) for each in sets])


def _make_coat_stand(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a pole on a foot, with one to four coats about it and perhaps a hat on top."""
    height = rng.uniform(1.55, 2.0)
    meshes = [
        make_prism((x, y), rng.uniform(0.02, 0.04), 0, height),
        make_prism((x, y), rng.uniform(0.15, 0.3), 0, 0.04),
    ]
    for _ in range(rng.integers(1, 5)):
        angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.16)
        top, length, half = height - rng.uniform(0.02, 0.3), rng.uniform(0.6, 1.25), rng.uniform(0.12, 0.24)
        profile = [(half * rng.uniform(0.9, 1.3), max(top - length, 0.1)), (half, top - 0.25), (0.5 * half, top)]
        meshes.append(
            turn_profile((x + away * np.cos(angle), y + away * np.sin(angle)), profile, rng.uniform(0.35, 0.8), angle)
        )
    if rng.random() < 0.3:
        meshes.append(_ball(x, y, height, rng.uniform(0.09, 0.14)))
    return meshes


def _make_post(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a post with something as large as a head or a chest on it: a meter, a lamp, a letter box, a bell."""
    height, kind = rng.uniform(1.0, 1.75), rng.integers(0, 3)
    post = make_prism((x, y), rng.uniform(0.03, 0.12), 0, height)
    if kind == 0:
        return [post, _ball(x, y, height + 0.05, rng.uniform(0.08, 0.18))]
    if kind == 1:
        low, size = height - rng.uniform(0, 0.6), rng.uniform((0.15, 0.12, 0.2), (0.45, 0.35, 0.7))
        return [post, stand_box(x, y, low, size, rng.uniform(0, np.pi))]
    low = height - rng.uniform(0, 0.5)
    return [post, make_prism((x, y), rng.uniform(0.1, 0.22), low, low + rng.uniform(0.15, 0.6))]


def _make_lamp(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a floor lamp."""
    height, radius = rng.uniform(1.3, 1.9), rng.uniform(0.14, 0.28)
    shade = [(radius, height - rng.uniform(0.2, 0.4)), (radius * rng.uniform(0.4, 1.0), height)]
    return [
        make_prism((x, y), rng.uniform(0.012, 0.03), 0, height - 0.1),
        make_prism((x, y), rng.uniform(0.12, 0.2), 0, 0.05),
        turn_profile((x, y), shade),
    ]


def _make_bollard(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a bollard or a hydrant, some as tall as a person."""
    height, radius = rng.uniform(0.8, 1.7), rng.uniform(0.06, 0.22)
    top = [
        (radius, 0.0),
        (radius, height - 0.2),
        (radius * rng.uniform(0.5, 1.4), height - 0.1),
        (0.4 * radius, height),
    ]
    return [turn_profile((x, y), top)]


def _make_shrub(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a shrub: clipped, as a column, or on a stem."""
    height, kind, half = rng.uniform(1.1, 2.1), rng.integers(0, 3), rng.uniform(0.2, 0.4)
    low = 0.0 if kind else rng.uniform(0.5, 1.0)
    levels = np.linspace(low, height, 7)
    bulge = np.sin(np.pi * np.clip(np.linspace(0.12, 0.94, 7), 0, 1)) if kind != 1 else np.linspace(1.0, 0.15, 7)
    meshes = [
        turn_profile(
            (x + rng.normal(0, 0.04), y + rng.normal(0, 0.04)),
            [(half * b * rng.uniform(0.75, 1.2), z) for b, z in zip(bulge, levels, strict=True)],
            rng.uniform(0.7, 1.0),
            rng.uniform(0, np.pi),
        )
        for _ in range(3)
    ]
    return meshes + ([] if kind else [make_prism((x, y), 0.04, 0, low + 0.1)])


def _make_chair(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a chair or a stool at a bar with a jacket over its back, some on a table."""
    seat, yaw = float(rng.choice([0.45, 0.75])), rng.uniform(0, 2 * np.pi)
    back, ahead = seat + rng.uniform(0.4, 0.7), np.array([np.cos(yaw), np.sin(yaw)])
    a, b = np.array([x, y]) - 0.2 * ahead
    meshes = [
        stand_box(x, y, seat, (0.44, 0.44, 0.05), yaw),
        stand_box(a, b, seat, (0.05, 0.42, back - seat), yaw),
        turn_profile(
            (a, b),
            [(0.26, seat - 0.2), (0.27, back - 0.1), (0.1, back + 0.06)],
            rng.uniform(0.25, 0.5),
            yaw + np.pi / 2,
        ),
    ]
    for side in (-0.18, 0.18):
        for along in (-0.18, 0.18):
            leg = np.array([x, y]) + along * ahead + side * np.array([-ahead[1], ahead[0]])
            meshes.append(make_prism(leg, 0.02, 0, seat))
    return meshes


def _make_dummy(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a tailor's dummy: a trunk without arms and legs on a pole, perhaps with a head."""
    top, yaw, size = rng.uniform(1.3, 1.65), rng.uniform(0, np.pi), rng.uniform(0.85, 1.15)
    trunk = [(0.17, -0.72), (0.18, -0.6), (0.13, -0.4), (0.18, -0.18), (0.19, -0.08), (0.06, 0.0)]
    meshes = [
        turn_profile((x, y), [(size * r, top + size * z) for r, z in trunk], rng.uniform(0.55, 0.75), yaw),
        make_prism((x, y), 0.03, 0, top - 0.6),
        make_prism((x, y), rng.uniform(0.15, 0.25), 0, 0.05),
    ]
    return meshes + ([_ball(x, y, top + 0.14, 0.1)] if rng.random() < 0.3 else [])


def _make_parasol(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a closed parasol or a wrapped flag: a cone that hangs about a pole."""
    height = rng.uniform(1.8, 2.5)
    low = rng.uniform(0.6, 1.2)
    cloth = [(rng.uniform(0.08, 0.2), low), (rng.uniform(0.1, 0.22), low + 0.3), (0.04, height)]
    return [make_prism((x, y), 0.03, 0, height), make_prism((x, y), 0.25, 0, 0.1), turn_profile((x, y), cloth)]


def _make_bottles(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make gas bottles or a water dispenser: a cylinder with shoulders and a neck."""
    height, radius = rng.uniform(1.1, 1.8), rng.uniform(0.11, 0.2)
    profile = [(radius, 0.0), (radius, height - 0.25), (0.5 * radius, height - 0.1), (0.3 * radius, height)]
    count, angle = rng.integers(1, 3), rng.uniform(-np.pi, np.pi)
    step = (2 * radius + 0.03) * np.array([np.cos(angle), np.sin(angle)])
    return [turn_profile(np.array([x, y]) + k * step, profile) for k in range(count)]


def _make_truck(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a hand truck, a ladder or an easel: two poles that lean, with boxes before them."""
    yaw, height, half = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 1.9), rng.uniform(0.12, 0.25)
    side = half * np.array([-np.sin(yaw), np.cos(yaw)])
    meshes = [make_prism(np.array([x, y]) + s * side, 0.025, 0, height) for s in (-1, 1)]
    low = 0.05
    while low < height - 0.3 and rng.random() < 0.85:
        size = rng.uniform((0.15, 0.2, 0.15), (0.4, 0.5, 0.5))
        meshes.append(stand_box(x + 0.2 * np.cos(yaw), y + 0.2 * np.sin(yaw), low, size, yaw + rng.normal(0, 0.1)))
        low += size[2]
    return meshes


def _make_board(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a board that stands: a banner, a sign in an A, a screen on a stand."""
    height, yaw, low = rng.uniform(1.0, 2.0), rng.uniform(0, np.pi), float(rng.choice([0.02, 0.5, 0.9]))
    board = stand_box(x, y, low, (rng.uniform(0.03, 0.12), rng.uniform(0.35, 0.8), height - low), yaw)
    return [board, make_prism((x, y), 0.03, 0, height), make_prism((x, y), 0.2, 0, 0.03)]


def _make_machine(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """Make a ticket machine, a console or a pump: a slim body, a wider or a narrower head."""
    height, yaw = rng.uniform(1.2, 1.9), rng.uniform(0, np.pi)
    body, neck = rng.uniform((0.15, 0.2), (0.4, 0.5)), rng.uniform(0.5, 1.4)
    waist = height - rng.uniform(0.2, 0.5)
    return [
        stand_box(x, y, 0, (*body, waist), yaw),
        stand_box(x, y, waist, (*(neck * body), height - waist), yaw),
    ]


def _ball(x: float, y: float, z: float, radius: float) -> Mesh:
    """Return a ball about (x, y, z)."""
    angle = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 7)
    return turn_profile((x, y), [(radius * float(np.cos(a)), z + radius * float(np.sin(a))) for a in angle])


KINDS: tuple[Callable[[np.random.Generator, float, float], list[Mesh]], ...] = (
    _make_coat_stand,
    _make_coat_stand,
    _make_post,
    _make_post,
    _make_lamp,
    _make_bollard,
    _make_shrub,
    _make_chair,
    _make_dummy,
    _make_parasol,
    _make_bottles,
    _make_truck,
    _make_board,
    _make_machine,
)
"""What makes each kind; what was taken for people most is there twice."""
