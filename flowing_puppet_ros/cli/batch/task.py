# SPDX-License-Identifier: Apache-2.0
"""One input on its way to a process or another machine, and what comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from flowing_puppet_ros import __version__
from flowing_puppet_ros.errors import PuppetError

Summary = dict[str, Any]

# One input at a time a process: a process of a cluster may run several threads, and what works here uses all cores.
_ALONE = Lock()


@dataclass(frozen=True, slots=True)
class Task:
    """One input on its way to a process or another machine."""

    work: Callable[[Path, Any], Summary]
    source: Path
    options: Any
    version: str = __version__


@dataclass(frozen=True, slots=True)
class Answer:
    """The summary of a finished input, or one sentence about what failed and its exit status."""

    summary: Summary
    error: str = ""
    status: int = 0


def answer(task: Task) -> Answer:
    """Do one task; whatever goes wrong is in the answer."""
    if task.version != __version__:
        return Answer({}, f"a worker has version {__version__} of this package and not {task.version}", 1)
    try:
        with _ALONE:
            return Answer(task.work(task.source, task.options))
    except PuppetError as error:
        return Answer({}, str(error), error.exit_status)
    except Exception as error:  # one input of a thousand must not end the others
        return Answer({}, f"{task.source} failed: {type(error).__name__}: {error}", 1)
