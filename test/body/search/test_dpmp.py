# SPDX-License-Identifier: Apache-2.0
"""Searches of some of the parts, their modes, and limbs attached to bodies."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.search.body_energy import BodyEnergy
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles, stitching_costs
from flowing_puppet_ros.body.search.limb_search import LimbSearch, limb_groups
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.body.search.schedule import limb_stages
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


@pytest.fixture(scope="module")
def search(model: StitchedPuppet, points: tuple[PartPoints, ...]) -> BodyParticleSearch:
    return BodyParticleSearch(model, points, SearchWeights(lm_steps=2))


@pytest.fixture(scope="module")
def body(model: StitchedPuppet) -> BodyState:
    return model.sample(np.random.default_rng(1), pose_scale=0.3)


@pytest.fixture(scope="module")
def grid(model: StitchedPuppet, body: BodyState) -> CloudGrid:
    vertices = model.vertices(body)
    return CloudGrid.build(vertices, vertex_normals(vertices, model.faces))


def relative(model: StitchedPuppet, group: list[Particles], part: int) -> np.ndarray:
    above = group[model.tree.parents[part]].rotation
    return np.asarray(np.swapaxes(above, 1, 2) @ group[part].rotation)


def test_parts_with_one_particle_stay_and_every_mode_holds_its_own_particle(
    model: StitchedPuppet, points: tuple[PartPoints, ...], search: BodyParticleSearch, body: BodyState, grid: CloudGrid
) -> None:
    start, leg = states_to_particles(model, [body]), limb_groups(model.tree)[0]
    proposer, rng = Proposer(model, points), np.random.default_rng(2)
    for part in leg:
        above = start[model.tree.parents[part]]
        parents = above.take(np.arange(12) % len(above))
        start[part] = Particles.join([start[part], proposer.attach_to_parent(part, parents, start[part].shape[0], rng)])
    none, stages = JointTargets.none(model), limb_stages(model.tree)
    found = search.optimise(start, grid, none, stages, 2, rng, max_particles=5)
    others = np.setdiff1d(np.arange(16), leg)
    np.testing.assert_array_equal(found.state.center[others], body.center[others])
    np.testing.assert_array_equal(found.state.pose[others], body.pose[others])
    assert [len(group.particles) for group in found.scored] == [5 if part in leg else 1 for part in range(16)]
    foot = leg[-1]
    modes = search.extract_modes(found, foot)
    np.testing.assert_array_equal([mode.center[foot] for mode in modes], found.scored[foot].particles.center)
    assert any(np.array_equal(mode.center, found.state.center) for mode in modes)
    # No body of other particles above the foot has less energy than the mode with that foot.
    energy = BodyEnergy(model, points, SearchWeights().stitch, SearchWeights().mismatch)
    for mode in modes[:2]:
        lowest = energy.measure(mode, grid)
        for thigh in range(5):
            other = mode.center.copy(), mode.rotation.copy(), mode.pose.copy(), mode.shape.copy()
            for values, own in zip(other, astuple(found.scored[leg[0]].particles, thigh), strict=True):
                values[leg[0]][: len(own)] = own
            assert energy.measure(BodyState(*other), grid) >= lowest - 1e-9


def test_the_energy_of_a_body_is_the_sum_over_its_parts_and_edges(
    model: StitchedPuppet, points: tuple[PartPoints, ...], body: BodyState, grid: CloudGrid
) -> None:
    center = body.center.copy()
    center[3], center[5] = center[model.tree.parents[3]] + 0.01, center[5] + 0.1
    state = BodyState(center, body.rotation, body.pose, body.shape + 0.3)
    scored = [
        ScoredParticles.score(own, group, grid, JointTargets.none(model))
        for own, group in zip(points, states_to_particles(model, [state]), strict=True)
    ]
    expected = sum(float(part.distance[0] + 0.3 * part.mismatch[0]) for part in scored)
    for edge, (parent, child) in enumerate(model.tree.edges):
        a, b = scored[parent], scored[child]
        centers = a.particles.center, b.particles.center
        weight = model.interfaces[edge].weight
        expected += 0.5 * float(stitching_costs(weight, a.interfaces[edge], b.interfaces[edge], centers, 4.0)[0, 0])
    assert BodyEnergy(model, points, 4.0, 0.3).measure(state, grid) == pytest.approx(expected)
    assert expected > 0.5 + BodyEnergy(model, points, 4.0, 0.3).measure(body, grid), "two centres in one place cost 1/2"


def astuple(particles: Particles, index: int) -> tuple[np.ndarray, ...]:
    return particles.center[index], particles.rotation[index], particles.pose[index], particles.shape[index]


def test_attached_parts_rotate_within_their_limits_about_their_interfaces(
    model: StitchedPuppet, points: tuple[PartPoints, ...], body: BodyState
) -> None:
    group, part = states_to_particles(model, [body] * 200), model.tree.index("left_lower_arm")
    above = model.tree.parents[part]
    group[part] = Proposer(model, points).attach_to_parent(
        part, group[above], body.shape[part], np.random.default_rng(0)
    )
    turns = so3.log(relative(model, group, part))
    low, high = model.limit_low[part - 1], model.limit_high[part - 1]
    inside = (turns >= low - 1e-9) & (turns <= high + 1e-9)
    # A rotation by more than half a turn has a shorter vector the other way round.
    assert inside[np.linalg.norm(turns, axis=1) < 3.1].all(axis=1).mean() > 0.95
    assert np.ptp(turns, axis=0).max() > 0.7 * (high - low).max()
    weight = model.interfaces[part - 1].weight
    ends = [
        np.average(points[p].interfaces[part - 1].to_world(group[p]), axis=1, weights=weight) for p in (above, part)
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_limbs_at_the_mean_have_the_mean_of_their_gaussians(
    model: StitchedPuppet, points: tuple[PartPoints, ...], search: BodyParticleSearch, body: BodyState
) -> None:
    arm = limb_groups(model.tree)[3]
    at_mean = LimbSearch(model, search, Proposer(model, points)).pose_limb_at_mean(body, arm)
    group, meshes = states_to_particles(model, [at_mean]), model.parts(at_mean)
    for part in arm:
        above, mean, interface = model.tree.parents[part], model.pairwise[part - 1].mean, model.interfaces[part - 1]
        np.testing.assert_allclose(so3.log(relative(model, group, part))[0], mean[:3], atol=1e-9)
        np.testing.assert_allclose(group[part].pose[0], mean[3 + model.pose_count(above) :])
        ends = meshes[above][interface.parent_index], meshes[part][interface.child_index]
        np.testing.assert_allclose(ends[0].mean(axis=0), ends[1].mean(axis=0), atol=1e-9)
    others = np.setdiff1d(np.arange(16), arm)
    np.testing.assert_array_equal(at_mean.center[others], body.center[others])
    assert not np.array_equal(at_mean.center[arm[1]], body.center[arm[1]])
