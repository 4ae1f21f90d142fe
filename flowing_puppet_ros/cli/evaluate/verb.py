# SPDX-License-Identifier: Apache-2.0
"""Measure poses and bodies against the ground truth."""

_HERE = "flowing_puppet_ros.cli.evaluate"
SUBVERBS = {
    **{name: f"{_HERE}.{name}" for name in ("pcp", "joints", "video")},
    **{name: f"{_HERE}.clouds.{name}" for name in ("bodies", "scenes", "rgbd")},
    **{name: f"{_HERE}.{name}" for name in ("correspondence", "bag", "likelihood", "hands")},
}
