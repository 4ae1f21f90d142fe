# SPDX-License-Identifier: Apache-2.0
"""Let the tests of this folder import the painted people of the image tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "image"))
