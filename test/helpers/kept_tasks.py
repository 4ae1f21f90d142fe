# SPDX-License-Identifier: Apache-2.0
"""An executor whose tasks run when a test says so, or never."""

from __future__ import annotations

from typing import Any


class KeptTasks:
    """Keeps what is submitted, in order."""

    def __init__(self) -> None:
        self.tasks: list[Any] = []

    def submit(self, task: Any) -> None:
        """Keep a task."""
        self.tasks.append(task)

    def run(self) -> int:
        """Run the tasks that are kept and forget them; return how many they were."""
        tasks, self.tasks = self.tasks, []
        for task in tasks:
            task()
        return len(tasks)
