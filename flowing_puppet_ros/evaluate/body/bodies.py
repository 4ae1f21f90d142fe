# SPDX-License-Identifier: Apache-2.0
"""Errors of bodies fitted to synthetic scans of people whose every vertex is known."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.evaluate.body.garments import OUTFITS, Tailor
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import (
    DepthSettings,
    RaycastScene,
    SensedCloud,
    draw_sensor_position,
    scan_depth,
    scan_lidar,
    scan_whole,
)
from flowing_puppet_ros.model.sp import StitchedPuppet

WHOLE_SCAN_POINTS = 10000
# One person in so many is in a hard pose; 0 for none.
HARD_EVERY = {"whole": 2, "single": 4, "lidar": 0, "clothed": 0}
KINDS = tuple(HARD_EVERY)
DEPTH_DISTANCE_M, DEPTH_HEIGHT_M = (2.0, 4.0), (0.8, 1.8)  # minimum and maximum of the sensor
LIDAR_DISTANCE_M, LIDAR_HEIGHT_M = (4.5, 7.5), (1.6, 1.9)  # gives 300 to 800 points on a person
CLOTHED_NOISE_M = 0.001
MIN_BAD_ERROR_M = 0.04  # mean vertex error of a body with a misplaced limb
VISIBILITY_TOLERANCE_M = 0.005  # a vertex this far behind the first hit of its ray is still visible


@dataclass(frozen=True, slots=True)
class BodyScore:
    """One fit against the truth; distances are means in metres.

    Attributes:
        hard: whether the pose was drawn from joint limits alone.
        points: of the cloud.
        vertex_error: over all vertices of the template.
        visible_error: over the visible vertices; of a whole scan, all.
        joint_error: over all joints.
        flipped: whether the body is nearer to the truth with left and right swapped.
        two_way_distance, confidence, reliable: as reported by the fit.
        seconds: processor time of the fit.
    """

    hard: bool
    points: int
    vertex_error: float
    visible_error: float
    joint_error: float
    flipped: bool
    two_way_distance: float
    confidence: float
    reliable: bool
    seconds: float


def draw_scans(
    kind: str, source: BodySource, count: int, seed: int
) -> Iterator[tuple[TrueBody, RaycastScene, SensedCloud]]:
    """Draw `count` people and scan them: whole, bare or clothed, from one side by a depth camera, or by a LiDAR.

    Every pose is hard when the source has no motion capture.
    """
    rng = np.random.default_rng(seed)
    every = HARD_EVERY[kind]
    tailor = Tailor(source) if kind == "clothed" else None
    for index in range(count):
        body = source.draw_body(rng, hard=not source.has_mocap or (every > 0 and index % every == every - 1))
        scene = RaycastScene(body.vertices, source.triangles)
        if tailor is not None:
            worn = RaycastScene(*tailor.dress(body, OUTFITS[index % len(OUTFITS)], rng))
            yield body, worn, scan_whole(worn, rng, WHOLE_SCAN_POINTS, noise=CLOTHED_NOISE_M)
        elif kind == "whole":
            yield body, scene, scan_whole(scene, rng, WHOLE_SCAN_POINTS)
        elif kind == "single":
            eye = draw_sensor_position(rng, body.vertices, DEPTH_DISTANCE_M, DEPTH_HEIGHT_M)
            yield body, scene, scan_depth(scene, rng, eye, DepthSettings())
        else:
            eye = draw_sensor_position(rng, body.vertices, LIDAR_DISTANCE_M, LIDAR_HEIGHT_M)
            yield body, scene, scan_lidar(scene, rng, eye)


def score_fit(
    fitter: BodyFitter,
    body: TrueBody,
    scene: RaycastScene,
    cloud: SensedCloud,
    joint_names: Sequence[str],
    beneath: bool = False,
) -> tuple[BodyFit, BodyScore]:
    """Fit a model to a synthetic cloud and compare with the truth; `joint_names` name the body's joints.

    The surface is compared, or the body `beneath` what is worn.
    """
    started = time.process_time()
    fit = fitter.fit(cloud.points, cloud.normals, viewpoint=cloud.viewpoint)
    seconds = time.process_time() - started
    truth = body.template_vertices(fitter.model.name)
    joints = body.joints[[list(joint_names).index(name) for name in fitter.model.joint_names]]
    vertices = fitter.model.vertices(fit.state) if beneath else fit.vertices
    error = np.linalg.norm(vertices - truth, axis=1)
    return fit, BodyScore(
        hard=body.hard,
        points=len(cloud.points),
        vertex_error=float(error.mean()),
        visible_error=float(error[find_visible_vertices(scene, truth, cloud.viewpoint)].mean()),
        joint_error=float(np.linalg.norm(fit.joints - joints, axis=1).mean()),
        flipped=is_flipped(vertices, truth, fitter.model),
        two_way_distance=fit.two_way_distance,
        confidence=fit.confidence,
        reliable=fit.reliable,
        seconds=seconds,
    )


def is_flipped(vertices: np.ndarray, truth: np.ndarray, model: StitchedPuppet) -> bool:
    """Return whether a body (V, 3) is nearer to the truth (V, 3) with left and right swapped, as if it faced back."""
    own = np.linalg.norm(vertices - truth, axis=1).mean()
    return bool(np.linalg.norm(vertices[model.mirror_vertex] - truth, axis=1).mean() < own)


def find_visible_vertices(scene: RaycastScene, vertices: np.ndarray, viewpoint: np.ndarray | None) -> np.ndarray:
    """Return which vertices (V,) on a scene's surface are visible from `viewpoint`; without a viewpoint, all."""
    if viewpoint is None:
        return np.ones(len(vertices), dtype=bool)
    rays = vertices - viewpoint
    length = np.linalg.norm(rays, axis=1)
    return scene.cast(viewpoint, rays / length[:, None])[0] > length - VISIBILITY_TOLERANCE_M


def summarise(scores: Sequence[BodyScore]) -> dict[str, float]:
    """Summarise many fits; distances in centimetres.

    `unreliable` counts the fits that report themselves as unreliable, `bad` those with a mean error above 4 cm.
    """
    vertex = 100 * np.array([score.vertex_error for score in scores])
    return {
        "bodies": len(scores),
        "vertex_mean_cm": float(vertex.mean()),
        "vertex_median_cm": float(np.median(vertex)),
        "vertex_worst_cm": float(vertex.max()),
        "visible_mean_cm": 100 * float(np.mean([score.visible_error for score in scores])),
        "joints_mean_cm": 100 * float(np.mean([score.joint_error for score in scores])),
        "two_way_mean_cm": 100 * float(np.mean([score.two_way_distance for score in scores])),
        "flipped": sum(score.flipped for score in scores),
        "unreliable": sum(not score.reliable for score in scores),
        "bad": sum(score.vertex_error > MIN_BAD_ERROR_M for score in scores),
        "bad_unreliable": sum(score.vertex_error > MIN_BAD_ERROR_M and not score.reliable for score in scores),
        "confidence_lowest": min(score.confidence for score in scores),
        "seconds_mean": float(np.mean([score.seconds for score in scores])),
        "seconds_worst": max(score.seconds for score in scores),
    }
