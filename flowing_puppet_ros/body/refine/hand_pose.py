# SPDX-License-Identifier: Apache-2.0
"""Refines hands from open, bent and closed fingers, because from half-closed ones Gauss-Newton cannot find the pose.

Fingers that are bent the wrong way lie in the air, where no closest point leads to the cloud. The strongest two
components of a hand's deformation bend the fingers at their joints and at the knuckles; each is tried both ways.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

STARTS = ((1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5))  # first pose coefficients of a hand, standard deviations
# A few steps from each start, and from the best hands.
WEIGHTS = RefineWeights(sigma_start=0.05, sigma_end=0.03, iterations=5)
HALF_EXPLAINED_M = 0.015
"""Distance at which a vertex or point counts as half explained."""


def refine_hand_pose(model: StitchedPuppet, refiner: GaussNewton, state: BodyState, cloud: Cloud) -> BodyState:
    """Return the body with each hand in the pose that lies closest to a dense cloud seen from all sides."""
    hands = [part for part, name in enumerate(model.tree.names) if name.endswith("_hand")]
    none, matches = JointTargets.none(model), TwoWayCorrespondence(cloud)
    tried = [state]
    for start in STARTS:
        pose = state.pose.copy()
        pose[hands] = 0.0
        pose[hands, : len(start)] = start
        tried.append(refiner.run(replace(state, pose=pose), cloud, none, WEIGHTS))
    costs = np.array([_hand_costs(model, body, matches, hands) for body in tried])
    best = costs.argmin(axis=0)
    if not best.any():
        return state
    center, rotation, pose = state.center.copy(), state.rotation.copy(), state.pose.copy()
    for hand, chosen in zip(hands, best, strict=True):
        body = tried[chosen]
        center[hand], rotation[hand], pose[hand] = body.center[hand], body.rotation[hand], body.pose[hand]
    return refiner.run(BodyState(center, rotation, pose, state.shape), cloud, none, WEIGHTS)


def _hand_costs(model: StitchedPuppet, body: BodyState, matches: TwoWayCorrespondence, hands: list[int]) -> list[float]:
    """Return for each hand its share off the cloud plus the share of the cloud near it that is off the hand, 0 to 2."""
    to_cloud, vertex, to_body = matches.find_nearest(model.vertices(body), model.faces)
    off_cloud, off_body = (gap**2 / (gap**2 + HALF_EXPLAINED_M**2) for gap in (to_cloud, to_body))
    owner = model.part_of_vertex
    return [
        float(
            off_cloud[owner == hand].mean() + (off_body[owner[vertex] == hand].mean() if hand in owner[vertex] else 1.0)
        )
        for hand in hands
    ]
