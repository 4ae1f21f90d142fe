# SPDX-License-Identifier: Apache-2.0
"""The message reference, from the comments of the interface definitions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

DEFINITIONS = Path(__file__).resolve().parent.parent.parent / "msg_defs"
SECTIONS = {"action": ("Goal", "Result", "Feedback"), "srv": ("Request", "Response"), "msg": ("",)}


def pages() -> Iterator[tuple[str, str]]:
    """Yield the page of all messages and actions."""
    parts = ["# Messages and actions\n", "Package `flowing_puppet_msgs`. Every field with its unit and frame.\n"]
    for kind in ("msg", "srv", "action"):
        for path in sorted((DEFINITIONS / kind).glob(f"*.{kind}")):
            parts.append(definition(path, kind))
    yield "messages.md", "\n".join(parts)


def definition(path: Path, kind: str) -> str:
    """Return one interface as a section with a table of fields for each of its parts."""
    lines = [f"## `{path.stem}`\n"]
    head, sections = leading_comment(path.read_text())
    lines.append(head + "\n")
    for title, section in zip(SECTIONS[kind], sections, strict=True):
        if title:
            lines.append(f"**{title}**\n")
        lines += ["| field | type | meaning |", "|---|---|---|", *section, ""]
    return "\n".join(lines)


def leading_comment(text: str) -> tuple[str, list[list[str]]]:
    """Return the comment before the first field, then the rows of each section."""
    comment: list[str] = []
    sections: list[list[str]] = [[]]
    for line in text.splitlines():
        code, _, meaning = (part.strip() for part in line.partition("#"))
        if line.startswith("---"):
            sections.append([])
        elif code:
            sections[-1].append(row(code, meaning))
        elif meaning and not any(sections):
            comment.append(meaning)
        elif meaning:
            raise ValueError(f"a comment between fields belongs behind one: {line!r}")
    return " ".join(comment), sections


def row(code: str, meaning: str) -> str:
    """Return a field or a constant as a row."""
    if not meaning:
        raise ValueError(f"a field without a comment: {code!r}")
    kind, name = code.split(maxsplit=1)
    return f"| `{name}` | `{kind}` | {meaning} |"
