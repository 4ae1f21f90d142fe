# SPDX-License-Identifier: Apache-2.0
"""The output of every `evaluate` verb: a table with a column per run, and JSON, CSV and plots in a folder."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.tables import format_json, format_table, write_csv, write_json
from flowing_puppet_ros.extras import needing_extra
from flowing_puppet_ros.settings import make_out_folder

Figures = dict[str, dict[str, float]]

WIDTH_IN, HEIGHT_IN, DPI = 7.2, 4.2, 150  # of a plot
# Distinguishable without colour vision (Okabe and Ito), darkest first.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
STYLES = ("-", "--", ":", "-.")


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line or bars, `y` (n,) over `x` (n,); lines of one `group` (a run) share a dash, of one name a colour."""

    name: str
    x: np.ndarray
    y: np.ndarray
    group: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """One plot.

    Attributes:
        name: suffix of its file name.
        title, x_label, y_label: its texts.
        lines: the data.
        kind: "lines", "steps" of a histogram, or "bars" side by side.
        categories: names of the bars' x values.
        y_limits: of the axis; from the values if None.
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
class EvaluationReport:
    """The figures {run: {figure: value}} of one verb, further details for the JSON, and plots."""

    verb: str
    figures: Figures
    details: Mapping[str, Any] = field(default_factory=dict)
    charts: Sequence[Chart] = ()

    def make_rows(self) -> list[dict[str, Any]]:
        """Return one row per figure with one column per run; NaN if a run lacks the figure."""
        names = dict.fromkeys(name for figures in self.figures.values() for name in figures)
        return [
            {"figure": name} | {run: figures.get(name, float("nan")) for run, figures in self.figures.items()}
            for name in names
        ]

    def emit(self, arguments: argparse.Namespace) -> None:
        """Write the files into `--out`, if given, and print the table or, with `--json`, the figures."""
        print(format_json(self.figures) if arguments.json else format_table(self.make_rows()))
        if arguments.out is not None:
            self.write(arguments.out)

    def write(self, folder: Path) -> None:
        """Write `<verb>.json`, `.csv`, and `<verb>-<chart>.png` and `.svg`; the same figures give the same bytes.

        InputError if the extra `report` is missing, when all but the plots is written.
        """
        make_out_folder(folder)
        write_json(folder / f"{self.verb}.json", {"figures": self.figures, **self.details})
        write_csv(folder / f"{self.verb}.csv", self.make_rows())
        for chart in self.charts:
            if chart.lines:
                draw_chart(chart, folder / f"{self.verb}-{chart.name}")


def add_arguments(parser: argparse.ArgumentParser, verb: str) -> None:
    """Add the flags of the output."""
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder for {verb}.json, {verb}.csv and the plots")
    parser.add_argument("--json", action="store_true", help="print {run: {figure: value}} as JSON instead of the table")


def name_runs(paths: Sequence[Path]) -> list[str]:
    """Return a short name per run: the file's stem; with its folder if stems are alike; else the whole path.

    InputError if a run is given twice.
    """
    if len({path.absolute() for path in paths}) < len(paths):
        raise InputError("a run is named twice; name every run once")
    for make in (lambda path: path.stem, lambda path: f"{path.parent.name}/{path.stem}", str):
        names = [make(path) for path in paths]
        if len(set(names)) == len(names):
            break
    return names


def draw_chart(chart: Chart, base: Path) -> None:
    """Draw a chart into `base`.png and `base`.svg."""
    with needing_extra("report", "a plot"):
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    settings = {"svg.hashsalt": "flowing_puppet_ros", "svg.fonttype": "none", "font.size": 9, "axes.axisbelow": True}
    with matplotlib.rc_context(settings):
        figure = Figure((WIDTH_IN, HEIGHT_IN), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        _draw_lines(axes, chart)
        axes.set(xlabel=chart.x_label, ylabel=chart.y_label, ylim=chart.y_limits)
        axes.set_title(chart.title, loc="left", fontsize=10)
        axes.grid(color="0.88", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(frameon=False, fontsize=8, loc="outside lower left", ncols=2)
        figure.savefig(f"{base}.png", metadata={"Software": None})
        figure.savefig(f"{base}.svg", metadata={"Date": None, "Creator": None})


def _draw_lines(axes: Any, chart: Chart) -> None:
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
