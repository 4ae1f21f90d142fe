# SPDX-License-Identifier: Apache-2.0
"""Potentials between particles against the density written out, and where proposals put their parts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from flowing_puppet_ros.image.pose.particle_search import place_elbows
from flowing_puppet_ros.image.pose.particles import (
    PairwiseGaussian,
    PartParticles,
    joint_rows,
    particles_from_puppets,
    world_points,
)
from flowing_puppet_ros.model.ds.joints import PART_JOINTS
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PairLayout

MODEL = DeformableStructures.load()
SPRING = 0.04
FRONT = np.array([1.0, 1.0])


def particles(rng: np.random.Generator, count: int) -> PartParticles:
    size = MODEL.shapes[0].basis.shape[2]
    return PartParticles(
        rng.uniform(0, 200, (count, 2)),
        rng.uniform(-3, 3, count),
        rng.uniform(80, 120, count),
        rng.standard_normal((count, size)),
    )


def edge(child: str, spring: float = SPRING) -> tuple[PairwiseGaussian, int, int, int]:
    part = MODEL.tree.index(child)
    parent = MODEL.tree.parents[part]
    hook = PART_JOINTS[MODEL.tree.names[parent]].index(PART_JOINTS[child][0])
    row = int(joint_rows(MODEL.shapes[parent])[hook])
    return (
        PairwiseGaussian(MODEL.pairwise[part - 1], MODEL.shapes[parent], MODEL.shapes[part], row, spring),
        parent,
        part,
        row,
    )


@pytest.mark.parametrize("child", ["head", "left_upper_arm", "right_lower_arm"])
def test_edge_costs_are_the_loosened_conditional_density(child: str) -> None:
    rng = np.random.default_rng(0)
    link, parent, part, row = edge(child)
    above, below = particles(rng, 3), particles(rng, 4)
    costs = link.costs(above, below, 0.1)
    size = above.shape.shape[1]
    layout = PairLayout(size)
    for i in range(3):
        law = MODEL.pairwise[part - 1].condition(
            layout.child + layout.angle + layout.gap, layout.parent, above.shape[i]
        )
        covariance = law.covariance + np.diag([0.0] * (size + 2) + [SPRING**2] * 2)
        hang = world_points(MODEL.shapes[parent], above.take(np.array([i])))[0, row]
        for j in range(4):
            top = world_points(MODEL.shapes[part], below.take(np.array([j])))[0, joint_rows(MODEL.shapes[part])[0]]
            turn = below.angle[j] - above.angle[i]
            x, y = (top - hang) / above.scale[i]
            c, s = np.cos(above.angle[i]), np.sin(above.angle[i])
            gap = np.array([c * x + s * y, c * y - s * x])
            variables = np.concatenate([below.shape[j], [np.sin(turn), np.cos(turn)], gap])
            expected = -multivariate_normal(law.mean, covariance).logpdf(variables) - 0.5 * (size + 4) * np.log(
                2 * np.pi
            )
            expected += 0.5 * (np.log(below.scale[j] / above.scale[i]) / 0.1) ** 2
            assert costs[i, j] == pytest.approx(expected, rel=0.03)


def test_children_and_parents_hang_together() -> None:
    rng = np.random.default_rng(1)
    link, parent, part, row = edge("left_upper_arm")
    above = particles(rng, 300)
    children = link.propose_child(above, rng)
    hang = world_points(MODEL.shapes[parent], above)[:, row]
    top = world_points(MODEL.shapes[part], children)[:, joint_rows(MODEL.shapes[part])[0]]
    assert np.median(np.linalg.norm(top - hang, axis=1) / above.scale) < 0.02
    parents = link.propose_parent(children, rng)
    hang = world_points(MODEL.shapes[parent], parents)[:, row]
    assert np.median(np.linalg.norm(top - hang, axis=1) / above.scale) < 0.02
    own = np.diag(link.costs(above, children, 0.1))
    others = link.costs(above, children, 0.1)[~np.eye(300, dtype=bool)]
    assert np.median(own) < np.median(others) - 20


def test_a_part_between_two_places_reaches_both() -> None:
    rng = np.random.default_rng(2)
    link, parent, part, row = edge("right_lower_arm")
    above = particles(rng, 200)
    near = world_points(MODEL.shapes[parent], above)[:, row]
    direction = rng.uniform(-3, 3, 200)
    length = rng.uniform(0.15, 0.26, 200) * above.scale
    far = near + length[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    between = link.propose_between(above, far, rng)
    ends = world_points(MODEL.shapes[part], between, joint_rows(MODEL.shapes[part]))
    miss = np.linalg.norm(ends - np.stack([near, far], axis=1), axis=2) / above.scale[:, None]
    assert np.median(miss) < 0.01 and np.percentile(miss, 90) < 0.05


def test_puppets_become_particles_at_their_joints() -> None:
    rng = np.random.default_rng(3)
    puppet = MODEL.puppet_from_joints(MODEL.sample(rng).joints * 110 + 150, 110.0)
    groups = particles_from_puppets([puppet, puppet], MODEL.bone, FRONT)
    for part, group in enumerate(groups):
        ends = world_points(MODEL.shapes[part], group, joint_rows(MODEL.shapes[part])[:2])
        expected = puppet.joints[MODEL.bone[part]]
        np.testing.assert_allclose(ends[0], expected, atol=0.03 * 110)
    # From behind, x is negated and so are the particles'.
    behind = MODEL.puppet_from_joints(puppet.joints * [-1, 1], 110.0, "back")
    mirrored = particles_from_puppets([behind], MODEL.bone, np.array([-1.0, 1.0]))
    np.testing.assert_allclose(mirrored[2].center[0], groups[2].center[0])
    np.testing.assert_allclose(mirrored[2].shape[0], groups[2].shape[0], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.floats(-200, 200), st.floats(-200, 200), st.floats(20, 60), st.floats(20, 60), st.integers(0, 99))
def test_elbows_keep_arms_no_longer_than_they_are(x: float, y: float, upper: float, lower: float, seed: int) -> None:
    shoulder, wrist = np.zeros((8, 2)), np.tile([x, y], (8, 1))
    elbow = place_elbows(shoulder, wrist, np.full(8, upper), np.full(8, lower), np.random.default_rng(seed))
    first = np.hypot(*elbow.T)
    second = np.hypot(*(wrist - elbow).T)
    reach = np.hypot(x, y)
    if reach <= 0.5 * (upper + lower):
        assert (first <= upper + 1e-6).all()
    if reach >= upper + lower:
        np.testing.assert_allclose(first + second, reach, rtol=1e-6)
