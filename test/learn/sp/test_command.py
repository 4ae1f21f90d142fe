# SPDX-License-Identifier: Apache-2.0
"""What the model card says about samples of a model."""

import re

import pytest

from flowing_puppet_ros.learn.sp.command import describe_samples
from flowing_puppet_ros.model.sp import StitchedPuppet


@pytest.mark.slow
@pytest.mark.parametrize("name", ["neutral", "female", "male"])
def test_samples_are_as_tall_and_as_large_as_adults_and_hold_together(name: str) -> None:
    report = describe_samples(StitchedPuppet.load(name), 12)
    stature = [float(x) for x in re.findall(r"stature ([\d.]+), ([\d.]+) and ([\d.]+) m", report)[0]]
    volume = [float(x) for x in re.findall(r"volume (\d+), (\d+) and (\d+) litres", report)[0]]
    mean, worst = (float(x) for x in re.findall(r"of ([\d.]+) mm between .*them ([\d.]+) mm", report)[0])
    assert report.startswith("12 random bodies")
    assert 1.35 < stature[0] < stature[1] < stature[2] < 2.1
    assert 30 < volume[0] < volume[1] < volume[2] < 160
    assert 0 < mean < worst < 12
