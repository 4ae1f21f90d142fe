# SPDX-License-Identifier: Apache-2.0
"""Refines hands from open, bent and closed fingers, because from half-closed ones Gauss-Newton cannot find the pose.

Fingers that are bent the wrong way lie in the air, where no closest point leads to the cloud. The strongest two
components of a hand's deformation bend the fingers at their joints and at the knuckles; each is tried both ways.
Nor can Gauss-Newton turn a hand over whose palm is where its back should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, TwoWayCorrespondence
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

STARTS = ((1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5))  # first pose coefficients of a hand, standard deviations
# A few steps from each start, and from the best hands.
WEIGHTS = RefineWeights(sigma_start=0.05, sigma_end=0.03, iterations=5)
HALF_EXPLAINED_M = 0.015
"""Distance at which a vertex or point counts as half explained."""
MIN_WRONG_COST = 1.15
"""Cost of a hand from which on it may be turned over: those that are cost 1.3 or more, others 0.6 to 1.05."""
HAND_TURN_RAD, LOWER_ARM_TURN_RAD = 2.2, 0.8
"""By how much a hand and its lower arm are turned; Gauss-Newton does the rest in these steps."""
TURNED_WEIGHTS = replace(WEIGHTS, iterations=10)


def refine_hand_pose(model: StitchedPuppet, refiner: GaussNewton, state: BodyState, cloud: Cloud) -> BodyState:
    """Return the body with each hand in the pose that lies closest to a dense cloud seen from all sides.

    A hand that lies badly on the cloud is also tried turned over, with the lower arm's twist, both ways round.
    """
    hands = [part for part, name in enumerate(model.tree.names) if name.endswith("_hand")]
    none, matches = JointTargets.none(model), TwoWayCorrespondence(cloud)
    body, costs = _choose_fingers(model, refiner, state, cloud, matches)
    wrong = [hand for hand, cost in zip(hands, costs, strict=True) if cost > MIN_WRONG_COST]
    if not wrong:
        return body
    tried = [body] + [
        refiner.run(_turn_over(model, body, wrong, sign), cloud, none, TURNED_WEIGHTS) for sign in (1.0, -1.0)
    ]
    best = np.argmin([_hand_costs(model, each, matches, hands) for each in tried], axis=0)
    if not best.any():
        return body
    turned = _take_parts(tried, best, [(model.tree.parents[hand], hand) for hand in hands])
    return _choose_fingers(model, refiner, turned, cloud, matches)[0]


def _choose_fingers(
    model: StitchedPuppet, refiner: GaussNewton, state: BodyState, cloud: Cloud, matches: TwoWayCorrespondence
) -> tuple[BodyState, np.ndarray]:
    """Return the body with each hand's fingers open, bent or closed, and the `_hand_costs` of that."""
    hands = [part for part, name in enumerate(model.tree.names) if name.endswith("_hand")]
    none, tried = JointTargets.none(model), [state]
    for start in STARTS:
        pose = state.pose.copy()
        pose[hands] = 0.0
        pose[hands, : len(start)] = start
        tried.append(refiner.run(replace(state, pose=pose), cloud, none, WEIGHTS))
    costs = np.array([_hand_costs(model, body, matches, hands) for body in tried])
    best = costs.argmin(axis=0)
    if not best.any():
        return state, costs[0]
    chosen = _take_parts(tried, best, [(hand,) for hand in hands])
    return refiner.run(chosen, cloud, none, WEIGHTS), costs.min(axis=0)


def _take_parts(bodies: Sequence[BodyState], best: np.ndarray, groups: Sequence[tuple[int, ...]]) -> BodyState:
    """Return the first body with each group of parts from the body of number `best` (G,)."""
    center, rotation, pose = bodies[0].center.copy(), bodies[0].rotation.copy(), bodies[0].pose.copy()
    for group, chosen in zip(groups, best, strict=True):
        body, parts = bodies[chosen], list(group)
        center[parts], rotation[parts], pose[parts] = body.center[parts], body.rotation[parts], body.pose[parts]
    return BodyState(center, rotation, pose, bodies[0].shape)


def _turn_over(model: StitchedPuppet, body: BodyState, hands: Sequence[int], sign: float) -> BodyState:
    """Return the body with hands, and less so their lower arms, turned about the lower arms; fingers at their mean."""
    center, rotation, pose = body.center.copy(), body.rotation.copy(), body.pose.copy()
    joints = dict(zip(model.joint_names, model.joints(model.vertices(body)), strict=True))
    for hand in hands:
        side = model.tree.names[hand].partition("_")[0]
        wrist = joints[f"{side}_wrist"]
        along = wrist - joints[f"{side}_elbow"]
        along = sign * along / max(float(np.linalg.norm(along)), 1e-9)
        for part, angle in ((hand, HAND_TURN_RAD), (model.tree.parents[hand], LOWER_ARM_TURN_RAD)):
            turn = so3.exp(angle * along)
            rotation[part], center[part] = turn @ rotation[part], wrist + turn @ (center[part] - wrist)
        pose[hand] = 0.0
    return BodyState(center, rotation, pose, body.shape)


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
