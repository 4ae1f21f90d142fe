# SPDX-License-Identifier: Apache-2.0
"""The choice of depths against all combinations."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from flowing_puppet_ros.fusion.limb_depths import (
    CHAINS,
    SCALE_DEVIATION,
    SCALES,
    DepthChoices,
    choose_depths,
    measure_bone_cost,
    measure_limb_cost,
)
from flowing_puppet_ros.model.sp import StitchedPuppet

LIMBS = [[f"{side}_{name}" for name in chain] for side in ("left", "right") for chain in CHAINS]


def _make_choices(place: np.ndarray, rng: np.random.Generator) -> DepthChoices:
    """Return two choices along z around a place."""
    depth = place[2] + 0.15 * rng.standard_normal(2)
    points = np.stack([np.array([place[0], place[1], z]) for z in depth])
    return DepthChoices(points, depth, rng.random(2), np.array([True, False]))


def _find_best(model: StitchedPuppet, choices: dict[int, DepthChoices]) -> dict[int, int]:
    """Return the cheapest of all combinations."""
    template = model.joints(model.vertices(model.rest_state()))
    row = model.joint_names.index
    pairs = []
    for limb in LIMBS:
        present = [row(name) for name in limb if row(name) in choices]
        pairs += [(a, b, True) for a, b in pairwise(present)]
    corners = [row(limb[0]) for limb in LIMBS if row(limb[0]) in choices]
    pairs += [(a, b, False) for k, a in enumerate(corners) for b in corners[:k]]
    rows = list(choices)
    best: tuple[float, dict[int, int]] = (np.inf, {})
    for scale in SCALES:
        tables = {}
        for a, b, along in pairs:
            length = scale * float(np.linalg.norm(template[a] - template[b]))
            near, far = choices[a], choices[b]
            spread = np.hypot(near.spread[:, None], far.spread)
            bone = measure_bone_cost(near.points, far.points, length, spread)
            tables[a, b] = measure_limb_cost(near, far, length) if along else bone
        for taken in product((0, 1), repeat=len(rows)):
            picked = dict(zip(rows, taken, strict=True))
            cost = 0.5 * ((scale - 1) / SCALE_DEVIATION) ** 2
            cost += sum(choices[joint].cost[k] for joint, k in picked.items())
            cost += sum(table[picked[a], picked[b]] for (a, b), table in tables.items())
            if cost < best[0]:
                best = cost, picked
    return best[1]


@pytest.mark.parametrize("missing", [(), ("left_elbow",), ("right_shoulder", "left_hip", "left_knee")])
def test_the_cheapest_combination_is_chosen(model: StitchedPuppet, missing: tuple[str, ...]) -> None:
    rng = np.random.default_rng(len(missing))
    places = model.joints(model.vertices(model.rest_state())) + np.array([0.0, 0.0, 3.0])
    used = [name for limb in LIMBS for name in limb[:3] if name not in missing]
    choices = {
        model.joint_names.index(name): _make_choices(places[model.joint_names.index(name)], rng) for name in used
    }
    assert choose_depths(model, choices) == _find_best(model, choices)
    assert choose_depths(model, {}) == {}
