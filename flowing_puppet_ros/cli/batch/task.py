# SPDX-License-Identifier: Apache-2.0
"""The task of processing one input in another process or on another machine, and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from flowing_puppet_ros import __version__
from flowing_puppet_ros.errors import PuppetError

Summary = dict[str, Any]

# One input at a time per process: a cluster's process may run several threads, but each task uses all cores.
_ALONE = Lock()


@dataclass(frozen=True, slots=True)
class BatchTask:
    """One input with the function that processes it."""

    work: Callable[[Path, Any], Summary]
    source: Path
    options: Any
    version: str = __version__


@dataclass(frozen=True, slots=True)
class TaskResult:
    """The summary of a finished input, or an error sentence with its exit status."""

    summary: Summary
    error: str = ""
    status: int = 0


def execute(task: BatchTask) -> TaskResult:
    """Execute one task; errors are returned in the result."""
    if task.version != __version__:
        return TaskResult({}, f"a worker has version {__version__} of this package and not {task.version}", 1)
    try:
        with _ALONE:
            return TaskResult(task.work(task.source, task.options))
    except PuppetError as error:
        return TaskResult({}, str(error), error.exit_status)
    except Exception as error:  # one input of a thousand must not end the others
        return TaskResult({}, f"{task.source} failed: {type(error).__name__}: {error}", 1)
