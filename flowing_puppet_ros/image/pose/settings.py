# SPDX-License-Identifier: Apache-2.0
"""Settings of pose estimation in single images."""

from __future__ import annotations

from dataclasses import dataclass

from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class PoseSettings(Settings):
    """How the particles of the 2D puppet are proposed, weighted and selected."""

    particles: int = setting(48, "particles per part kept in each iteration", low=4, high=1000)
    iterations: int = setting(6, "iterations of proposing and selecting", low=0, high=1000)
    refinements: int = setting(4, "further iterations that refine the best pose alone", low=0, high=1000)
    modes: int = setting(16, "detector poses from which particles start", low=1, high=200)
    solutions: int = setting(10, "number of diverse solutions returned, including the best", low=1, high=100)
    others: float = setting(0.25, "minimum probability of people other than the most probable one", low=0.0, high=1.0)
    seed: int = setting(
        0, "seed of all random draws; also picks the letters that ids begin with", low=0, high=1_000_000
    )
    likelihood: bool = setting(True, "use the image evidence; off: the body model alone")
    shape: bool = setting(True, "vary the shapes of the parts; off: the mean shape")
    diverse: bool = setting(True, "keep diverse particles (D-PMP); off: the best ones (PMP)")
    evidence_weight: float = setting(5.0, "weight of contour and colour", low=0.0, high=100.0)
    detector_weight: float = setting(4.0, "weight of the detector's score of the joints", low=0.0, high=100.0)
    spring: float = setting(
        0.04, "standard deviation of the distance between the parts at a joint", unit="m", low=0.001, high=0.5
    )
    scale_deviation: float = setting(
        0.1, "relative standard deviation of the scales of neighbouring parts", low=0.001, high=1.0
    )
    temperature: float = setting(2.0, "cost difference that matters in the diverse selection", low=0.01, high=100.0)
    max_side: int = setting(1280, "longest image side at which a pose is searched", unit="px", low=64, high=8192)
