# SPDX-License-Identifier: Apache-2.0
"""Particle swarm optimisation in a box (Kennedy and Eberhart 1995; thesis Eqs. 36 and 37).

It knows nothing of what it searches: particles are vectors, the energy is a function of many of them, and a jump, where
there is one, is a move that the data propose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import Array

type Energy = Callable[[Array], Array]
type Jump = Callable[[Array, np.random.Generator], Array]

FIRST_STEP = 0.1
"""Standard deviation of the first velocities, in shares of what the bounds allow."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Bounds `low` and `high` (D,), and the share `inertia` (D,) of its velocity that is kept (w of Eq. 37)."""

    low: Array
    high: Array
    inertia: Array

    def inside(self, particles: Array) -> Array:
        """The particles (P,D) with every value moved to the nearest bound."""
        return np.clip(particles, self.low, self.high)


@dataclass(slots=True, eq=False)
class Swarm:
    """P particles: where they are, (P,D), their energy there (P,), and the best place of each with its energy."""

    particles: Array
    energy: Array
    best: Array
    best_energy: Array

    @classmethod
    def of(cls, particles: Array, energy: Array) -> Swarm:
        """Particles (P,D) of known energies (P,) at the start of a search."""
        return cls(particles.copy(), energy.copy(), particles.copy(), energy.copy())

    def update(self, particles: Array, energy: Array) -> None:
        """Go to new places; each particle remembers its best."""
        self.particles, self.energy = particles, energy
        better = energy < self.best_energy
        self.best[better], self.best_energy[better] = particles[better], energy[better]


def search(
    swarm: Swarm,
    energy: Energy,
    box: Bounds,
    iterations: int,
    rng: np.random.Generator,
    free: Array | None = None,
    jump: Jump | None = None,
    jump_probability: float = 0.5,
) -> None:
    """Move a swarm through a box for some iterations, towards each particle's best place and the best of all.

    Args:
        swarm: the particles, which are moved; all energies must be finite or infinite, none NaN.
        energy: energies (P,) of particles (P,D); lower is better.
        box: bounds and inertia. A value that would leave the box stops at its bound and its velocity turns round.
        iterations: steps.
        rng: source of all draws.
        free: (D,) which values may change; all when not given.
        jump: new particles for those (K,D) that it is given; each particle jumps with `jump_probability` instead of
            following its velocity, and keeps that velocity.
        jump_probability: in [0, 1].
    """
    count, size = swarm.particles.shape
    open_values = np.ones(size, dtype=bool) if free is None else free
    velocity = FIRST_STEP * (box.high - box.low) * rng.standard_normal((count, size))
    for _ in range(iterations):
        to_own, to_all = rng.random((2, count, size))
        leader = swarm.best[swarm.best_energy.argmin()]
        velocity = (
            box.inertia * velocity + to_own * (swarm.best - swarm.particles) + to_all * (leader - swarm.particles)
        )
        moved = swarm.particles + np.where(open_values, velocity, 0.0)
        stopped = box.inside(moved)
        velocity = np.where(moved == stopped, velocity, -velocity)
        moved = np.where(open_values, stopped, swarm.particles)
        if jump is not None:
            jumps = rng.random(count) < jump_probability
            if jumps.any():
                proposed = box.inside(jump(swarm.particles[jumps], rng))
                moved[jumps] = np.where(open_values, proposed, swarm.particles[jumps])
        swarm.update(moved, energy(moved))


def resampled(swarm: Swarm, temperature: float, rng: np.random.Generator) -> Swarm:
    """As many particles, drawn by the posterior whose negative logarithm is the energy, over a temperature.

    Systematic resampling of the best places: the fewest draws, and every particle as often as its share says, give or
    take one.
    """
    least = swarm.best_energy.min()
    weight = np.exp((least - swarm.best_energy) / temperature) if np.isfinite(least) else np.ones(len(swarm.energy))
    ends = np.cumsum(weight) / weight.sum()
    count = len(weight)
    chosen = np.searchsorted(ends, (np.arange(count) + rng.random()) / count).clip(max=count - 1)
    return Swarm.of(swarm.best[chosen], swarm.best_energy[chosen])
