# SPDX-License-Identifier: Apache-2.0
"""Whether a candidate is somebody who stands on a step, a kerb or a platform: their floor is its top."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights
from flowing_puppet_ros.body.upright.candidate_shape import describe_candidates
from flowing_puppet_ros.body.upright.found_body import ScanView
from flowing_puppet_ros.body.upright.person_model import DecisionTrees, PersonModel

STEPS_M = (0.12, 0.18, 0.24, 0.3, 0.36, 0.42)
"""Heights at which a step's top is looked for."""
FOOT_M = 0.04  # over the top of a step, from which on what is seen is not the step
MIN_TOP_M = 1.35  # height of somebody's head who stands on one
LEG_M, MIN_LEG_SHARE, MAX_LEGS_WIDTH_M = 0.35, 0.06, 0.7
"""Height over a step up to which legs are looked for, their least share of a candidate, and how far apart they are."""
MIN_GAIN = 0.08  # probability by shape by which somebody on a step is likelier


def find_step(candidate: Candidate, view: ScanView, min_points: int) -> tuple[Candidate, ScanView] | None:
    """Return a candidate without the step on which it looks most like a person, and the scan over that step's top.

    None where it looks as much like one on the floor, or has fewer than `min_points` without the step.
    """
    if candidate.top < MIN_TOP_M:
        return None
    trees = PersonModel.load().trees
    best, found = MIN_GAIN + _rate(trees, candidate, view.scene, view), None
    for step in STEPS_M:
        rows = candidate.rows[view.scene.height[candidate.rows] > step + FOOT_M]
        if len(rows) < min_points:
            break
        if not _shows_feet(candidate, view.scene, step):
            continue
        scene = _raise_floor(view.scene, step)
        cut = replace(Candidate.of(scene, rows), whole=candidate.whole)
        likely = _rate(trees, cut, scene, view)
        if likely > best:
            best, found = likely, (cut, replace(view, scene=scene))
    return found


def _shows_feet(candidate: Candidate, scene: SceneHeights, step: float) -> bool:
    """Return whether a step and legs on it are seen: who is hidden up to the knees, by a car, stands on the floor."""
    height = scene.height[candidate.rows]
    legs = (height > step + FOOT_M) & (height < step + LEG_M)
    if not (height < step).any() or legs.sum() < MIN_LEG_SHARE * len(height):
        return False
    return float(np.hypot(*np.ptp(scene.points[candidate.rows[legs], :2], axis=0))) < MAX_LEGS_WIDTH_M


def _rate(trees: DecisionTrees, candidate: Candidate, scene: SceneHeights, view: ScanView) -> float:
    return float(trees.predict(describe_candidates([candidate], scene, view.rays.viewpoint))[0])


def _raise_floor(scene: SceneHeights, step: float) -> SceneHeights:
    """Return a scene whose floor is higher by `step` m everywhere."""
    floor = replace(scene.floor, heights=scene.floor.heights + step)
    return replace(scene, height=scene.height - step, floor=floor)
