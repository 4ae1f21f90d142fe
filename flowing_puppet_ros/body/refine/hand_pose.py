# SPDX-License-Identifier: Apache-2.0
"""Open, bent or closed hands: from half-closed fingers the finish does not find the way, so it starts from all of them.

Fingers that are bent the wrong way lie in the air, where no closest point leads them on. The strongest two components
of the hand's deformations bend the fingers at their joints and at the knuckles; each is tried either way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

STARTS = ((1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5))
STEPS = RefineWeights(sigma_start=0.05, sigma_end=0.03, iterations=5)
CLOSE = 0.015
"""Metres at which a vertex or point counts as half explained."""


def refine_hand_pose(model: StitchedPuppet, refiner: GaussNewton, state: BodyState, cloud: Cloud) -> BodyState:
    """Return the body with the hands that lie closest to a dense cloud seen from all sides, each chosen by itself."""
    hands = [part for part, name in enumerate(model.tree.names) if name.endswith("_hand")]
    none, matches = JointTargets.none(model), TwoWayCorrespondence(cloud)
    tried = [state]
    for start in STARTS:
        pose = state.pose.copy()
        pose[hands] = 0.0
        pose[hands, : len(start)] = start
        tried.append(refiner.run(replace(state, pose=pose), cloud, none, STEPS))
    costs = np.array([_costs(model, body, matches, hands) for body in tried])
    best = costs.argmin(axis=0)
    if not best.any():
        return state
    center, rotation, pose = state.center.copy(), state.rotation.copy(), state.pose.copy()
    for hand, chosen in zip(hands, best, strict=True):
        body = tried[chosen]
        center[hand], rotation[hand], pose[hand] = body.center[hand], body.rotation[hand], body.pose[hand]
    return refiner.run(BodyState(center, rotation, pose, state.shape), cloud, none, STEPS)


def _costs(model: StitchedPuppet, body: BodyState, matches: TwoWayCorrespondence, hands: list[int]) -> list[float]:
    """Share of each hand that is not on the cloud and of the cloud about it that is not on the hand, 0 to 2."""
    there, vertex, back = matches.nearest(model.vertices(body), model.faces)
    away, astray = (gap**2 / (gap**2 + CLOSE**2) for gap in (there, back))
    owner = model.part_of_vertex
    return [
        float(away[owner == hand].mean() + (astray[owner[vertex] == hand].mean() if hand in owner[vertex] else 1.0))
        for hand in hands
    ]
