# SPDX-License-Identifier: Apache-2.0
"""The fast search gives what the plain one gives."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import plain_search
from flowing_puppet_ros.body.fit.initialisation import sample_bodies
from flowing_puppet_ros.body.search import energy, levenberg
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles
from flowing_puppet_ros.body.search.part_points import PartPoints, build_part_points
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.schedule import four_stages
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.inference import diverse
from flowing_puppet_ros.model.sp import StitchedPuppet

PARTICLES, ITERATIONS = 6, 4


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


@pytest.fixture(scope="module")
def points(model: StitchedPuppet) -> tuple[PartPoints, ...]:
    return build_part_points(model)


@pytest.fixture(scope="module")
def grid(model: StitchedPuppet) -> CloudGrid:
    rng = np.random.default_rng(1)
    cloud, normals = sample_surface(model.vertices(model.sample(rng)), model.faces, rng, 3000)
    return CloudGrid.build(cloud + 0.003 * rng.standard_normal(cloud.shape), normals)


@pytest.fixture
def start(model: StitchedPuppet, grid: CloudGrid) -> list[Particles]:
    bodies = sample_bodies(model, grid.points.mean(axis=0), PARTICLES, np.random.default_rng(2))
    return states_to_particles(model, bodies)


def _targets(model: StitchedPuppet) -> JointTargets:
    rng = np.random.default_rng(3)
    count = len(model.joint_names)
    return JointTargets(rng.standard_normal((count, 3)), rng.random(count) * (rng.random(count) < 0.5))


def test_closest_points_of_tree_and_grid(grid: CloudGrid) -> None:
    asked = grid.points[::7] + 0.01
    exact = plain_search.PlainCloud.of_tree(grid.points, grid.normals).nearest(asked)
    np.testing.assert_array_equal(exact, cKDTree(grid.points).query(asked)[1])
    cells = plain_search.PlainCloud.of_grid(grid).nearest(asked)
    exact_distance = np.linalg.norm(asked - grid.points[exact], axis=1)
    assert (np.linalg.norm(asked - grid.points[cells], axis=1) >= exact_distance - 1e-12).all()


def test_moves_are_the_same(
    model: StitchedPuppet, points: tuple[PartPoints, ...], grid: CloudGrid, start: list[Particles]
) -> None:
    targets, cloud = _targets(model), plain_search.PlainCloud.of_grid(grid)
    for part in (0, 1, 4, 15):
        fast = levenberg.levenberg_marquardt(points[part], start[part], grid, targets, 3, 60)
        slow = plain_search.improve(points[part], start[part], cloud, targets, 3, 60)
        assert np.abs(fast.center - start[part].center).max() > 0.01
        for name in ("center", "rotation", "pose"):
            np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), atol=1e-6, err_msg=name)


def test_costs_are_the_same(
    model: StitchedPuppet, points: tuple[PartPoints, ...], grid: CloudGrid, start: list[Particles]
) -> None:
    targets = _targets(model)
    fast = [ScoredParticles.score(p, group, grid, targets) for p, group in zip(points, start, strict=True)]
    cloud = plain_search.PlainCloud.of_grid(grid)
    for part, group in enumerate(fast):
        slow = ScoredParticles.score(points[part], start[part], cloud, targets)
        np.testing.assert_allclose(group.distance, slow.distance, rtol=1e-9)
        np.testing.assert_array_equal(group.mismatch, slow.mismatch)
    for edge, (a, b) in enumerate(model.tree.edges):
        weight = model.interfaces[edge].weight
        centers = fast[a].particles.center, fast[b].particles.center
        quick = energy.stitching_costs(weight, fast[a].interfaces[edge], fast[b].interfaces[edge], centers, 4.0)
        np.testing.assert_allclose(quick, plain_search.stitching_costs(weight, fast[a], fast[b], edge, 4.0), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_selections_are_the_same(seed: int) -> None:
    foundation = np.random.default_rng(seed).exponential(0.1, (40, 24))
    fast = diverse.select_diverse(foundation, 12, 5, 0.1)
    np.testing.assert_array_equal(fast, plain_search.select_diverse(foundation, 12, 5, 0.1))


def test_searches_find_the_same_body(
    model: StitchedPuppet, points: tuple[PartPoints, ...], grid: CloudGrid, start: list[Particles]
) -> None:
    weights = SearchWeights(lm_steps=1, lm_points=30)
    found = []
    for search, cloud in (
        (BodyParticleSearch, grid),
        (plain_search.PlainSearch, plain_search.PlainCloud.of_grid(grid)),
    ):
        stages, rng = four_stages(model.tree), np.random.default_rng(4)
        made = search(model, points, weights)
        found.append(made.optimise(start, cloud, JointTargets.none(model), stages, ITERATIONS, rng))  # type: ignore[arg-type]
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-6)
    np.testing.assert_allclose(found[0].state.center, found[1].state.center, atol=1e-6)
    np.testing.assert_allclose(found[0].state.rotation, found[1].state.rotation, atol=1e-6)
