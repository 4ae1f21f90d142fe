# SPDX-License-Identifier: Apache-2.0
"""Work for the tests of batches, importable by the processes that they start."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowing_puppet_ros.errors import InputError


@dataclass(frozen=True)
class Plan:
    """Options of the work below: where to leave marks."""

    marks: Path


def work(source: Path, plan: Plan) -> dict[str, Any]:
    """Return the process; depending on the input's name, leave a mark, die (once or always), or fail."""
    mark = plan.marks / source.name
    if source.name == "dies" or (source.name == "dies_once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if source.name == "unusable":
        raise InputError("it is unusable")
    if source.name == "broken":
        raise ZeroDivisionError("oh")
    if source.name.startswith("leaves_a_mark"):
        mark.touch()
    return {"process": os.getpid(), "threads": os.environ["NUMBA_NUM_THREADS"]}
