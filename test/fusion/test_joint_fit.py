# SPDX-License-Identifier: Apache-2.0
"""Starts from few joints, what joints pull in the last steps, and the price of a hidden limb along its ray."""

import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.fusion.joint_fit import JointFitter
from flowing_puppet_ros.fusion.lift import LiftedJoints
from flowing_puppet_ros.fusion.limb_search import measure_joint_cost
from flowing_puppet_ros.model.sp import StitchedPuppet

# Somebody seen from the side, cut off at the hips: lifted joints with confidence and whether they are hidden.
SIDE_VIEW = {
    "right_shoulder": (1.64, 2.81, 0.16, 0.87, False), "left_shoulder": (1.77, 3.16, 0.20, 0.27, True),
    "right_elbow": (1.78, 2.68, 0.18, 0.77, False), "left_elbow": (1.74, 2.92, 0.11, 0.5, True),
    "right_wrist": (1.91, 2.85, 0.30, 0.8, False), "left_wrist": (1.74, 2.68, 0.21, 0.55, False),
}  # fmt: skip
TRUE_HIPS = {"left_hip": (1.77, 3.07, -0.20), "right_hip": (1.73, 2.88, -0.21)}


def lift(model: StitchedPuppet, given: dict[str, tuple[float, float, float, float, bool]]) -> LiftedJoints:
    count = len(model.joint_names)
    points, confidence, hidden = np.full((count, 3), np.nan), np.zeros(count), np.zeros(count, dtype=bool)
    for name, (x, y, z, sure, behind) in given.items():
        row = model.joint_names.index(name)
        points[row], confidence[row], hidden[row] = (x, y, z), sure, behind
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return LiftedJoints(points, rays, confidence, hidden, np.zeros(count, dtype=bool), 3.0, np.zeros(3), {})


@pytest.fixture(scope="module")
def fitter(model: StitchedPuppet) -> JointFitter:
    return JointFitter(BodyFitter(model, FitterSettings()), 0.02)


def test_the_trunk_is_upright_where_only_shoulders_and_arms_are_known(
    model: StitchedPuppet, fitter: JointFitter
) -> None:
    joints = model.joints(model.vertices(fitter.start(lift(model, SIDE_VIEW))))
    for name, place in TRUE_HIPS.items():
        assert np.linalg.norm(joints[model.joint_names.index(name)] - place) < 0.25


def test_joints_hold_a_body_in_the_last_steps_as_far_as_it_is_out_of_sight(
    model: StitchedPuppet, fitter: JointFitter
) -> None:
    joints = lift(model, SIDE_VIEW)
    targets = fitter.make_targets(joints)
    seen, hidden = (model.joint_names.index(name) for name in ("right_wrist", "left_elbow"))
    whole, cut, most = (fitter.hold(joints, targets, unknown).weight for unknown in (0.0, 0.075, 0.5))
    assert whole[seen] == 0 and 0 < cut[seen] < most[seen] < targets.weight[seen]
    assert whole[hidden] == cut[hidden] == most[hidden] == targets.weight[hidden] > 0


def test_a_hidden_limb_along_its_ray_costs_more_than_where_its_bones_are_likely(model: StitchedPuppet) -> None:
    joints = lift(model, SIDE_VIEW)
    row = model.joint_names.index("left_elbow")
    counted = np.arange(len(model.joint_names)) == row
    there = np.nan_to_num(joints.points)
    moved = [there.copy() for _ in range(3)]
    for places, along in zip(moved, (0.0, 0.15, 0.3), strict=True):
        places[row] += along * joints.rays[row]
    cost = measure_joint_cost(np.array(moved), joints, counted)
    assert cost[0] == 0 and 0 < cost[1] < cost[2]
