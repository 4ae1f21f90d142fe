# SPDX-License-Identifier: Apache-2.0
"""Settings: one declaration gives checked values, descriptions, mappings and command-line flags."""

import argparse
from dataclasses import dataclass

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.settings import Settings, setting


@dataclass(frozen=True, slots=True)
class Example(Settings):
    """One setting of every kind."""

    particles: int = setting(30, "particles a part", low=2, high=500)
    noise: float = setting(0.04, "random walk", unit="m", low=0.0)
    preset: str = setting("fast", "what to favour", choices=("fast", "exact"))
    mirror: bool = setting(False, "mirror the input")


def parse(*words: str) -> Example:
    parser = argparse.ArgumentParser()
    Example.add_arguments(parser)
    return Example.from_arguments(parser.parse_args(words))


def test_description_tells_unit_range_and_choices() -> None:
    texts = {info.name: info.description for info in Example.describe()}
    assert texts == {
        "particles": "particles a part (2 to 500)",
        "noise": "random walk (m; 0 to any)",
        "preset": "what to favour (one of fast, exact)",
        "mirror": "mirror the input",
    }


def test_flags_give_the_same_settings_as_the_constructor() -> None:
    assert parse() == Example()
    flags = ("--particles", "80", "--noise", "1", "--preset", "exact", "--mirror")
    assert parse(*flags) == Example(80, 1.0, "exact", True)


def test_integers_are_welcome_where_floats_are_wanted() -> None:
    assert isinstance(Example(noise=1).noise, float)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"particles": 1}, "particles is 1, outside 2 to 500"),
        ({"particles": 3.5}, "particles is 3.5, which is not a int"),
        ({"particles": True}, "particles is True, which is not a int"),
        ({"noise": float("nan")}, "noise is nan, outside 0 to any"),
        ({"preset": "slow"}, "preset is 'slow', which is not one of fast, exact"),
        ({"speed": 3}, "unknown setting 'speed'; known are mirror, noise, particles, preset"),
    ],
)
def test_bad_values_are_refused_by_name(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        Example.from_mapping(values)
    assert str(caught.value) == sentence
