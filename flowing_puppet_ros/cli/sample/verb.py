# SPDX-License-Identifier: Apache-2.0
"""Draw random bodies of a learned model: `ds`, the 2D puppet, or `sp`, the 3D one."""

SUBVERBS = {name: f"flowing_puppet_ros.cli.sample.{name}" for name in ("ds", "sp")}
