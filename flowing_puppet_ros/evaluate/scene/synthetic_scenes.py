# SPDX-License-Identifier: Apache-2.0
"""Synthetic scenes with known people: rooms, streets and halls, seen by scanners of several kinds.

Metres, z up. The people are Anny bodies, which no puppet model generated. What stands around them is made of boxes and
prisms that are as large as people, or as thin, or as close together, because those are what is taken for people.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.scene.lookalikes import add_lookalikes
from flowing_puppet_ros.evaluate.scene.scene_meshes import HALF_SIZE_M, MAKERS, MAX_TRIES, Disc, Mesh, stand_box
from flowing_puppet_ros.extras import import_extra

PLACES = ("room", "street", "hall")
SCANNERS = ("spinning-32", "spinning-64", "solid-state", "spinning-16", "dome", "depth")
ELEVATION_DEG = {
    "spinning-16": (-15.0, 15.0),
    "spinning-32": (-25.0, 15.0),
    "spinning-64": (-24.0, 8.0),
    "dome": (-7.0, 52.0),
}
"""Lowest and highest ray of scanners that see all around."""
DOME_HEIGHT_M = (0.3, 1.0)
"""Of a scanner that sees little below its horizon: it stands low, on any floor."""
DOME_RAYS, DOME_TURNS, DOME_SWEEPS = 20_000, 10.07, 211.3
"""Rays of a scan that never repeats itself, the turns of the mirror in it, and its sweeps up and down."""
SENSOR_HEIGHT_M = {"room": (0.5, 2.2), "street": (1.5, 2.2), "hall": (0.6, 3.0)}
DISTANCE_M = {"room": (2.0, 8.0), "street": (3.0, 20.0), "hall": (3.0, 16.0)}  # of the people
MIN_PERSON_GAP_M = 0.55  # between the middles of two people
MAX_RANGE_M = 60.0  # of the scanners
MIN_DROP_M, MEAN_DROP_M = 0.5, 4.0
"""Distance of the nearest drop, and of a drop beyond it in the mean: farther ones send little back."""
MAX_TRUNK_TILT_RAD, MIN_UPRIGHT_SHARE = np.radians(35.0), 0.85
"""Tilt of the trunk, and height over the stature, of people who stand or walk."""
MIN_COVER_M, MAX_COVER_M, COVER_GAP_M = (0.3, 1.0, 0.6), (1.8, 4.0, 1.4), 0.5
"""Depth, width and height of what stands before people who are covered, and how far from their middle."""

MAX_BEARING_RAD = 0.5  # of people before scanners that look ahead only


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene:
    """A scan of a scene in the sensor's frame, z up, the sensor at the origin.

    Attributes:
        points: (N, 3) metres.
        owner: (N,) index of the person whom the point is on, -1 for the surroundings.
        people: the bodies.
        floor: metres, z of the floor.
    """

    points: np.ndarray
    owner: np.ndarray
    people: list[TrueBody]
    floor: float


type Draw = Callable[[BodySource, np.random.Generator], tuple[list[TrueBody], list[Mesh]]]
"""Draws people about x = y = 0 on the floor, and what they sit or stand on."""


@dataclass(frozen=True, slots=True)
class SceneKind:
    """What makes a scene harder, beside what every place has; without it the same random numbers follow.

    Attributes:
        lookalikes: other things that stand as people do.
        covered: share of the people before whom something as high as a table or a car stands.
        rain: share of the rays that end on a drop, unless something nearer stops them.
        height: metres, of the sensor over the floor; None: drawn.
        draw: draws a person; None: one who stands or walks.
        empty: number of things more, and what draws each, such as seats on which nobody sits.
    """

    lookalikes: int = 0
    covered: float = 0.0
    rain: float = 0.0
    height: float | None = None
    draw: Draw | None = None
    empty: tuple[int, Draw] | None = None


def draw_scene(
    source: BodySource,
    rng: np.random.Generator,
    place: str,
    scanner: str,
    people: int,
    kind: SceneKind = SceneKind(),
) -> SyntheticScene:
    """Draw a scene with `people` people, who stand or walk or are as `kind` says, and scan it.

    As many as find a free place are in it.
    """
    height = draw_height(rng, place, scanner, kind.height)
    meshes, blocked = make_place(rng, place, kind.lookalikes)
    bodies, beneath = place_people(source, rng, place, people, blocked, find_view(scanner), kind)
    meshes += beneath
    if kind.covered:
        meshes += cover_people(rng.spawn(1)[0], bodies, kind.covered)
    visible = [(body.vertices, source.triangles) for body in bodies]
    points, owner = scan_scene(meshes, visible, rng, scanner, height, kind.rain)
    down = np.array([0.0, 0.0, -height])
    return SyntheticScene(points, owner, [body.translate(down) for body in bodies], -height)


def draw_height(rng: np.random.Generator, place: str, scanner: str, given: float | None = None) -> float:
    """Draw the height of a scanner over the floor of a place, metres, unless it is given."""
    drawn = float(rng.uniform(*(DOME_HEIGHT_M if scanner == "dome" else SENSOR_HEIGHT_M[place])))
    return drawn if given is None else given


def find_view(scanner: str) -> float:
    """Return how far a scanner sees to either side of x, radians; of one that looks ahead, where people are put."""
    return float(np.pi) if scanner in ELEVATION_DEG else MAX_BEARING_RAD


def make_place(rng: np.random.Generator, place: str, lookalikes: int) -> tuple[list[Mesh], list[Disc]]:
    """Make what stands in a place, with `lookalikes` of things that stand as people do, and the places these take.

    Without any, the same random numbers follow.
    """
    meshes, blocked = MAKERS[place](rng)
    if lookalikes:
        meshes += add_lookalikes(rng.spawn(1)[0], place, blocked, lookalikes)
    return meshes, blocked


def cover_people(rng: np.random.Generator, people: Sequence[TrueBody], share: float) -> list[Mesh]:
    """Make boxes between the sensor and a share of the people: tables, counters, cars."""
    boxes = []
    for body in people:
        if rng.random() < share:
            x, y = body.joints.mean(axis=0)[:2]
            away, size = float(np.hypot(x, y)), rng.uniform(MIN_COVER_M, MAX_COVER_M)
            near = (away - COVER_GAP_M - size[0] / 2) / away
            boxes.append(stand_box(near * x, near * y, 0.0, size, float(np.arctan2(y, x))))
    return boxes


def place_people(
    source: BodySource,
    rng: np.random.Generator,
    place: str,
    count: int,
    blocked: Sequence[Disc],
    view: float,
    kind: SceneKind = SceneKind(),
) -> tuple[list[TrueBody], list[Mesh]]:
    """Draw people at free places, `view` radians to either side of x, and what they sit or stand on.

    `blocked` are taken places.
    """
    taken = list(blocked)
    bodies: list[TrueBody] = []
    meshes: list[Mesh] = []
    half, distance = HALF_SIZE_M[place], DISTANCE_M[place]
    for _ in range(MAX_TRIES):
        if len(bodies) == count:
            break
        away, angle = rng.uniform(*distance), rng.uniform(-view, view)
        x, y = away * np.cos(angle), away * np.sin(angle)
        if bodies and rng.random() < 0.3:  # a group
            x, y = bodies[-1].joints.mean(axis=0)[:2] + rng.uniform(0.55, 0.9) * np.array(
                [np.cos(angle), np.sin(angle)]
            )
        if abs(x) > half[0] - 0.4 or abs(y) > half[1] - 0.4 or np.hypot(x, y) < 1.5:
            continue
        if any(np.hypot(x - a, y - b) < radius for a, b, radius in taken):
            continue
        if kind.draw is None:
            bodies.append(draw_upright(source, rng).translate(np.array([x, y, 0.0])))
            taken.append((x, y, MIN_PERSON_GAP_M))
            continue
        drawn = kind.draw(source, rng)
        if _has_room(drawn, half, (x, y), taken):
            _add(drawn, (x, y), bodies, meshes, taken)
    if kind.empty is not None:
        number, draw = kind.empty
        aside = rng.spawn(1)[0]
        for _ in range(MAX_TRIES):
            x, y = aside.uniform(-half[0], half[0]), aside.uniform(-half[1], half[1])
            drawn = draw(source, aside)
            if np.hypot(x, y) > distance[0] and _has_room(drawn, half, (x, y), taken):
                _add(drawn, (x, y), bodies, meshes, taken)
                number -= 1
            if number <= 0:
                break
    return bodies, meshes


def _measure_reach(drawn: tuple[list[TrueBody], list[Mesh]]) -> float:
    """Return how far people and things reach from x = y = 0, metres."""
    every = [body.vertices for body in drawn[0]] + [vertices for vertices, _ in drawn[1]]
    return max(float(np.hypot(*vertices[:, :2].T).max()) for vertices in every)


def _has_room(
    drawn: tuple[list[TrueBody], list[Mesh]], half: Sequence[float], at: tuple[float, float], taken: Sequence[Disc]
) -> bool:
    """Return whether people and things fit at (x, y) m, in a place of `half` a size, beside what is `taken`."""
    reach = _measure_reach(drawn)
    inside = abs(at[0]) < half[0] - reach and abs(at[1]) < half[1] - reach
    return inside and all(np.hypot(at[0] - a, at[1] - b) > radius - 0.3 + reach for a, b, radius in taken)


def _add(
    drawn: tuple[list[TrueBody], list[Mesh]],
    at: tuple[float, float],
    bodies: list[TrueBody],
    meshes: list[Mesh],
    taken: list[Disc],
) -> None:
    """Put people and things at (x, y) m, and note that the place is taken."""
    step = np.array([*at, 0.0])
    bodies += [body.translate(step) for body in drawn[0]]
    meshes += [(vertices + step, triangles) for vertices, triangles in drawn[1]]
    taken.append((*at, _measure_reach(drawn) + 0.3))


def draw_upright(source: BodySource, rng: np.random.Generator) -> TrueBody:
    """Draw a person who stands or walks, hips at x = y = 0."""
    while True:
        body = source.draw_body(rng, hard=False)
        if is_upright(body, source.joint_names):
            return body


def is_upright(body: TrueBody, names: Sequence[str]) -> bool:
    """Return whether somebody whose joints have these names stands or walks."""
    joint = dict(zip(names, body.joints, strict=True))
    hips = (joint["left_hip"] + joint["right_hip"]) / 2
    trunk = (joint["left_shoulder"] + joint["right_shoulder"]) / 2 - hips
    legs = [
        np.linalg.norm(joint[f"{side}_hip"] - joint[f"{side}_knee"])
        + np.linalg.norm(joint[f"{side}_knee"] - joint[f"{side}_ankle"])
        for side in ("left", "right")
    ]
    stretched = (hips[2] - min(joint["left_ankle"][2], joint["right_ankle"][2])) / max(legs)
    return bool(trunk[2] / np.linalg.norm(trunk) > np.cos(MAX_TRUNK_TILT_RAD) and stretched > MIN_UPRIGHT_SHARE)


def scan_scene(
    meshes: Sequence[Mesh],
    people: Sequence[Mesh],
    rng: np.random.Generator,
    scanner: str,
    height: float,
    rain: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Scan meshes from (0, 0, `height`) m; return points (N, 3) in the sensor's frame and whose they are (N,).

    A share of the rays, `rain`, meets a drop.
    """
    o3d = import_extra("open3d", "scans", "a scan of synthetic people")

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, triangles in (*people, *meshes):
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32)),
        )
    directions, noise = make_rays(rng, scanner)
    origins = np.broadcast_to(np.array([0.0, 0.0, height]), directions.shape)
    rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
    distance, geometry = hits["t_hit"].numpy().astype(np.float64), hits["geometry_ids"].numpy().astype(np.int64)
    if rain:
        drops = draw_drops(rng.spawn(1)[0], len(distance), rain)
        geometry[drops < distance] = len(people)
        distance = np.minimum(distance, drops)
    seen = np.isfinite(distance) & (distance < MAX_RANGE_M)
    ranged = distance[seen]
    deviation = noise if scanner != "depth" else 0.0012 * ranged**2
    ranged = ranged + deviation * rng.standard_normal(len(ranged))
    if scanner == "depth":
        near = ranged < 8.0
        ranged, seen = ranged[near], np.flatnonzero(seen)[near]
    owner = geometry[seen]
    return directions[seen] * ranged[:, None], np.where(owner < len(people), owner, -1)


def draw_drops(rng: np.random.Generator, rays: int, share: float) -> np.ndarray:
    """Return the distance (`rays`,) of the drop that each ray would meet, metres; infinite for all but a share."""
    away = MIN_DROP_M + rng.exponential(MEAN_DROP_M, rays)
    return np.where(rng.random(rays) < share, away, np.inf)


def make_rays(rng: np.random.Generator, scanner: str) -> tuple[np.ndarray, float]:
    """Return the unit directions (N, 3) of a scanner's rays in the order of the scan, and its range noise in metres."""
    if scanner.startswith("spinning"):
        elevation = np.radians(np.linspace(*ELEVATION_DEG[scanner], int(scanner.rpartition("-")[2])))
        azimuth = np.radians(np.arange(0, 360, 0.2)) + rng.uniform(0, 0.003)
        a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
        noise = 0.02
    elif scanner == "dome":
        turn = np.linspace(0, 2 * np.pi, DOME_RAYS) + rng.uniform(0, 2 * np.pi)
        low, high = np.radians(ELEVATION_DEG[scanner])
        a = DOME_TURNS * turn
        e = low + (high - low) * np.arccos(np.cos(DOME_SWEEPS * turn)) / np.pi
        noise = 0.02
    elif scanner == "solid-state":
        # A rosette: two prisms turn at different speeds.
        turn = np.linspace(0, 2 * np.pi, 60_000) + rng.uniform(0, 2 * np.pi)
        radius = np.radians(35.0) * np.cos(977.31 * turn)
        a, e = radius * np.cos(411.7 * turn), radius * np.sin(411.7 * turn)
        noise = 0.02
    else:
        u, v = np.meshgrid((np.arange(0, 640, 2) - 320) / 525, (np.arange(0, 480, 2) - 240) / 525)
        rays = np.stack([np.ones(u.size), -u.ravel(), -v.ravel() - 0.1], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True), 0.005
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1), noise
