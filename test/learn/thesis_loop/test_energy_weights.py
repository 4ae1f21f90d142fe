# SPDX-License-Identifier: Apache-2.0
"""The search for the energy's weights finds which terms tell the truth, and what is lost without each."""

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.thesis_loop.energy_weights import (
    PuppetChoices,
    WeightSettings,
    gather_choices,
    search_weights,
)
from flowing_puppet_ros.model.ds.puppet import DeformableStructures


def choices(people: int = 60, puppets: int = 30) -> PuppetChoices:
    """Make choices in which hands predict the miss well, contours a little, colour inversely, the prior not at all."""
    rng = np.random.default_rng(0)
    miss = rng.uniform(0, 0.3, (people, puppets))
    noise = rng.standard_normal((people, puppets, 7))
    terms = noise * [10.0, 1.0, 1.0, 0.3, 1.0, 1.0, 0.3]
    terms[..., 1] -= 3.0 * miss
    terms[..., 2] += 10.0 * miss
    terms[..., [3, 6]] -= 10.0 * miss[..., None]
    return PuppetChoices(terms, miss, np.arange(people) % 2)


def test_what_tells_the_truth_weighs_and_what_does_not_hardly() -> None:
    figures = search_weights(choices(), WeightSettings(draws=300))
    assert figures["hand_weight"] > 3.0 * figures["colour_weight"]
    assert figures["prior_weight"] < 0.1
    assert figures["miss of the best puppet"] <= figures["miss"] < 0.4 * figures["miss of a random puppet"]
    assert figures["miss without hands"] > 2.0 * figures["miss"]
    assert figures["miss without the neighbour's evidence"] > figures["miss"]
    assert figures["miss"] <= figures["miss held out"] < 0.5 * figures["miss of a random puppet"]
    assert search_weights(choices(), WeightSettings(draws=300)) == figures


def test_the_chosen_puppet_is_that_of_least_energy() -> None:
    terms = np.zeros((1, 3, 7))
    terms[0, :, 0] = [1.0, 2.0, 3.0]
    terms[0, :, 4] = [0.0, 0.0, 5.0]
    some = PuppetChoices(terms, np.array([[0.1, 0.2, 0.3]]), np.zeros(1))
    assert some.measure_miss(np.array([1.0, 0.0, 0.0, 0.0]))[0] == 0.1
    assert some.measure_miss(np.array([1.0, 1.0, 0.0, 0.0]))[0] == 0.3
    assert some.measure_miss(np.array([1.0, 1.0, 0.0, 0.0]), neighbour_weight=0.0)[0] == 0.1


@pytest.mark.slow
def test_too_few_people_are_one_sentence() -> None:
    with pytest.raises(InputError, match="show 0 people with an image before theirs"):
        gather_choices(DeformableStructures.load(), [], WeightSettings(), lambda _: None)
