# SPDX-License-Identifier: Apache-2.0
"""What the tests of this folder share: the Anny body, and the painted people of the image tests to import."""

import sys
from pathlib import Path

import pytest

from flowing_puppet_ros.learn.anny import AnnyBody

sys.path.insert(0, str(Path(__file__).parent.parent / "image"))


@pytest.fixture(scope="session")
def body() -> AnnyBody:
    """The neutral Anny body, which takes seconds to load."""
    return AnnyBody("neutral")
