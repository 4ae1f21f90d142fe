# SPDX-License-Identifier: Apache-2.0
"""Which function computes which equation of the thesis, from the citations in the package's docstrings."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent.parent / "flowing_puppet_ros"
FIRST, LAST = 5, 64
"""Equations of the table: those before state Bayes' rule and pictorial structures, and the thesis has no more."""
CHAPTERS = {
    FIRST: "The 2D puppet",
    15: "Pose in one image",
    31: "Video",
    38: "Nine views",
    44: "The 3D puppet",
    50: "Fitting a cloud",
}
"""The first equation of each section of the table."""
NOT_COMPUTED = {
    18: "sum-product messages, from which the thesis derives Eq. 19; nothing here needs sums",
    31: "Eq. 6, repeated for the video chapter",
    32: "Eq. 5, repeated without its constant",
}
"""Equations that no function computes, and why."""
CITATION = re.compile(r"\bEq\.\s+(\d+)|\bEqs\.\s+(\d+(?:\s*(?:-|to\b|and\b|,(?:\s*and\b)?)\s*\d+)*)")
type Citations = dict[int, list[str]]


def cited(text: str) -> list[int]:
    """Return the equations that a text cites, ascending: "Eq. 53", "Eqs. 55-58", "Eqs. 20 to 22", "Eqs. 48, 50 and 52".

    ValueError for a range that does not ascend, or for an equation that the thesis does not have.
    """
    found: set[int] = set()
    for single, several in CITATION.findall(text):
        for first, last in re.findall(r"(\d+)(?:\s*(?:-|to)\s*(\d+))?", single or several):
            low, high = int(first), int(last or first)
            if not 1 <= low <= high <= LAST:
                raise ValueError(f"the thesis has no equations {single or several!r}")
            found.update(range(low, high + 1))
    return sorted(found)


def citations() -> tuple[Citations, Citations]:
    """Return the functions and classes that cite each equation, and the modules that do, by their dotted names."""
    precise: Citations = {}
    vague: Citations = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        for name, docstring in docstrings(ast.parse(path.read_text()), module):
            for number in cited(docstring):
                (vague if name == module else precise).setdefault(number, []).append(name)
    return precise, vague


def docstrings(node: ast.Module | ast.ClassDef | ast.FunctionDef, name: str) -> Iterator[tuple[str, str]]:
    """Yield the dotted names and docstrings of a module, class or function and of all that is defined in it."""
    docstring = ast.get_docstring(node)
    if docstring:
        yield name, docstring
    for inner in node.body:
        if isinstance(inner, ast.ClassDef | ast.FunctionDef):
            yield from docstrings(inner, f"{name}.{inner.name}")


def pages(rooms: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the table of equations; `rooms` are the subpackages with an API page, in the order they are named in."""
    order = {room: place for place, room in enumerate(rooms)}
    precise, vague = citations()
    lines: list[str] = []
    for number in range(FIRST, LAST + 1):
        if number in CHAPTERS:
            lines += ["", f"## {CHAPTERS[number]}", "", "| equation | computed by |", "| --- | --- |"]
        names = precise.get(number) or ([] if number in NOT_COMPUTED else vague.get(number, []))
        names.sort(key=lambda name: order.get(name.split(".")[0], len(order)))
        lines.append(f"| {number} | {', '.join(reference(name, order) for name in names) or NOT_COMPUTED[number]} |")
    yield "method/equations.md", "\n".join(lines[1:]) + "\n"


def reference(name: str, rooms: Iterable[str]) -> str:
    """Return a dotted name as code, linked to the API reference when it is in there."""
    parts = name.split(".")
    if parts[0] in rooms and not any(part.startswith("_") for part in parts):
        return f"{{py:obj}}`{name} <flowing_puppet_ros.{name}>`"
    return f"`{name}`"
