# SPDX-License-Identifier: Apache-2.0
"""What long-running work counts and warns of: one report, handed down to all who have something to say."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field

from flowing_puppet_ros.errors import InputError

MAX_WARNINGS = 100
"""Different sentences in the life of a report: what can be wrong with hostile input has no end."""


@dataclass(slots=True, eq=False)
class Report:
    """Counters by name, and the sentences to log, each reason once."""

    counters: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    _warned: set[str] = field(default_factory=set)

    def warn(self, sentence: str) -> None:
        """Add a sentence unless one that differs from it in its numbers only was added before."""
        reason = re.sub(r"[0-9.]+", "#", sentence)
        if reason not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(reason)
            self.warnings.append(sentence)

    def count_unusable(self, error: InputError) -> None:
        """Count an input that cannot be used, and warn of the reason."""
        self.warn(str(error))
        self.counters["unusable"] += 1

    def drain_warnings(self) -> list[str]:
        """Return the sentences that were added since the last call."""
        warnings, self.warnings = self.warnings, []
        return warnings
