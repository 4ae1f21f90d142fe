# SPDX-License-Identifier: Apache-2.0
"""Particle swarm optimisation within bounds (Kennedy and Eberhart 1995; Eqs. 36 and 37).

It knows nothing of what it searches: particles are vectors, the energy is a function of many of them, and a proposal is
an optional move that the data suggest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array

type Energy = Callable[[Array], Array]
type Proposal = Callable[[Array, np.random.Generator], Array]

INITIAL_VELOCITY = 0.1
"""Standard deviation of the first velocities, as a share of the range between the bounds."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Bounds `low` and `high` (D,), and the share `inertia` (D,) of its velocity that is kept (w of Eq. 37)."""

    low: Array
    high: Array
    inertia: Array

    def clip(self, particles: Array) -> Array:
        """Clip `particles` (P, D) to the bounds."""
        return np.clip(particles, self.low, self.high)


@dataclass(slots=True, eq=False)
class Swarm:
    """P particles: positions (P, D), energies (P,), and the best position of each so far with its energy."""

    particles: Array
    energy: Array
    best: Array
    best_energy: Array

    @classmethod
    def of(cls, particles: Array, energy: Array) -> Swarm:
        """Start a search at `particles` (P, D) of known `energy` (P,)."""
        return cls(particles.copy(), energy.copy(), particles.copy(), energy.copy())

    def update(self, particles: Array, energy: Array) -> None:
        """Move to new positions; each particle remembers its best."""
        self.particles, self.energy = particles, energy
        better = energy < self.best_energy
        self.best[better], self.best_energy[better] = particles[better], energy[better]


def search(
    swarm: Swarm,
    energy: Energy,
    bounds: Bounds,
    iterations: int,
    rng: np.random.Generator,
    free: Array | None = None,
    proposal: Proposal | None = None,
    proposal_probability: float = 0.5,
) -> None:
    """Move a swarm towards each particle's best position and the best of all, within bounds (Eqs. 36 and 37).

    Args:
        swarm: the particles, which are moved; all energies must be finite or infinite, none NaN.
        energy: energies (P,) of particles (P, D); lower is better.
        bounds: bounds and inertia. A value that would pass its bound stops there, and its velocity is reversed.
        iterations: number of steps.
        rng: source of all draws.
        free: (D,) which values may change; all if not given.
        proposal: new particles for those (K, D) that it is given. A particle takes one with `proposal_probability`
            instead of following its velocity, and keeps that velocity.
        proposal_probability: in [0, 1].
    """
    count, size = swarm.particles.shape
    open_values = np.ones(size, dtype=bool) if free is None else free
    velocity = INITIAL_VELOCITY * (bounds.high - bounds.low) * rng.standard_normal((count, size))
    for _ in range(iterations):
        to_own, to_all = rng.random((2, count, size))
        leader = swarm.best[swarm.best_energy.argmin()]
        velocity = (
            bounds.inertia * velocity + to_own * (swarm.best - swarm.particles) + to_all * (leader - swarm.particles)
        )
        moved = swarm.particles + np.where(open_values, velocity, 0.0)
        stopped = bounds.clip(moved)
        velocity = np.where(moved == stopped, velocity, -velocity)
        moved = np.where(open_values, stopped, swarm.particles)
        if proposal is not None:
            proposing = rng.random(count) < proposal_probability
            if proposing.any():
                proposed = bounds.clip(proposal(swarm.particles[proposing], rng))
                moved[proposing] = np.where(open_values, proposed, swarm.particles[proposing])
        swarm.update(moved, energy(moved))


def resample(swarm: Swarm, temperature: float, rng: np.random.Generator) -> Swarm:
    """Draw as many particles from the posterior whose negative logarithm is the energy divided by `temperature`.

    Systematic resampling of the best positions: one random number, and every particle as often as its weight says, give
    or take one.
    """
    lowest = swarm.best_energy.min()
    weight = np.exp((lowest - swarm.best_energy) / temperature) if np.isfinite(lowest) else np.ones(len(swarm.energy))
    ends = np.cumsum(weight) / weight.sum()
    count = len(weight)
    chosen = np.searchsorted(ends, (np.arange(count) + rng.random()) / count).clip(max=count - 1)
    return Swarm.of(swarm.best[chosen], swarm.best_energy[chosen])
