# SPDX-License-Identifier: Apache-2.0
"""The shipped weights are there, have their cards, and a wrong name is one sentence."""

from importlib import resources

import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import weights


def test_stitched_puppets_are_shipped_with_cards() -> None:
    assert weights.available("sp") == ("female", "male", "neutral")
    folder = resources.files("flowing_puppet_ros") / weights.FOLDER
    for name in weights.available("sp"):
        card = (folder / f"sp_{name}.md").read_text(encoding="utf-8")
        for needed in ("CC0", "mocap.cs.cmu.edu", "EIA-0196217", f"learn sp --gender {name}", "Limits"):
            assert needed in card


def test_wrong_name_is_named_with_the_right_ones() -> None:
    with pytest.raises(InputError, match=r"'robot'.*female, male, neutral"):
        weights.load("sp", "robot")
