# SPDX-License-Identifier: Apache-2.0
"""What a candidate looks like, against things whose sizes are known."""

import numpy as np
import pytest

from flowing_puppet_ros.body.segmentation.candidates import Candidate, SceneHeights
from flowing_puppet_ros.body.upright.candidate_shape import SHAPE_NAMES, describe_candidates
from flowing_puppet_ros.body.upright.verification import EVIDENCE_NAMES

HEIGHTS = np.arange(0.15, 1.75, 0.02)


def describe(thing: np.ndarray) -> dict[str, float]:
    """Describe points (N, 3) m on a level floor, seen from the origin."""
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(1, 9, 120), np.linspace(-4, 4, 120)))
    scene = SceneHeights.of(np.concatenate([thing, np.column_stack([a, b, np.zeros(len(a))])]))
    candidate = Candidate.of(scene, np.arange(len(thing)))
    return dict(zip(SHAPE_NAMES, describe_candidates([candidate], scene, np.array([0, 0, 1.0]))[0], strict=True))


def stand(x: float, y: float, radius: float, heights: np.ndarray) -> np.ndarray:
    """Return the points of the near half of a column."""
    angle, z = (grid.ravel() for grid in np.meshgrid(np.linspace(0.5 * np.pi, 1.5 * np.pi, 30), heights))
    return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z])


def test_a_post_is_round_and_its_edges_are_parallel_lines() -> None:
    post = describe(stand(5.0, 0.0, 0.15, HEIGHTS))
    assert post["radius_1"] == pytest.approx(0.15, abs=1e-3) and post["unround_1"] == pytest.approx(0, abs=1e-3)
    widths = [post[f"width_below_{k}"] for k in range(6)]
    np.testing.assert_allclose(widths, 0.3, atol=0.01)
    assert post["left_steps"] < 1e-6 and post["right_steps"] < 1e-6 and post["sway_across"] < 1e-6


def test_legs_part_and_a_trunk_that_leans_moves_from_band_to_band() -> None:
    legs = [stand(5.0, side, 0.07, HEIGHTS[HEIGHTS < 0.8]) for side in (-0.15, 0.15)]
    trunk = stand(5.0, 0.0, 0.2, HEIGHTS[HEIGHTS >= 0.8])
    person = describe(np.concatenate([*legs, trunk]))
    assert person["leg_gap"] == pytest.approx(0.3 - 2 * 0.07, abs=0.01)
    assert person["leg_shift"] == pytest.approx(0, abs=1e-3)
    trunk[:, 1] += 0.3 * (trunk[:, 2] - 0.8)
    leaning = describe(np.concatenate([*legs, trunk]))
    assert leaning["sway_across"] > person["sway_across"] + 0.03 and leaning["parallel"] > 0.5


def test_few_points_tell_nothing_of_what_needs_more() -> None:
    few = describe(stand(5.0, 0.0, 0.1, np.array([1.0, 1.6]))[::15])
    assert few["unround_0"] == few["leg_gap"] == few["left_steps"] == -0.1
    assert all(np.isfinite(list(few.values()))) and len(set(EVIDENCE_NAMES)) == len(EVIDENCE_NAMES)
