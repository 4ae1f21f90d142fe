# SPDX-License-Identifier: Apache-2.0
"""Scans of a hall in which five people walk, 90,000 points each, and where the time of one that is tracked goes."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks import stages
from flowing_puppet_ros.body.bank.upright_bank import make_upright_bank
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation import candidates as segmentation
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights
from flowing_puppet_ros.body.segmentation.seen_free import SeenFree
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track import multi_body_tracker, scene_tracker
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTrackerSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.body.upright import person_finder
from flowing_puppet_ros.body.upright.person_finder import PersonFinder
from flowing_puppet_ros.body.upright.person_model import DecisionTrees
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.evaluate.scene.scene_meshes import MAKERS
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import StitchedPuppet

POINTS, SCANS, PEOPLE = 90_000, 6, 5
SCAN_NS, WALK_M = 100_000_000, 0.1  # from scan to scan
ROUND = 60  # scans in which somebody walks a whole circle
SENSOR_M, RANGE_M = 2.0, (4.0, 9.0)  # height, and distances of the people
CLEAR_M = 1.0  # about where people walk, without furniture
STAGES: dict[str, list[tuple[Any, str]]] = {
    "floor and index": [(SceneHeights, "of")],
    "linkage": [(segmentation, "thin_points"), (segmentation, "link_points")],
    "candidates": [(person_finder, "find_candidates")],
    "filter": [(person_finder, "describe_candidates"), (DecisionTrees, "predict")],
    "rays": [(ScanRays, "find_window")],
    "places seen free": [(SeenFree, "add")],
    "full fits": [(BodyFitter, "fit")],
    "new bodies": [(PersonFinder, "_fit_offered")],
    "tracked bodies asked": [(PersonFinder, "judge")],
    "range image": [(SceneCloud, "draw_image")],
    "tracked bodies": [(multi_body_tracker, "parallel_map")],
}


def measure_scene(seed: int) -> list[Row]:
    """Measure milliseconds of each stage of the first scan, and of those in which everybody is tracked."""
    model = StitchedPuppet.load()
    settings = SceneSettings(view="single", tracker=MultiBodyTrackerSettings())
    scans = draw_walk(model, seed, SCANS)
    runs: list[dict[str, float]] = []
    for _ in range(2):  # the first time compiles
        tracker = SceneTracker(BodyFitter(model, FitterSettings(threads=1)), settings)
        tracker.warm_up()
        runs, people = [], 0
        for number, points in enumerate(scans):
            cloud = SceneCloud(points, None, SCAN_NS * (number + 1), single_view=True)
            with stages.measure_stages(STAGES) as spent:
                people = len(tracker.step(cloud, seed)[0])
            runs.append(spent)
    rows = stages.make_rows("first scan", runs[:1]) + stages.make_rows("tracked", runs[1:])
    return [row | {"points": len(scans[-1]), "people": people} for row in rows]


def draw_walk(model: StitchedPuppet, seed: int, count: int) -> list[np.ndarray]:
    """Draw scans (N, 3) m of people who each walk a circle, as they face, once in `ROUND` scans."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(PEOPLE) / PEOPLE
    away = rng.uniform(*RANGE_M, PEOPLE)
    middles = np.stack([away * np.cos(around), away * np.sin(around)], axis=1)
    radius = WALK_M * ROUND / (2 * np.pi)
    bank = make_upright_bank(model)
    bodies = [model.vertices(bank.states[k]) for k in rng.integers(0, len(bank.states), PEOPLE)]
    meshes = [
        mesh
        for mesh in MAKERS["hall"](rng)[0]
        if np.ptp(mesh[0][:, :2], axis=0).max() > 5
        or np.linalg.norm(mesh[0][:, :2].mean(axis=0) - middles, axis=1).min() > radius + CLEAR_M
    ]
    scans = []
    for number in range(count):
        people = []
        for body, middle, start in zip(bodies, middles, around, strict=True):
            yaw = start + 2 * np.pi * number / ROUND
            place = middle + radius * np.array([np.sin(yaw), -np.cos(yaw)])
            turned = body @ so3.exp_one(np.array([0.0, 0.0, yaw])).T  # they face along x
            people.append((turned + np.array([*place, 0.0]), model.faces))
        points = scan_scene(meshes, people, rng, "spinning-64", SENSOR_M)[0]
        near = points[np.linalg.norm(points, axis=1) < scene_tracker.SceneSettings().segmentation.max_range]
        scans.append(near[np.linspace(0, len(near) - 1, min(POINTS, len(near))).astype(np.int64)])
    return scans
