# SPDX-License-Identifier: Apache-2.0
"""People with what they sit on, stand behind, lean on or carry."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.props import furniture
from flowing_puppet_ros.evaluate.props.furniture import Place
from flowing_puppet_ros.evaluate.props.poses import draw_seated, draw_standing
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh

SEATS = ("stool", "chair", "armchair", "sofa", "couple", "desk", "wheelchair", "child")
CARRIED = ("box", "backpack", "bag")
PROPS = (*SEATS, "behind", "edge", *CARRIED)
"""People who sit: on a stool, a chair, an armchair, a sofa, two on a sofa, on a chair at a desk, in a wheelchair, a
child on a chair. People who stand: behind a chair, leaning on a table's edge, with a box, a backpack or a bag."""
CHILD_SEAT_M = (0.42, 0.47)  # of a chair for adults
COUPLE_GAP_M = (0.5, 0.75)


def draw_people(source: BodySource, rng: np.random.Generator, prop: str) -> tuple[list[TrueBody], list[Mesh]]:
    """Draw who faces x, and the meshes of what they are with."""
    if prop in CARRIED:
        body = draw_standing(source, rng, {"box": "box", "bag": "hanging"}.get(prop, "free"))
        make = {"box": furniture.make_held_box, "backpack": furniture.make_backpack, "bag": furniture.make_bag}[prop]
        return [body], make(source, body, rng)
    if prop == "edge":
        body = draw_standing(source, rng, "free", rng.uniform(5, 20))
        return [body], furniture.make_table(Place.of(source, body), rng)
    if prop == "behind":
        body = draw_standing(source, rng, "free")
        seated = Place.of(source, draw_seated(source, rng, "free"))
        return [body], furniture.make_chair(seated, rng)
    if prop == "child":
        body = draw_seated(source, rng, "free", source.draw_child(rng))
        low = Place.of(source, body).seat
        body = body.translate(np.array([0.0, 0.0, max(rng.uniform(*CHILD_SEAT_M) - low, 0.0)]))
        return [body], furniture.make_chair(Place.of(source, body), rng)
    arms = {"stool": "free", "chair": "free", "desk": "desk"}.get(prop, "rests")
    bodies = [draw_seated(source, rng, arms) for _ in range(2 if prop == "couple" else 1)]
    if prop == "couple":
        apart = rng.uniform(*COUPLE_GAP_M) / 2
        bodies = [
            body.translate(np.array([0.0, side * apart, 0.0])) for body, side in zip(bodies, (1, -1), strict=True)
        ]
        seat = [Place.of(source, body).seat for body in bodies]
        # Who has shorter legs sits as high and further to the front.
        bodies = [body.translate(np.array([0.0, 0.0, max(seat) - own])) for body, own in zip(bodies, seat, strict=True)]
    places = [Place.of(source, body) for body in bodies]
    if prop in ("armchair", "sofa", "couple"):
        return bodies, furniture.make_sofa(places, rng, prop != "armchair")
    if prop == "stool":
        return bodies, furniture.make_stool(places[0], rng)
    if prop == "wheelchair":
        return bodies, furniture.make_wheelchair(places[0], rng)
    chair = furniture.make_chair(places[0], rng)
    return bodies, [*chair, *furniture.make_desk(places[0], rng)] if prop == "desk" else chair
