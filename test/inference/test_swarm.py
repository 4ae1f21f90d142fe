# SPDX-License-Identifier: Apache-2.0
"""The particle swarm finds minima within bounds, never leaves them, and repeats itself for one seed."""

import numpy as np

from flowing_puppet_ros.inference.swarm import Bounds, Swarm, resample, search

BOUNDS = Bounds(np.full(4, -5.0), np.full(4, 5.0), np.full(4, 0.6))
GOAL = np.array([1.0, -2.0, 3.0, 5.0])


def bowl(particles: np.ndarray) -> np.ndarray:
    """A bowl with ripples, with its minimum at the goal."""
    away = particles - GOAL
    return (away**2 + 1.0 - np.cos(4.0 * away)).sum(axis=1)


def start(seed: int = 0, count: int = 40) -> Swarm:
    particles = np.random.default_rng(seed).uniform(-5, 5, (count, 4))
    return Swarm.of(particles, bowl(particles))


def test_the_swarm_finds_the_minimum_at_a_bound_and_never_leaves_the_bounds() -> None:
    seen = []

    def energy(particles: np.ndarray) -> np.ndarray:
        seen.append(particles.copy())
        return bowl(particles)

    swarm = start()
    search(swarm, energy, BOUNDS, 80, np.random.default_rng(1))
    best = swarm.best[swarm.best_energy.argmin()]
    np.testing.assert_allclose(best, GOAL, atol=0.1)
    np.testing.assert_array_equal(swarm.best_energy, bowl(swarm.best))
    assert len(seen) == 80
    assert min(particles.min() for particles in seen) >= -5.0
    assert max(particles.max() for particles in seen) <= 5.0


def test_only_free_values_move() -> None:
    swarm = start()
    before = swarm.particles.copy()
    free = np.array([True, False, True, False])
    search(swarm, bowl, BOUNDS, 20, np.random.default_rng(1), free, proposal=lambda given, rng: given + 1.0)
    np.testing.assert_array_equal(swarm.particles[:, ~free], before[:, ~free])
    assert (swarm.particles[:, free] != before[:, free]).all(axis=1).mean() > 0.9


def test_proposals_replace_the_velocity_with_the_given_probability() -> None:
    jumped = []

    def proposal(given: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        jumped.append(len(given))
        return np.tile(GOAL, (len(given), 1))

    swarm = start(count=200)
    search(swarm, bowl, BOUNDS, 10, np.random.default_rng(1), proposal=proposal, proposal_probability=0.5)
    assert 850 < sum(jumped) < 1150
    assert (swarm.best_energy == 0.0).mean() > 0.9, "whoever jumped to the goal remembers it"


def test_same_seed_same_bits() -> None:
    ends = []
    for seed in (3, 3, 4):
        swarm = start()
        search(swarm, bowl, BOUNDS, 10, np.random.default_rng(seed))
        ends.append(swarm.particles.tobytes())
    assert ends[0] == ends[1] != ends[2]


def test_resampling_draws_by_the_posterior() -> None:
    particles = np.arange(1000.0)[:, None].repeat(4, axis=1)
    energy = np.where(np.arange(1000) < 100, 0.0, np.log(3.0))
    drawn = resample(Swarm.of(particles, energy), 1.0, np.random.default_rng(0))
    assert len(drawn.energy) == 1000
    assert abs((drawn.energy == 0.0).mean() - 0.25) < 0.01, "100 of weight 1, 900 of weight 1/3"
    cold = resample(Swarm.of(particles, energy), 0.01, np.random.default_rng(0))
    assert (cold.energy == 0.0).all()
    lost = resample(Swarm.of(particles, np.full(1000, np.inf)), 1.0, np.random.default_rng(0))
    assert len(np.unique(lost.particles)) == 1000
