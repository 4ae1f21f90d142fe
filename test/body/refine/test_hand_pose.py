# SPDX-License-Identifier: Apache-2.0
"""Hands that are closed in the cloud and open in the fit."""

import numpy as np
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.refine.hand_pose import refine_hand_pose
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import StitchedPuppet


def test_each_hand_is_closed_or_opened_as_the_cloud_has_it() -> None:
    model = StitchedPuppet.load("neutral")
    refiner = GaussNewton(model)
    left, right = model.tree.index("left_hand"), model.tree.index("right_hand")
    truth = model.rest_state()
    truth.pose[left, :2], truth.pose[right, :2] = (1.8, 0.5), (-1.2, 1.5)
    vertices = model.vertices(truth)
    cloud = Cloud.of(vertices, vertex_normals(vertices, model.faces))
    start = model.rest_state()
    start.pose[left, :2], start.pose[right, :2] = (-1.5, 0.0), (1.5, -1.0)
    with threadpool_limits(1):
        stuck = refiner.run(start, cloud, JointTargets.none(model), RefineWeights(sigma_start=0.05, iterations=8))
        found = refine_hand_pose(model, refiner, stuck, cloud)
        again = refine_hand_pose(model, refiner, found, cloud)
    stuck_hands = []
    for hand in (left, right):
        rows = model.part_of_vertex == hand
        before, after, kept = (
            np.linalg.norm(model.vertices(body) - vertices, axis=1)[rows].mean() for body in (stuck, found, again)
        )
        stuck_hands.append(before)
        assert after < 0.004
        assert after <= before + 1e-4
        assert kept < 0.004
    assert max(stuck_hands) > 0.01
    body = np.isin(model.part_of_vertex, [left, right], invert=True)
    assert np.linalg.norm(model.vertices(found) - vertices, axis=1)[body].mean() < 0.004


def test_a_hand_whose_palm_is_where_its_back_should_be_is_turned_over() -> None:
    model = StitchedPuppet.load("neutral")
    refiner = GaussNewton(model)
    hand, truth = model.tree.index("left_hand"), model.rest_state()
    vertices = model.vertices(truth)
    cloud = Cloud.of(vertices, vertex_normals(vertices, model.faces))
    wrist, tip = (model.joints(vertices)[model.joint_names.index(f"left_{name}")] for name in ("wrist", "hand"))
    turn = so3.exp(np.pi * (tip - wrist) / np.linalg.norm(tip - wrist))
    start = model.rest_state()
    start.rotation[hand], start.center[hand] = turn @ start.rotation[hand], wrist + turn @ (start.center[hand] - wrist)
    with threadpool_limits(1):
        stuck = refiner.run(start, cloud, JointTargets.none(model), RefineWeights(sigma_start=0.05, iterations=8))
        found = refine_hand_pose(model, refiner, stuck, cloud)
    rows = model.part_of_vertex == hand
    before, after = (np.linalg.norm(model.vertices(body) - vertices, axis=1)[rows].mean() for body in (stuck, found))
    assert before > 0.02
    assert after < 0.006
