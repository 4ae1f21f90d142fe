# SPDX-License-Identifier: Apache-2.0
"""What every `evaluate` verb gives: a table with a column a run, and JSON, CSV and plots of it in a folder."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.tables import json_text, text_table, write_csv, write_json
from flowing_puppet_ros.settings import make_out_folder

Figures = dict[str, dict[str, float]]

WIDTH, HEIGHT, DPI = 7.2, 4.2, 150
# Told apart without colour vision (Okabe and Ito), darkest first.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
STYLES = ("-", "--", ":", "-.")


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One line or set of bars: y (n,) over x (n,); lines of one `group` (a run) share a dash, of one name a colour."""

    name: str
    x: np.ndarray
    y: np.ndarray
    group: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """One plot.

    Attributes:
        name: the end of its file's name.
        title, x_label, y_label: what it says.
        lines: what it shows.
        kind: "lines", "steps" of a histogram, or "bars" beside each other.
        categories: names of the x of bars.
        y_limits: of the axis, from the values when None.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    kind: str = "lines"
    categories: Sequence[str] = ()
    y_limits: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """The figures {run: {figure: value}} of one verb, more of them for the JSON, and plots."""

    verb: str
    figures: Figures
    details: Mapping[str, Any] = field(default_factory=dict)
    charts: Sequence[Chart] = ()

    def rows(self) -> list[dict[str, Any]]:
        """One row a figure, one column a run; NaN where a run lacks it."""
        names = dict.fromkeys(name for figures in self.figures.values() for name in figures)
        return [
            {"figure": name} | {run: figures.get(name, float("nan")) for run, figures in self.figures.items()}
            for name in names
        ]

    def give(self, arguments: argparse.Namespace) -> None:
        """Write the files into `--out`, if there is one, and print the table, or with `--json` the figures."""
        if arguments.out is not None:
            self.write(arguments.out)
        print(json_text(self.figures) if arguments.json else text_table(self.rows()))

    def write(self, folder: Path) -> None:
        """Write `<verb>.json`, `.csv`, and `<verb>-<chart>.png` and `.svg`; the same figures give the same bytes."""
        make_out_folder(folder)
        write_json(folder / f"{self.verb}.json", {"figures": self.figures, **self.details})
        write_csv(folder / f"{self.verb}.csv", self.rows())
        for chart in self.charts:
            if chart.lines:
                draw(chart, folder / f"{self.verb}-{chart.name}")


def add_arguments(parser: argparse.ArgumentParser, verb: str) -> None:
    """Add the flags of the output."""
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder for {verb}.json, {verb}.csv and the plots")
    parser.add_argument("--json", action="store_true", help="print {run: {figure: value}} as JSON instead of the table")


def run_names(paths: Sequence[Path]) -> list[str]:
    """A short name a run: the stem of its file; with the folder where stems are alike, else the whole path.

    Raises InputError when a run is named twice.
    """
    if len({path.absolute() for path in paths}) < len(paths):
        raise InputError("a run is named twice; name every run once")
    for make in (lambda path: path.stem, lambda path: f"{path.parent.name}/{path.stem}", str):
        names = [make(path) for path in paths]
        if len(set(names)) == len(names):
            break
    return names


def draw(chart: Chart, base: Path) -> None:
    """Draw a chart into `base`.png and `base`.svg."""
    settings = {"svg.hashsalt": "flowing_puppet_ros", "svg.fonttype": "none", "font.size": 9, "axes.axisbelow": True}
    with matplotlib.rc_context(settings):
        figure = Figure((WIDTH, HEIGHT), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        _fill(axes, chart)
        axes.set(xlabel=chart.x_label, ylabel=chart.y_label, ylim=chart.y_limits)
        axes.set_title(chart.title, loc="left", fontsize=10)
        axes.grid(color="0.88", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(frameon=False, fontsize=8, loc="outside lower left", ncols=2)
        figure.savefig(f"{base}.png", metadata={"Software": None})
        figure.savefig(f"{base}.svg", metadata={"Date": None, "Creator": None})


def _fill(axes: Any, chart: Chart) -> None:
    groups = list(dict.fromkeys(line.group for line in chart.lines))
    names = list(dict.fromkeys(line.name for line in chart.lines))
    for index, line in enumerate(chart.lines):
        colour = COLOURS[names.index(line.name) % len(COLOURS)]
        label = f"{line.name} ({line.group})" if line.group else line.name
        if chart.kind == "bars":
            width = 0.8 / len(chart.lines)
            axes.bar(line.x + width * (index - (len(chart.lines) - 1) / 2), line.y, width, color=colour, label=label)
            axes.set_xticks(np.arange(len(chart.categories)), chart.categories)
            continue
        draw_line = axes.plot if chart.kind == "lines" else axes.step
        where = {} if chart.kind == "lines" else {"where": "mid"}
        style = STYLES[groups.index(line.group) % len(STYLES)]
        draw_line(line.x, line.y, color=colour, linestyle=style, label=label, clip_on=False, **where)
