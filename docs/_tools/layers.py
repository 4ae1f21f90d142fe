# SPDX-License-Identifier: Apache-2.0
"""The layers of the package, from the test that holds the direction of its imports."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGE = ROOT / "flowing_puppet_ros"
CONTRACT = ROOT / "test" / "test_contract.py"
HELPERS = ROOT / "test" / "helpers"


def pages(linked: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the table of layers; `linked` are the subpackages with an API page."""
    contract = load_contract()
    foundation = ", ".join(f"`{name}`" for name in sorted(contract.FOUNDATION))
    lines = ["| layer | room | what it is for |", "| --- | --- | --- |"]
    lines.append(f"| 0 | | the modules beside the rooms, which everything may import: {foundation} |")
    for number, rooms in enumerate(contract.layers(), 1):
        for room in rooms:
            shown = f"[`{room}`](/generated/api/{room.partition('.')[0]}.md)"
            lines.append(
                f"| {number} | {shown if room.partition('.')[0] in linked else f'`{room}`'} | {summary(room)} |"
            )
    yield "architecture/layers.md", "\n".join(lines) + "\n"


def load_contract() -> ModuleType:
    """Load the test module that lists which room may import which."""
    spec = importlib.util.spec_from_file_location("contract", CONTRACT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(HELPERS))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(HELPERS))
    return module


def summary(room: str) -> str:
    """Return the first line of a room's docstring."""
    docstring = ast.get_docstring(ast.parse(PACKAGE.joinpath(*room.split("."), "__init__.py").read_text())) or ""
    return docstring.partition("\n")[0]
