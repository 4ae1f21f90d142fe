# SPDX-License-Identifier: Apache-2.0
"""The joint Gauss-Newton over all parts: what else may draw the surface."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud, VertexQuadratic, two_way_distance
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.refine.gauss_newton import LOOSE_STITCHING, GaussNewton, RefineWeights
from flowing_puppet_ros.body.refine.joint_rows import JointRows
from flowing_puppet_ros.body.refine.normal_equations import NormalEquations
from flowing_puppet_ros.body.refine.tree_solution import TreeSolution
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


def test_a_further_term_draws_the_body_where_it_says() -> None:
    model = StitchedPuppet.load("neutral")
    start = model.rest_state()
    move = np.array([0.3, -0.2, 0.1])
    goal, count = model.vertices(start) + move, len(model.part_of_vertex)
    widths = []

    def springs(vertices: np.ndarray, sigma: float) -> VertexQuadratic:
        widths.append(sigma)
        return VertexQuadratic(np.tile(np.eye(3) / count, (count, 1, 1)), (vertices - goal) / count)

    weights = RefineWeights(sigma_start=0.2, sigma_end=0.05, iterations=5)
    body = GaussNewton(model).run(start, None, JointTargets.none(model), weights, [springs])
    miss = np.linalg.norm(model.vertices(body) - goal, axis=1)
    assert miss.max() < 0.01
    assert miss.mean() < 0.003
    np.testing.assert_allclose(widths, 0.2 * 0.25 ** (np.arange(5) / 4))


def test_without_evidence_the_shape_is_the_expected_one() -> None:
    model = StitchedPuppet.load("neutral")
    expected = np.linspace(-1.5, 1.5, model.shape_count)
    weights = RefineWeights(iterations=6, shape_center=expected)
    body = GaussNewton(model).run(model.rest_state(), None, JointTargets.none(model), weights)
    np.testing.assert_allclose(body.shape, np.tile(expected, (len(model.tree), 1)), atol=0.2)


def test_loose_parts_follow_a_foreign_surface_more_closely() -> None:
    model = StitchedPuppet.load("neutral")
    start = model.sample(np.random.default_rng(5), pose_scale=0.5)
    vertices = model.vertices(start)
    waves = 0.015 * np.sin(vertices @ [9.0, 7.0, 15.0])[:, None]
    truth = vertices + waves * vertex_normals(vertices, model.faces)
    cloud = Cloud.of(truth, vertex_normals(truth, model.faces))
    refiner, none = GaussNewton(model), JointTargets.none(model)
    firm = refiner.run(start, cloud, none, RefineWeights(sigma_start=0.05, sigma_end=0.05, iterations=6))
    loose = refiner.run(firm, cloud, none, LOOSE_STITCHING)
    apart = [two_way_distance(model.vertices(body), model.faces, cloud) for body in (start, firm, loose)]
    assert apart[2] < apart[1] - 0.0001 < apart[0]


def test_derivatives_of_the_joints_are_those_of_small_steps() -> None:
    """By the rotation and translation of each part in its own frame, by its pose and by the shape."""
    model = StitchedPuppet.load("neutral")
    equations, state = NormalEquations(model), model.sample(np.random.default_rng(2))
    rows, chosen, small = JointRows(model, equations), np.array([0, 3, 7, len(model.joint_names) - 1]), 1e-6
    derived = rows.derive(chosen, equations.pose_points(state), state.rotation)

    def move(unknown: int, amount: float) -> np.ndarray:
        center, rotation, pose, shape = (
            array.copy() for array in (state.center, state.rotation, state.pose, state.shape)
        )
        part = int(np.searchsorted(equations.first, unknown, side="right")) - 1
        place = unknown - int(equations.first[part])
        if part == len(model.tree):
            shape[:, place] += amount
        elif place < 3:
            rotation[part] = rotation[part] @ so3.exp(amount * np.eye(3)[place])
        elif place < 6:
            center[part] += amount * rotation[part][:, place - 3]
        else:
            pose[part, place - 6] += amount
        return model.joints(model.vertices(BodyState(center, rotation, pose, shape)))[chosen]

    stepped = [(move(unknown, small) - move(unknown, -small)) / (2 * small) for unknown in range(equations.size)]
    np.testing.assert_allclose(derived, np.stack(stepped, axis=2), atol=1e-8)
    assert (np.abs(derived).max(axis=(0, 1)) > 1e-3).sum() > 30


def test_a_system_over_a_tree_is_solved_like_any_other() -> None:
    rng, parents, first = np.random.default_rng(6), (-1, 0, 0, 1, 3), np.array([0, 4, 7, 12, 14, 19])
    spans = [np.arange(first[part], first[part + 1]) for part in range(5)]
    size, shared = 22, np.arange(19, 22)
    matrix = np.zeros((size, size))
    for part, parent in enumerate(parents):
        used = np.concatenate([spans[part], shared, *([spans[parent]] if parent >= 0 else [])])
        rows = rng.standard_normal((30, len(used)))
        matrix[np.ix_(used, used)] += rows.T @ rows
    right = rng.standard_normal(size)
    lower = np.tril(matrix) + np.triu(rng.standard_normal((size, size)), 1)
    solved = TreeSolution(parents, first).solve(lower, right)
    np.testing.assert_allclose(solved, np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        TreeSolution(parents, first).solve(-np.eye(size), right)
