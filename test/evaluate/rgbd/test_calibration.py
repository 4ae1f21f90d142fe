# SPDX-License-Identifier: Apache-2.0
"""The table of said confidence against the share that is right, from scores whose shares are known."""

from dataclasses import replace

import pytest

from flowing_puppet_ros.evaluate.rgbd.scores import RgbdScore, tabulate_calibration


def score(
    reliable: bool, confidence: float, error: float, joints: tuple[int, int, int], hits: tuple[int, int, int]
) -> RgbdScore:
    nan = float("nan")
    return RgbdScore(
        "whole", True, 0.02, nan, nan, error, nan, nan, 0.0, False, False, 0, 4, reliable, confidence, 0.3, joints, hits
    )


def test_shares_are_those_of_the_joints_and_bodies() -> None:
    good = score(True, 0.9, 0.02, (2, 0, 10), (1, 0, 10))
    fair = score(True, 0.7, 0.12, (2, 0, 10), (0, 0, 8))
    poor = score(False, 0.5, 0.03, (0, 4, 8), (0, 1, 4))
    missing = replace(score(False, 0.0, float("nan"), (0, 0, 0), (0, 0, 0)), found=False)
    table = {(row["kind"], row["reliable"]): row for row in tabulate_calibration([good, fair, poor, missing])}
    assert table["seen joints", "yes"]["count"] == 20
    assert table["seen joints", "yes"]["within_10_cm"] == pytest.approx(0.9)
    assert table["inferred joints", "yes"]["within_10_cm"] == pytest.approx(0.25)
    # Joints of a body that is not reliable are said to be right as often as those of others times its confidence.
    assert table["near joints", "no"]["within_10_cm"] == pytest.approx(0.25)
    seen = [float(table["seen joints", known]["said"]) for known in ("yes", "no")]
    assert seen[1] == pytest.approx(0.5 * seen[0])
    assert table["bodies from 0.8", "yes"]["within_10_cm"] == 1 and table["bodies from 0.6", "yes"]["within_10_cm"] == 0
    assert table["bodies from 0.4", "no"]["said"] == pytest.approx(0.5)
    assert ("near joints", "yes") not in table and len(table) == 7
