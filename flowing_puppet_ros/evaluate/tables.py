# SPDX-License-Identifier: Apache-2.0
"""Figures as text for the terminal, as CSV and as JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]
"""Figures by name."""


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format rows as a table with a heading; numbers right-aligned, rounded to 4 digits.

    The columns are those of all rows in the order of their first appearance; a figure that a row lacks stays empty.
    """
    heads = list(dict.fromkeys(head for row in rows for head in row))
    cells = [heads, *([_format_cell(row.get(head, "")) for head in heads] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(heads))]
    right = [not any(isinstance(row.get(head), str) for row in rows) for head in heads]
    lines = []
    for line in cells:
        padded = (
            text.rjust(width) if to_right else text.ljust(width)
            for text, width, to_right in zip(line, widths, right, strict=True)
        )
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of one form below a line of names."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_json(path: Path, figures: Mapping[str, Any]) -> None:
    """Write figures as an indented JSON object."""
    path.write_text(format_json(figures, indent=2) + "\n", encoding="utf-8")


def format_json(figures: Mapping[str, Any], indent: int | None = None) -> str:
    """Format figures as a JSON object; non-finite numbers become null."""
    return json.dumps(_replace_non_finite(figures), indent=indent)


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _replace_non_finite(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_replace_non_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _format_cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
