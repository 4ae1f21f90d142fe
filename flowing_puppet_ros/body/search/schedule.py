# SPDX-License-Identifier: Apache-2.0
"""Stages of the search, with weights that bring in the distal parts late (thesis, "Optimization")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.search.proposals import WalkNoise
from flowing_puppet_ros.model.tree import PartTree

# Random walks far from and near to the solution.
WIDE = WalkNoise(center=0.04, rotation=0.25, pose=0.5, shape=0.3)
NARROW = WalkNoise(center=0.01, rotation=0.06, pose=0.2, shape=0.15)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """One stage of a search.

    Attributes:
        until: fraction of the iterations at which the stage ends.
        stitch: (E,) alpha of each edge.
        data: (N,) beta of each part.
        noise: of the random walks.
        greedy: whether all new particles are random walks from the best body.
    """

    until: float
    stitch: np.ndarray
    data: np.ndarray
    noise: WalkNoise
    greedy: bool


def four_stages(tree: PartTree) -> tuple[Stage, ...]:
    """Return the thesis's schedule for an unknown pose; its stages end at 35, 60, 85 and 100 % of the iterations.

    The "lower limbs" of its first stage are taken to be the lower legs; with the lower arms the fits are much the same.
    """
    ends = np.array([name.endswith(("_hand", "_foot")) for name in tree.names])
    distal = ends | np.array([name.endswith("_lower_leg") for name in tree.names])
    hips = np.array([name.endswith("_upper_leg") for name in tree.names])
    early = np.where(hips, 0.5, 0.25)[1:]
    half = np.full(len(tree) - 1, 0.5)
    ones = np.ones(len(tree))
    return (
        Stage(0.35, np.where(ends[1:], 0.001, early), np.where(distal, 0.001, 1.0), WIDE, False),
        Stage(0.60, early, np.where(ends, 0.1, 1.0), WIDE, False),
        Stage(0.85, half, ones, NARROW, False),
        Stage(1.00, half, ones, NARROW, True),
    )


def local_stages(tree: PartTree) -> tuple[Stage, ...]:
    """Return a schedule for a pose that is roughly known: all parts count from the start."""
    half = np.full(len(tree) - 1, 0.5)
    ones = np.ones(len(tree))
    middle = WalkNoise(center=0.02, rotation=0.12, pose=0.4, shape=0.2)
    return (Stage(0.7, half, ones, middle, False), Stage(1.0, half, ones, NARROW, True))


def limb_stages(tree: PartTree) -> tuple[Stage, ...]:
    """Return a schedule for limbs of unknown pose on a body that stays; it ends with many modes."""
    half = np.full(len(tree) - 1, 0.5)
    ones = np.ones(len(tree))
    return (Stage(0.6, half, ones, WIDE, False), Stage(1.0, half, ones, NARROW, False))
