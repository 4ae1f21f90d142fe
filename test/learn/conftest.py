# SPDX-License-Identifier: Apache-2.0
"""The Anny body, for the tests of this folder."""

import pytest

from flowing_puppet_ros.learn.anny.body import AnnyBody


@pytest.fixture(scope="session")
def body() -> AnnyBody:
    """The neutral Anny body, which takes seconds to load."""
    return AnnyBody("neutral")
