# SPDX-License-Identifier: Apache-2.0
"""What the documentation site is made of: generated pages hold what the code has, figures are those that are drawn."""

import pkgutil
import re
from pathlib import Path

import docstrings  # type: ignore[import-not-found]
import equations  # type: ignore[import-not-found]
import figures_2d  # type: ignore[import-not-found]
import figures_3d  # type: ignore[import-not-found]
import interfaces  # type: ignore[import-not-found]
import layers  # type: ignore[import-not-found]
import mathml  # type: ignore[import-not-found]
import numpy as np
import pages  # type: ignore[import-not-found]
import pytest
import screenshots  # type: ignore[import-not-found]
from docutils import nodes
from sphinx.errors import SphinxError

from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.particles import states_to_particles
from flowing_puppet_ros.body.search.schedule import four_stages
from flowing_puppet_ros.cli import VERBS
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.image.networks.files import FILES
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


def test_every_network_that_is_installed_has_a_card_that_says_where_it_is_from(written: Path) -> None:
    cards = (written / "cards.md").read_text().split("\n## ")
    for network in FILES:
        (card,) = (card for card in cards if network.file in card)
        said = (network.sha256, network.requirement, *network.members, "Apache-2.0, Google", "### Limits")
        assert [word for word in said if word not in card] == []


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


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("the data term (thesis Eq. 53) of 16 parts", [53]),
        ("Eqs. 55-58", [55, 56, 57, 58]),
        ("Eqs. 20 to 22", [20, 21, 22]),
        ("Eqs. 52, 53 and 54", [52, 53, 54]),
        ("Eqs. 48 and 50-52, see\nEqs. 16,\n17, and 19", [16, 17, 19, 48, 50, 51, 52]),
        ("Eq. 21, 3 px", [21]),
        ("Eq. 10's mean angle", [10]),
        ("Freq. 12, Eq 13", []),
    ],
)
def test_citations_are_read_number_by_number(text: str, numbers: list[int]) -> None:
    assert equations.cited(text) == numbers


@pytest.mark.parametrize("wrong", ["Eq. 65", "Eq. 0", "Eqs. 58-55", "Eqs. 63 to 65"])
def test_citations_of_equations_that_do_not_exist_are_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong.split()[-1]):
        equations.cited(wrong)


def test_every_equation_is_computed_or_said_not_to_be() -> None:
    precise, _ = equations.citations()
    wanted = set(range(equations.FIRST, equations.LAST + 1))
    assert wanted - set(precise) == set(equations.NOT_COMPUTED)
    assert precise[55] == ["body.search.levenberg.levenberg_marquardt", "body.search.levenberg.assemble"]


def test_the_table_of_equations_has_each_once_and_names_what_exists(written: Path) -> None:
    rows = re.findall(r"^\| (\d+) \| (.+) \|$", (written / "method" / "equations.md").read_text(), re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(equations.FIRST, equations.LAST + 1))
    for _, names in rows:
        for target in re.findall(r"<flowing_puppet_ros\.([\w.]+)>", names):
            assert pkgutil.resolve_name(in_package(target)).__doc__


def in_package(dotted: str) -> str:
    """Return the name of a class or function of the package as `pkgutil.resolve_name` takes it: module:object."""
    parts = ["flowing_puppet_ros", *dotted.split(".")]
    length = max(n for n in range(1, len(parts) + 1) if ROOT.joinpath(*parts[:n]).with_suffix(".py").is_file())
    return f"{'.'.join(parts[:length])}:{'.'.join(parts[length:])}"


def test_the_table_of_layers_has_every_room_once(written: Path) -> None:
    contract = layers.load_contract()
    rooms = re.findall(r"^\| \d+ \| \[?`([\w.]+)`", (written / "architecture" / "layers.md").read_text(), re.MULTILINE)
    assert sorted(rooms) == sorted(room for room in contract.MAY_IMPORT if contract.files_in(room))


def test_the_files_and_modules_that_pages_name_are_there() -> None:
    package = ROOT / "flowing_puppet_ros"
    rooms = "|".join(path.parent.name for path in package.glob("*/__init__.py"))
    written = [page for page in (ROOT / "docs").rglob("*.md") if "generated" not in page.parts]
    text = "".join(page.read_text() for page in [ROOT / "README.md", *written])
    files = {f"{name}.py" for name in re.findall(rf"`((?:{rooms})/[\w/]+)\.py`", text)}
    assert len(files) > 10
    assert [name for name in sorted(files) if not (package / name).is_file()] == []
    parameters = {info.name for component in COMPONENTS.values() for info in component.settings_type.describe()}
    modules = set(re.findall(rf"`((?:{rooms})\.[a-z_.]+)`", text)) - parameters
    missing = [name for name in sorted(modules) if not list(package.glob(f"{name.replace('.', '/')}*"))]
    assert missing == []


def test_pages_show_the_figures_that_are_drawn() -> None:
    drawn = {path.stem for path in (ROOT / "docs" / "drawn").iterdir()}
    shown: set[str] = set()
    for page in (ROOT / "docs").rglob("*.md"):
        for name in re.findall(r"\{figure\} (\S+)", page.read_text()):
            assert (page.parent / name).is_file(), f"{page}: {name}"
            shown.add(Path(name).stem)
    assert drawn == shown == {*figures_2d.FIGURES, *figures_3d.FIGURES, *screenshots.PICTURES}


def test_the_tests_that_pages_name_are_there() -> None:
    text = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    named = set(re.findall(r"test/[\w/]+\.py", text))
    assert len(named) > 20
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


def test_the_figure_of_a_search_records_every_round() -> None:
    made = figures_3d.Bodies()
    grid = CloudGrid.build(made.points, made.normals)
    start = states_to_particles(made.model, [made.body, made.model.rest_state()])
    targets, stages = JointTargets.none(made.model), four_stages(made.model.tree)
    made.recorded.optimise(start, grid, targets, stages, 3, np.random.default_rng(0))
    assert len(made.recorded.bodies) == len(made.recorded.particles) == 3


def test_a_figure_is_a_picture_with_something_on_it() -> None:
    picture = figures_2d.labels()
    assert picture.shape[0] == figures_2d.SIZE[1]
    assert len({tuple(colour) for colour in picture[:, -200:].reshape(-1, 3)}) > 2
