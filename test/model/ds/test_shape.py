# SPDX-License-Identifier: Apache-2.0
"""Belief propagation of shape given joints against conditioning of the dense joint Gaussian."""

import numpy as np
import pytest

from flowing_puppet_ros.model.ds.shape import PairLayout, PartShape, rotate, shape_posterior
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.tree import PartTree

SIZE = 2
TREE = PartTree(("root", "a", "b", "a's child"), (-1, 0, 0, 1))
NOISE = 0.3


def random_gaussian(rng: np.random.Generator, dimension: int) -> Gaussian:
    factor = rng.standard_normal((dimension, dimension))
    return Gaussian(rng.standard_normal(dimension), factor @ factor.T + 0.1 * np.eye(dimension))


def dense_joint(shapes: list[PartShape], pairwise: list[Gaussian]) -> Gaussian:
    """p(all z, all y, all (sin, cos, t)) from ancestral sampling: x = mean + map @ independent noise."""
    layout = PairLayout(SIZE)
    edge = SIZE + 3
    sources = SIZE + edge * len(pairwise) + sum(2 * shape.joint_count for shape in shapes)
    rows: dict[int, np.ndarray] = {0: np.hstack([np.eye(SIZE), np.zeros((SIZE, sources - SIZE))])}
    means: dict[int, np.ndarray] = {0: np.zeros(SIZE)}
    pair_rows, pair_means = [], []
    for e, (parent, child) in enumerate(TREE.edges):
        kept = layout.child + layout.angle + layout.child_length
        at_zero = pairwise[e].condition(kept, layout.parent, np.zeros(SIZE))
        unit = [pairwise[e].condition(kept, layout.parent, axis).mean - at_zero.mean for axis in np.eye(SIZE)]
        block = np.stack(unit, axis=1) @ rows[parent]
        start = SIZE + edge * e
        block[:, start : start + edge] += np.linalg.cholesky(at_zero.covariance)
        mean = at_zero.mean + np.stack(unit, axis=1) @ means[parent]
        rows[child], means[child] = block[:SIZE], mean[:SIZE]
        pair_rows.append(block[SIZE:])
        pair_means.append(mean[SIZE:])
    joint_rows, joint_means = [], []
    start = SIZE + edge * len(pairwise)
    for part, shape in enumerate(shapes):
        count = 2 * shape.joint_count
        basis = shape.basis[-shape.joint_count :].reshape(count, SIZE)
        block = basis @ rows[part]
        block[:, start : start + count] += NOISE * np.eye(count)
        joint_rows.append(block)
        joint_means.append(shape.mean[-shape.joint_count :].ravel() + basis @ means[part])
        start += count
    everything = np.vstack([*(rows[part] for part in range(len(TREE))), *joint_rows, *pair_rows])
    mean = np.concatenate([*(means[part] for part in range(len(TREE))), *joint_means, *pair_means])
    return Gaussian(mean, everything @ everything.T)


def test_belief_propagation_equals_conditioning_of_the_joint_gaussian() -> None:
    rng = np.random.default_rng(3)
    counts = (3, 2, 2, 2)
    shapes = [PartShape(rng.standard_normal((5 + m, 2)), rng.standard_normal((5 + m, 2, SIZE)), m) for m in counts]
    pairwise = [random_gaussian(rng, 2 * SIZE + 6) for _ in TREE.edges]
    gain, offset = shape_posterior(TREE, shapes, pairwise, noise=NOISE)
    joint = dense_joint(shapes, pairwise)
    unknown = np.arange(SIZE * len(TREE))
    observed = np.arange(len(unknown), len(joint))
    assert gain.shape == (len(unknown), len(observed))
    for _ in range(3):
        observation = rng.standard_normal(len(observed))
        expected = joint.condition(unknown, observed, observation).mean
        np.testing.assert_allclose(gain @ observation + offset, expected, atol=1e-8)


def test_layout_covers_every_variable_once() -> None:
    layout = PairLayout(10)
    order = [*layout.child, *layout.angle, *layout.gap, *layout.child_length, *layout.parent, *layout.parent_length]
    assert order == list(range(26))


def test_rotation_turns_image_x_towards_image_y() -> None:
    np.testing.assert_allclose(rotate(np.array([[1.0, 0.0], [0.0, 1.0]]), 1.0, 0.0), [[0, 1], [-1, 0]])


def test_part_points_are_contour_then_joints() -> None:
    shape = PartShape(np.arange(8.0).reshape(4, 2), np.ones((4, 2, 1)), 2)
    np.testing.assert_array_equal(shape.contour(np.array([1.0])), [[1, 2], [3, 4]])
    np.testing.assert_array_equal(shape.joints(np.array([-1.0])), [[3, 4], [5, 6]])
    assert shape.points(np.zeros(1)) == pytest.approx(shape.mean)
