# SPDX-License-Identifier: Apache-2.0
"""Settings of the thesis's loop and its energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class LoopSettings(Settings):
    """How long the particles are searched for; the thesis has P = 40, M = 5, R = 8 and three seeds."""

    particles: int = setting(40, "particles per image, P", low=2, high=1000)
    max_propagated: int = setting(5, "best particles propagated to the neighbouring images, M", low=0, high=100)
    rounds: int = setting(8, "rounds of search and propagation, R", low=1, high=100)
    restarts: int = setting(3, "independent runs, of which the one of minimum energy is taken", low=1, high=100)
    iterations: int = setting(3, "steps of the swarm in each stage of a round", low=1, high=1000)
    jump_probability: float = setting(
        0.5, "probability that a particle draws a wrist instead of moving", low=0.0, high=1.0
    )
    temperature: float = setting(
        2.0, "energy difference at which a particle is drawn 1/e times as often", low=0.01, high=1e3
    )
    seed: int = setting(0, "seed of all random draws", low=0, high=1_000_000)


@dataclass(frozen=True, slots=True)
class EnergySettings(Settings):
    """Weights of the terms of Eq. 35, and how far a puppet is propagated for its evidence in neighbouring images.

    The weights come from `flowing-puppet learn flowing`, see weights/flowing_weights.md; the detector's is set by hand.
    """

    prior_weight: float = setting(0.15, "weight of the body model's prior", low=0.0, high=100.0)
    contour_weight: float = setting(1.0, "weight of the contours", low=0.0, high=100.0)
    colour_weight: float = setting(0.6, "weight of skin and torso colour", low=0.0, high=100.0)
    hand_weight: float = setting(1.0, "weight of the hand detectors", low=0.0, high=100.0)
    score_weight: float = setting(3.0, "weight of the detector's score of each arm joint", low=0.0, high=100.0)
    forward_flow: bool = setting(True, "use the evidence at the puppet propagated forward by the flow")
    backward_flow: bool = setting(True, "use the evidence at the puppet propagated backward by the flow")
    flow_steps: int = setting(1, "images by which the flow propagates a puppet for its evidence", low=1, high=10)

    @property
    def weights(self) -> F64:
        """Weights (4,) of TERMS."""
        return np.array([self.contour_weight, self.colour_weight, self.hand_weight, self.score_weight])
