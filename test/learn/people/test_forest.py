# SPDX-License-Identifier: Apache-2.0
"""What is learned from examples, on examples whose truth is one feature."""

from importlib.util import find_spec

import numpy as np
import pytest

from flowing_puppet_ros.body.upright.candidate_shape import SHAPE_NAMES
from flowing_puppet_ros.body.upright.person_model import PersonModel
from flowing_puppet_ros.body.upright.verification import EVIDENCE_NAMES, FitEvidence
from flowing_puppet_ros.learn.people.examples import CandidateExamples
from flowing_puppet_ros.learn.people.forest import learn_model

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not find_spec("sklearn"), reason="needs the extra learn"),
]


def make_examples(seed: int, tell_tracked: bool) -> CandidateExamples:
    """Make 160 examples: most people are those whose cost is low, and in tracked ones those whose distance is."""
    rng = np.random.default_rng(seed)
    person = rng.integers(0, 2, 160)
    shape = rng.standard_normal((160, len(SHAPE_NAMES)))
    evidence, tracked = rng.standard_normal((2, 160, len(EVIDENCE_NAMES)))
    evidence[:, EVIDENCE_NAMES.index("cost")] -= 6.0 * person
    tracked[:, EVIDENCE_NAMES.index("distance")] -= 6.0 * person
    tracked[:] = tracked if tell_tracked else np.nan
    error = np.where(person == 1, 0.05 + 0.1 * (rng.random(160) < 0.5), np.nan)
    unlike = rng.random(160) < 0.05  # nothing is quite sure
    return CandidateExamples(shape, evidence, tracked, np.where(unlike, 1 - person, person), np.arange(160) % 12, error)


def judge(model: PersonModel, column: str, value: float) -> float:
    values = np.zeros(len(EVIDENCE_NAMES))
    values[EVIDENCE_NAMES.index(column)] = value
    return model.judge_fit(FitEvidence(values))


def test_fits_and_tracked_bodies_are_both_learned_from() -> None:
    without, both = (learn_model(make_examples(3, tracked), 0) for tracked in (False, True))
    assert judge(without, "cost", -6.0) > 0.9 and judge(without, "cost", 0.0) < 0.1
    assert abs(judge(without, "distance", -6.0) - judge(without, "distance", 0.0)) < 0.1
    assert judge(both, "distance", -6.0) > judge(both, "distance", 0.0) + 0.3
    again = PersonModel.from_arrays(both.to_arrays())
    assert judge(again, "cost", -3.0) == judge(both, "cost", -3.0)


def test_other_odds_add_to_the_judges() -> None:
    model = learn_model(make_examples(4, False), 0)
    nothing = FitEvidence(np.zeros(len(EVIDENCE_NAMES)))
    odds = [np.log(p / (1 - p)) for p in (model.judge_fit(nothing), model.judge_fit(nothing, 1.5))]
    assert odds[1] - odds[0] == pytest.approx(1.5)
