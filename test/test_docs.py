# SPDX-License-Identifier: Apache-2.0
"""What the documentation site is made of: generated pages hold what the code has, figures are those that are drawn."""

import re
from pathlib import Path

import docstrings  # type: ignore[import-not-found]
import figures_2d  # type: ignore[import-not-found]
import figures_3d  # type: ignore[import-not-found]
import interfaces  # type: ignore[import-not-found]
import mathml  # type: ignore[import-not-found]
import pages  # type: ignore[import-not-found]
import pytest
from docutils import nodes
from sphinx.errors import SphinxError

from flowing_puppet_ros.cli import VERBS
from flowing_puppet_ros.stream.components.registry import COMPONENTS

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all generated pages."""
    folder = tmp_path_factory.mktemp("generated")
    pages.write(folder)
    return folder


@pytest.mark.parametrize("name", COMPONENTS)
def test_every_topic_and_parameter_of_a_node_is_in_its_tables(written: Path, name: str) -> None:
    component = COMPONENTS[name]
    inputs, outputs = pages.ports(component)
    for kind, ports in (("inputs", inputs), ("outputs", outputs)):
        text = (written / "nodes" / f"{name}-{kind}.md").read_text()
        assert ports
        assert [port.name for port in ports if f"| `{port.name}` |" not in text] == []
    text = (written / "nodes" / f"{name}-parameters.md").read_text()
    for info in component.settings_type.describe():
        assert f"| `{info.name}` |" in text
        assert info.help in text


def test_every_verb_module_and_message_has_its_section(written: Path) -> None:
    commands, messages = (written / "cli.md").read_text(), (written / "messages.md").read_text()
    assert [verb for verb in VERBS if f"## `{verb}`" not in commands] == []
    for path in (ROOT / "msg_defs").glob("*/*.msg"):
        assert f"## `{path.stem}`" in messages
    for path in (ROOT / "flowing_puppet_ros" / "inference").glob("[a-z]*.py"):
        assert f"automodule:: flowing_puppet_ros.inference.{path.stem}" in (written / "api/inference.md").read_text()


def test_pages_that_did_not_change_are_not_written_again(written: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in written.rglob("*.md")}
    pages.write(written)
    assert {path: path.stat().st_mtime_ns for path in written.rglob("*.md")} == before


def test_a_field_without_a_comment_is_refused() -> None:
    with pytest.raises(ValueError, match="float32 x"):
        interfaces.leading_comment("# A point.\nfloat32 x\n")


def test_docstrings_are_taken_literally() -> None:
    assert docstrings.as_rst("`a_` and |b|, *c*, d_ of (N,3)") == r"``a_`` and \|b\|, \*c\*, d\_ of (N,3)"
    assert docstrings.as_rst("    Args:") == "    Args:"
    assert docstrings.as_rst("one ` alone") == "one ' alone"


def test_formulas_become_mathml_or_stop_the_build() -> None:
    assert "<msub>" in mathml.mathml(nodes.math(text=r"x_i"), False)
    with pytest.raises(SphinxError, match="nosuch"):
        mathml.mathml(nodes.math(text=r"\nosuch{x}"), False)


def test_pages_show_the_figures_that_are_drawn() -> None:
    drawn = {path.stem for path in (ROOT / "docs" / "drawn").iterdir()}
    shown: set[str] = set()
    for page in (ROOT / "docs").rglob("*.md"):
        for name in re.findall(r"\{figure\} (\S+)", page.read_text()):
            assert (page.parent / name).is_file(), f"{page}: {name}"
            shown.add(Path(name).stem)
    assert drawn == shown == {*figures_2d.FIGURES, *figures_3d.FIGURES}


def test_the_tests_that_pages_name_are_there() -> None:
    text = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    named = set(re.findall(r"test/[\w/]+\.py", text))
    assert len(named) > 20
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_a_figure_is_a_picture_with_something_on_it() -> None:
    picture = figures_2d.labels()
    assert picture.shape[0] == figures_2d.SIZE[1]
    assert len({tuple(colour) for colour in picture[:, -200:].reshape(-1, 3)}) > 2
