# SPDX-License-Identifier: Apache-2.0
"""The work of the batches can be imported, also by the processes that the tests start."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
