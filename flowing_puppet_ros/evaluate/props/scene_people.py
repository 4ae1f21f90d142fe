# SPDX-License-Identifier: Apache-2.0
"""People for synthetic scenes who do not just stand or walk, with what they sit or stand on; and empty seats.

Each function returns people and meshes about x = y = 0 on the floor, turned anyhow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.props import furniture
from flowing_puppet_ros.evaluate.props.furniture import Place
from flowing_puppet_ros.evaluate.props.people import draw_people
from flowing_puppet_ros.evaluate.props.poses import draw_lifting, draw_low, draw_seated
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh, make_prism, stand_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import draw_upright
from flowing_puppet_ros.model import rotation

POSES = ("seated", "floor", "crouching", "bent", "arms-up", "step")
"""On a stool, chair, bench, sofa, at a desk or in a wheelchair; on the floor; squatting or kneeling; bent at the hips;
with lifted arms; standing on a step, a kerb or a platform."""
SEATS = ("stool", "chair", "chair", "bench", "wheelchair", "armchair", "sofa", "desk")
STEP_M, STEP_SIZE_M = (0.15, 0.45), (0.5, 1.6)  # height, and edges
MIN_SEAT_M, MAX_LOAD_M = 0.35, 0.6  # height of a bench, and of what lies on an empty seat
LOADED_SHARE, CLOTHED_SHARE = 0.35, 0.3  # of empty seats on which a box lies, and over whose back something hangs


def draw_posed(source: BodySource, rng: np.random.Generator, pose: str) -> tuple[list[TrueBody], list[Mesh]]:
    """Draw somebody in one of POSES."""
    if pose == "seated":
        return _turn(rng, *_draw_on_seat(source, rng))
    if pose == "step":
        body, height = draw_upright(source, rng), rng.uniform(*STEP_M)
        size = np.array([*rng.uniform(*STEP_SIZE_M, 2), height])
        # The feet stay on it, somewhere.
        feet = (size[:2] - STEP_SIZE_M[0]) / 2 * rng.uniform(-1, 1, 2)
        return _turn(rng, [body.translate(np.array([0.0, 0.0, height]))], [stand_box(feet[0], feet[1], 0.0, size)])
    body = draw_lifting(source, rng) if pose == "arms-up" else draw_low(source, rng, pose)
    return _turn(rng, [body], [])


def draw_empty_seat(source: BodySource, rng: np.random.Generator) -> tuple[list[TrueBody], list[Mesh]]:
    """Draw a seat that fits somebody who is not there, perhaps with a box on it or a jacket over its back."""
    bodies, meshes = _draw_on_seat(source, rng)
    place = Place.of(source, bodies[0])
    if rng.random() < LOADED_SHARE:
        size = rng.uniform((0.2, 0.25, 0.15), (0.4, 0.45, MAX_LOAD_M))
        meshes.append(stand_box(place.middle[0], place.middle[1], place.seat, size, rng.uniform(-0.4, 0.4)))
        if rng.random() < 0.3:
            meshes.append(
                make_prism(place.middle, rng.uniform(0.08, 0.15), place.seat + size[2], place.seat + size[2] + 0.25)
            )
    if rng.random() < CLOTHED_SHARE:
        high = place.seat + rng.uniform(0.5, 0.75)
        meshes.append(
            furniture.span(
                (place.back - 0.12, place.middle[1] - 0.24, high - rng.uniform(0.35, 0.7)),
                (place.back + rng.uniform(0.02, 0.1), place.middle[1] + 0.24, high),
            )
        )
    return [], _turn(rng, [], meshes)[1]


def _draw_on_seat(source: BodySource, rng: np.random.Generator) -> tuple[list[TrueBody], list[Mesh]]:
    seat = SEATS[int(rng.integers(len(SEATS)))]
    if seat != "bench":
        return draw_people(source, rng, seat)
    body = draw_seated(source, rng, "free")
    place, half = Place.of(source, body), rng.uniform(0.5, 0.9)
    (x, y), at = place.middle, rng.uniform(-0.3, 0.3)
    deep = rng.uniform(0.15, 0.25)
    meshes = [furniture.span((x - deep, y + at - half, place.seat - 0.05), (x + 0.2, y + at + half, place.seat))]
    for side in (-1, 1):
        foot = y + at + side * (half - 0.1)
        meshes.append(furniture.span((x - deep, foot - 0.04, 0.0), (x + 0.2, foot + 0.04, place.seat - 0.05)))
    return [body], meshes


def _turn(rng: np.random.Generator, bodies: list[TrueBody], meshes: list[Mesh]) -> tuple[list[TrueBody], list[Mesh]]:
    """Return people and meshes turned about the vertical."""
    turn = rotation.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    turned = [
        replace(body, vertices=body.vertices @ turn.T, joints=body.joints @ turn.T, rest=None, pose=None)
        for body in bodies
    ]
    return turned, [(vertices @ turn.T, triangles) for vertices, triangles in meshes]
