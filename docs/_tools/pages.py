# SPDX-License-Identifier: Apache-2.0
"""Pages and tables generated from the code, so that they cannot fall behind it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import commands
import equations
import interfaces
import layers

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.settings import SettingInfo, Settings
from flowing_puppet_ros.stream.component import Component, Port
from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGE = ROOT / "flowing_puppet_ros"
MEASURED = ROOT / "docs" / "measured"
API = {
    "model": "What a puppet is",
    "evidence": "How well a puppet explains data",
    "inference": "How the best puppet is found",
    "flow": "Optical flow and puppet flow",
    "image": "People in images and videos",
    "body": "Bodies in clouds",
    "multiview": "People in calibrated cameras",
    "stream": "Messages in, messages out, without ROS",
    "bag": "Recordings",
    "node": "Nodes",
    "learn": "Learning the models",
    "evaluate": "Measuring",
    "annotate": "The annotation tool",
    "draw": "Pictures",
    "report": "Reports",
}
# Settings with which a component has all of its topics.
EVERYTHING = {"cameras": "CAMERA,other", "ros4hri.publish": True, "output.measure": True}
QOS = {
    "sensor": "sensor data: best effort, keep last 5",
    "reliable": "reliable, keep last 10",
    "latched": "reliable, transient local",
}


def write(folder: Path) -> None:
    """Write every generated page; files whose text is unchanged are not touched."""
    for name, text in [
        *node_tables(),
        *bench_tables(),
        *interfaces.pages(),
        *commands.pages(),
        *equations.pages(API),
        *layers.pages(API),
        *api_pages(),
        *model_cards(),
    ]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text() != text:
            path.write_text(text)


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def node_tables() -> Iterator[tuple[str, str]]:
    """Yield the tables of topics and parameters that the nodes' pages include."""
    for name, component in COMPONENTS.items():
        inputs, outputs = ports(component)
        always = getattr(component, "outputs", outputs)
        rows = (
            [port_row(port) for port in inputs],
            [port_row(port, request_of(port) if port not in always else "", True) for port in outputs],
        )
        for kind, lines in zip(("inputs", "outputs"), rows, strict=True):
            yield f"nodes/{name}-{kind}.md", table(["topic", "type", "QoS", ""], lines)
        yield f"nodes/{name}-parameters.md", parameter_table(component.settings_type, node_settings(name))


def ports(component: type[Component]) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Return the inputs and outputs of a component that publishes all it can; one camera stands for all of them."""
    known = {info.name for info in component.settings_type.describe()}
    settings = component.settings_type.from_mapping(
        {name: value for name, value in EVERYTHING.items() if name in known}
    )
    made = component(settings, BagMessageFactory())
    return tuple(port for port in made.inputs if not port.name.startswith("other/")), made.outputs


def request_of(port: Port) -> str:
    """Return the parameter with which an output is published that is not always."""
    return "output.measure:=true" if port.name == "measurements" else "ros4hri.publish:=true"


def port_row(port: Port, request: str = "", output: bool = False) -> list[str]:
    """Return one row of a table of topics; `request` is the parameter without which one is not published."""
    package, _, message = port.type.split("/")
    notes = []
    if port.transport:
        notes.append(f"{'also' if output else 'or'} `{port.name}/{port.transport}`")
    if port.alternatives:
        notes.append("or " + ", ".join(f"`{other.replace('/msg/', '/')}`" for other in port.alternatives))
    if port.optional and not output:
        notes.append("optional")
    if port.lazy:
        notes.append("made only while subscribed to")
    if port.optional and output:
        notes.append(f"where `{package}` is installed, and in bags")
    if request:
        notes.append(f"with `{request}`")
    if port.per_person:
        notes.append("one topic per person")
    linked = package == "flowing_puppet_msgs"
    shown = f"[`{package}/{message}`](/generated/messages.md)" if linked else f"`{package}/{message}`"
    return [f"`{port.name}`", shown, QOS[port.qos], ", ".join(notes)]


def parameter_table(*settings: type[Settings]) -> str:
    """Return the table of the parameters that come from settings."""
    infos = [info for kind in settings for info in kind.describe()]
    offered, advanced = ([info for info in infos if info.advanced is kind] for kind in (False, True))
    if not advanced:
        return _setting_rows(offered)
    heading = "Advanced; declared only if given at the start:"
    return f"{_setting_rows(offered)}\n{heading}\n\n{_setting_rows(advanced)}"


def _setting_rows(infos: Iterable[SettingInfo]) -> str:
    rows = []
    for info in infos:
        limits = ", ".join(f"`{choice}`" for choice in info.choices)
        if info.low is not None or info.high is not None:
            limits = " to ".join("any" if bound is None else f"{bound:g}" for bound in (info.low, info.high))
        default = repr(info.default).replace("'", '"') if info.type is str else str(info.default).lower()
        rows.append([f"`{info.name}`", f"`{default}`", info.unit, limits, info.help])
    return table(["parameter", "default", "unit", "range", "meaning"], rows)


def bench_tables() -> Iterator[tuple[str, str]]:
    """Yield the tables of what `flowing-puppet bench` measured, from the files in docs/measured."""
    for path in sorted(MEASURED.glob("*.json")):
        for part, rows in json.loads(path.read_text()).items():
            heads = [head.replace("_", " ") for head in rows[0]]
            yield f"bench/{part}.md", table(heads, ([figure(value) for value in row.values()] for row in rows))


def figure(value: object) -> str:
    """Return a measured value to three digits, or "never" for None, which stands for no finite number."""
    if value is None:
        return "never"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def api_pages() -> Iterator[tuple[str, str]]:
    """Yield the API reference: a page per subpackage, and their index."""
    yield (
        "api/index.md",
        "\n".join(
            [
                "# API reference",
                "",
                "Generated from the docstrings. Names that begin with an underscore are private and left out.",
                "",
                "```{toctree}\n:maxdepth: 1\n",
                *API,
                "settings",
                "```\n",
            ]
        ),
    )
    beside = [path.stem for path in sorted(PACKAGE.glob("*.py")) if not path.stem.startswith("__")]
    yield "api/settings.md", api_page("settings", "Settings, errors and whatever else all parts share", beside)
    for part, title in API.items():
        files = sorted(path for path in (PACKAGE / part).rglob("*.py") if path.stem != "__init__")
        modules = [".".join(file.relative_to(PACKAGE).with_suffix("").parts) for file in files]
        yield f"api/{part}.md", api_page(part, title, modules)


def api_page(part: str, title: str, modules: Iterable[str]) -> str:
    """Return the page of some modules."""
    pieces = [f"# `{part}`: {title[0].lower()}{title[1:]}\n"]
    for module in modules:
        pieces.append(f"## `{module}`\n\n```{{eval-rst}}\n.. automodule:: flowing_puppet_ros.{module}\n```\n")
    return "\n".join(pieces)


def model_cards() -> Iterator[tuple[str, str]]:
    """Yield the model cards on one page, their headings one level down."""
    cards = sorted((PACKAGE / "weights").glob("*.md"))
    shifted = [re.sub(r"^(#+) ", r"#\1 ", card.read_text().strip(), flags=re.MULTILINE) for card in cards]
    heading = (
        "# Model cards\n\nThe learned models that ship in the package, `flowing_puppet_ros/weights`, which "
        "`flowing-puppet learn` reproduces, and the two keypoint networks, BlazePose and MoveNet, which "
        "`flowing-puppet networks --install` takes from the package index.\n"
    )
    yield "cards.md", heading + "\n" + "\n\n".join(shifted) + "\n"
