# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt moves: they come back to surfaces, follow joints, and solve the residuals' own equations."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.levenberg import (
    CONTRADICTING_WEIGHT,
    POSE_PRIOR_WEIGHT,
    assemble,
    levenberg_marquardt,
    prepare_part,
)
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer, WalkNoise
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, look_up
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import StitchedPuppet

UPPER_LEG = 10


def copies(model: StitchedPuppet, count: int) -> list[Particles]:
    return states_to_particles(model, [model.rest_state()] * count)


def test_marquardt_brings_a_part_back_to_its_surface(model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
    mesh = model.parts(model.rest_state())[UPPER_LEG]
    part = PartPointsOf(model, UPPER_LEG, mesh)
    start = copies(model, 5)[UPPER_LEG]
    rng = np.random.default_rng(0)
    moved = Particles(
        start.center + rng.normal(0, 0.02, (5, 3)),
        so3.exp(rng.normal(0, 0.1, (5, 3))) @ start.rotation,
        start.pose,
        start.shape,
    )
    none = JointTargets.none(model)
    before = part.cost(points, moved)
    after = levenberg_marquardt(points[UPPER_LEG], moved, part.grid, none, 10, 60)
    assert np.all(part.cost(points, after) < before)
    assert part.cost(points, after).mean() < part.cost(points, start).mean() + 0.2 * (
        before.mean() - part.cost(points, start).mean()
    )
    still = levenberg_marquardt(points[UPPER_LEG], moved, part.grid, none, 0, 60)
    assert np.array_equal(still.center, moved.center)


def test_marquardt_follows_joint_targets(model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
    mesh = model.parts(model.rest_state())[UPPER_LEG]
    part = PartPointsOf(model, UPPER_LEG, mesh)
    start = copies(model, 1)[UPPER_LEG]
    knee = model.joint_names.index("right_knee")
    goal = model.joints(model.vertices(model.rest_state())) + np.array([0.1, 0.0, 0.0])
    weight = np.zeros(len(goal))
    weight[knee] = 100.0
    pulled = levenberg_marquardt(points[UPPER_LEG], start, part.grid, JointTargets(goal, weight), 15, 60)
    row = points[UPPER_LEG].joint_index.tolist().index(knee)
    np.testing.assert_allclose(points[UPPER_LEG].joints.to_world(pulled)[0, row], goal[knee], atol=0.01)


class PartPointsOf:
    """A cloud of one part and the data cost of particles against it."""

    def __init__(self, model: StitchedPuppet, part: int, mesh: np.ndarray) -> None:
        normals = vertex_normals(model.vertices(model.rest_state()), model.faces)[model.part_vertices[part]]
        self.grid = CloudGrid.build(mesh, normals, cell=0.01)
        self._part = part

    def cost(self, points: tuple[PartPoints, ...], particles: Particles) -> np.ndarray:
        own = points[self._part]
        return self.grid.data_cost(
            own.surface.to_world(particles), own.normals @ particles.rotation.transpose(0, 2, 1)
        )[0]


def test_marquardt_s_normal_equations_equal_finite_differences(
    model: StitchedPuppet, points: tuple[PartPoints, ...]
) -> None:
    """Against J^T W J and J^T W r of the world points, with the closest points held."""
    own, rng = points[UPPER_LEG], np.random.default_rng(5)
    part = PartPointsOf(model, UPPER_LEG, model.parts(model.rest_state())[UPPER_LEG])
    body = Proposer(model, points).random_walk(copies(model, 1)[UPPER_LEG], WalkNoise(0.05, 1.5, 1.0, 1.0), rng)
    goal, belief = rng.normal(size=(len(own.joints), 3)), rng.random(len(own.joints))

    def world(unknowns: np.ndarray) -> np.ndarray:
        rotation = body.rotation[0] @ so3.exp(unknowns[:3])
        center = body.center + unknowns[3:6] @ body.rotation[0].T
        moved = Particles(center, rotation[None], body.pose + unknowns[6:], body.shape)
        return np.concatenate([own.surface.to_world(moved)[0], own.joints.to_world(moved)[0]])

    zero, count = np.zeros(6 + body.pose.shape[1]), len(own.surface)
    found = [look_up(part.grid.nearest, part.grid.origin, part.grid.cell, *point) for point in world(zero)[:count]]
    residual = world(zero) - np.concatenate([part.grid.points[found], goal])
    agree = (part.grid.normals[found] * (own.normals @ body.rotation[0].T)).sum(axis=1) >= 0
    assert 0 < agree.sum() < count
    weight = np.repeat(np.concatenate([np.where(agree, 1.0, CONTRADICTING_WEIGHT) / count, belief]), 3)
    jacobian = np.stack([(world(e) - world(-e)).ravel() / 2e-6 for e in 1e-6 * np.eye(len(zero))], axis=1)
    hessian, gradient = (jacobian.T * weight) @ jacobian, (jacobian.T * weight) @ residual.ravel()
    cost = 0.5 * (weight * residual.ravel() ** 2).sum()
    hessian[6:, 6:] += POSE_PRIOR_WEIGHT * np.eye(len(zero) - 6)
    gradient[6:] += POSE_PRIOR_WEIGHT * body.pose[0]

    prepared = prepare_part(own, body, JointTargets(*belief_of(model, own, goal, belief)), count)
    found_hessian, found_gradient = np.ones_like(hessian), np.ones_like(gradient)
    state = body.center[0], body.rotation[0], body.pose[0]
    grid = (part.grid.points, part.grid.normals, part.grid.nearest, part.grid.origin, part.grid.cell)
    value = assemble(*state, prepared[0][0], prepared[1], grid, found_hessian, found_gradient)
    assert value == pytest.approx(cost + 0.5 * POSE_PRIOR_WEIGHT * (body.pose**2).sum())
    lower = np.tril_indices(len(zero))
    np.testing.assert_allclose(found_hessian[lower], hessian[lower], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(found_gradient, gradient, rtol=1e-5, atol=1e-8)


def belief_of(
    model: StitchedPuppet, own: PartPoints, goal: np.ndarray, belief: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Targets and weights of all joints where only those of a part have weight."""
    places, weight = np.zeros((len(model.joint_names), 3)), np.zeros(len(model.joint_names))
    places[own.joint_index], weight[own.joint_index] = goal, belief
    return places, weight
