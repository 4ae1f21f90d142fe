# SPDX-License-Identifier: Apache-2.0
"""What an inspection finds: sentences with their severity and the command to run next."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Severity = Literal["ready", "note", "warning", "error"]
"""What will be computed; what is good to know; what makes results worse or incomplete; what prevents results."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence about an input, and the command to run next, "" if there is none."""

    severity: Severity
    sentence: str
    command: str = ""


@dataclass(slots=True)
class Inspection:
    """All that was found about one input.

    Attributes:
        source: the path, "live" or "machine".
        kind: what the input is, as in `recognise.Kind`.
        findings: in the order in which they are to be read.
        topics: of a recording or live: one object a topic, ready for JSON.
    """

    source: str
    kind: str
    findings: list[Finding] = field(default_factory=list)
    topics: list[dict[str, Any]] = field(default_factory=list)

    def add(self, severity: Severity, sentence: str, command: str = "") -> None:
        """Add a finding."""
        self.findings.append(Finding(severity, sentence, command))

    @property
    def is_usable(self) -> bool:
        """Whether something can be computed from the input."""
        return any(finding.severity == "ready" for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the inspection as JSON takes it."""
        findings = [
            {"severity": each.severity, "sentence": each.sentence, "command": each.command or None}
            for each in self.findings
        ]
        topics = {"topics": self.topics} if self.topics else {}
        return {"input": self.source, "kind": self.kind, "usable": self.is_usable, "findings": findings} | topics
