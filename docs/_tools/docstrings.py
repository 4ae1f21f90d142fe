# SPDX-License-Identifier: Apache-2.0
"""Docstrings of this package as reStructuredText: they are plain text in which single backticks mean code."""

import re
from typing import Any

from sphinx.application import Sphinx

SPECIAL = re.compile(r"([*|\\]|(?<=\w)_(?=\W|$))")
SECTION = re.compile(r"\s*(Args|Returns|Yields|Raises|Attributes):\s*$")


def as_rst(line: str) -> str:
    """Return one line with code between double backticks and everything else taken literally."""
    if SECTION.match(line):
        return line
    pieces = line.split("`")
    if len(pieces) % 2 == 0:  # a lone backtick
        return SPECIAL.sub(r"\\\1", line.replace("`", "'"))
    return "".join(
        f"``{piece}``" if index % 2 and piece.strip() else SPECIAL.sub(r"\\\1", piece)
        for index, piece in enumerate(pieces)
    )


def convert(app: Sphinx, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Convert the lines of a docstring in place; blocks that are set in become literal blocks."""
    converted: list[str] = []
    section = literal = False
    for line in lines:
        section = bool(SECTION.match(line)) or (section and (not line.strip() or line.startswith(" ")))
        indented = line.startswith(("    ", "\t")) and not section
        if indented and not literal:
            converted += ["::", ""] if not converted or not converted[-1].strip() else ["", "::", ""]
        if literal and not indented and line.strip():
            converted.append("")
        literal = indented or (literal and not line.strip())
        converted.append(line if indented else as_rst(line))
    lines[:] = converted


def setup(app: Sphinx) -> None:
    """Convert before napoleon reads the sections."""
    app.connect("autodoc-process-docstring", convert, priority=100)
