# SPDX-License-Identifier: Apache-2.0
"""The points of the neutral model, for the tests of this folder."""

import pytest

from flowing_puppet_ros.body.search.part_points import PartPoints, build_part_points
from flowing_puppet_ros.model.sp import StitchedPuppet


@pytest.fixture(scope="session")
def points(model: StitchedPuppet) -> tuple[PartPoints, ...]:
    """Return the points of every part of the neutral model."""
    return build_part_points(model)
