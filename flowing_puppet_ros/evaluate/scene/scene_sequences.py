# SPDX-License-Identifier: Apache-2.0
"""Sequences of synthetic scenes: people who walk as motion capture does, and people who stand still."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.scene.scene_meshes import HALF_SIZE_M, Disc
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import (
    SceneKind,
    SyntheticScene,
    cover_people,
    draw_height,
    find_view,
    is_upright,
    make_place,
    place_people,
    scan_scene,
)

RATE_HZ = 10.0
WALKING_SHARE = 0.6
MIN_WALK_M = 0.02  # mean motion of a joint in a frame of motion capture
MAX_TRIES = 8  # of motions for a walking person
BODY_RADIUS_M = 0.3
FIDGET_M = 0.015  # by which the head of somebody who stays sways


def draw_sequence(
    source: BodySource,
    rng: np.random.Generator,
    place: str,
    scanner: str,
    people: int,
    scans: int,
    kind: SceneKind = SceneKind(),  # noqa: B008
) -> Iterator[SyntheticScene]:
    """Draw `scans` scans, 0.1 s apart, of one place with people of whom most walk; the sensor stands still.

    The others stand as people in motion capture do, who sway; a share of these is covered. Whom `kind` draws stays
    there and moves a little.
    """
    height = draw_height(rng, place, scanner, kind.height)
    meshes, blocked = make_place(rng, place, kind.lookalikes)
    standing, beneath = place_people(source, rng, place, people, blocked, find_view(scanner), kind)
    meshes += beneath
    motions: list[list[TrueBody]] = []
    for body in standing:
        if kind.draw is not None:
            motions.append(_fidget(rng.spawn(1)[0], body, scans))
            continue
        walked = _draw_walk(source, rng, place, body, blocked, scans) if rng.random() < WALKING_SHARE else None
        # Their own random numbers: whoever walks does so alike, whether those who stand sway or not.
        motions.append(walked or source.sway(rng.spawn(1)[0], body, scans, RATE_HZ))
        if kind.covered and walked is None:
            meshes += cover_people(rng.spawn(1)[0], [body], kind.covered)
    down = np.array([0.0, 0.0, -height])
    for number in range(scans):
        bodies = [motion[number] for motion in motions]
        visible = [(body.vertices, source.triangles) for body in bodies]
        points, owner = scan_scene(meshes, visible, rng, scanner, height, kind.rain)
        yield SyntheticScene(points, owner, [body.translate(down) for body in bodies], -height)


def _fidget(rng: np.random.Generator, body: TrueBody, scans: int) -> list[TrueBody]:
    """Return a body whose upper parts go to and fro by `FIDGET_M` about a lower one that rests."""
    phase, period = rng.uniform(0, 2 * np.pi, 2), rng.uniform(2.0, 4.0, 2)
    low, high = body.vertices[:, 2].min(), body.vertices[:, 2].max()
    moved = []
    for number in range(scans):
        time = 2 * np.pi * number / (RATE_HZ * period)
        step = np.array([*(FIDGET_M * np.sin(time + phase)), 0.0])
        lean = [((each[:, 2:] - low) / (high - low)) ** 2 * step for each in (body.vertices, body.joints)]
        moved.append(replace(body, vertices=body.vertices + lean[0], joints=body.joints + lean[1]))
    return moved


def _draw_walk(
    source: BodySource,
    rng: np.random.Generator,
    place: str,
    start: TrueBody,
    blocked: Sequence[Disc],
    scans: int,
) -> list[TrueBody] | None:
    """Return a walk from where somebody stands, upright all the way and through nothing; None where none is found."""
    half = HALF_SIZE_M[place]
    for _ in range(MAX_TRIES):
        motion = source.draw_motion(rng, scans, RATE_HZ, MIN_WALK_M)
        step = start.joints.mean(axis=0) - motion[0].joints.mean(axis=0)
        moved = [body.translate(np.array([step[0], step[1], 0.0])) for body in motion]
        middles = np.array([body.joints.mean(axis=0)[:2] for body in moved])
        inside = bool((np.abs(middles) < np.array(half) - BODY_RADIUS_M).all()) and np.hypot(*middles.T).min() > 1.2
        free = all(np.hypot(*(middles - [x, y]).T).min() > r + BODY_RADIUS_M - 0.35 for x, y, r in blocked)
        if inside and free and all(is_upright(body, source.joint_names) for body in moved):
            return moved
    return None
