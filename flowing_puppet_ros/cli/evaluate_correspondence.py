# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate correspondence`: scans mapped to each other through their fits, where the truth is known."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.correspondence import (
    SUBJECT,
    PairError,
    cumulative,
    pair_error,
    read_fitted,
    scan_pairs,
    summary,
)
from flowing_puppet_ros.evaluate.tables import json_text, text_table, write_csv, write_json
from flowing_puppet_ros.settings import make_out_folder
from flowing_puppet_ros.view.page import page, paragraph, table
from flowing_puppet_ros.view.plots import Series, line_plot

LIMITS = np.linspace(0, 0.15, 301)  # metres, of the cumulative curve
BINS = np.linspace(0, 0.15, 31)  # metres, of the histogram


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate correspondence`."""
    parser.add_argument("scans", type=Path, metavar="FOLDER", help="meshes in vertex correspondence, as FAUST's are")
    parser.add_argument("--fits", type=Path, required=True, metavar="DIR", help="what `fit FOLDER/* --out DIR` wrote")
    parser.add_argument("--vts", type=Path, metavar="DIR", help="the meshes correspond by STEM.vts, as TOSCA's do")
    parser.add_argument(
        "--subject", default=SUBJECT, metavar="REGEX", help="its group names a mesh's person [%(default)s]"
    )
    parser.add_argument("--pairs", choices=("first", "all"), default="first", help="each with a person's first [first]")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for correspondence.html, .csv and .json")
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Measure the pairs, print the figures and return the exit status."""
    scans, faces = read_fitted(arguments.scans, arguments.fits, arguments.vts, arguments.subject)
    if arguments.out is not None:
        make_out_folder(arguments.out)
    chosen = [pair for inter in (False, True) for pair in scan_pairs(scans, arguments.pairs == "all", inter)]
    if not chosen:
        raise InputError(f"no two meshes of {arguments.scans} make a pair; check --subject")
    bar = tqdm(chosen, file=sys.stderr, disable=arguments.json, unit="pair")
    errors = [pair_error(a, b, faces) for a, b in bar]
    groups = {"intra": [pair for pair in errors if pair.intra], "inter": [pair for pair in errors if not pair.intra]}
    groups = {name: pairs for name, pairs in groups.items() if pairs}
    figures = {name: summary(pairs) for name, pairs in groups.items()}
    if arguments.out is not None:
        _write(arguments.out, groups, figures)
    rows = [{"kind": name} | row for name, row in figures.items()]
    print(json_text(figures) if arguments.json else text_table(rows))
    return 0


def _write(folder: Path, groups: dict[str, list[PairError]], figures: dict[str, dict[str, float]]) -> None:
    rows = [
        {
            "first": pair.first,
            "second": pair.second,
            "kind": name,
            "mean_cm": 100 * float(pair.error.mean()),
            "median_cm": 100 * float(np.median(pair.error)),
            "worst_cm": 100 * float(pair.error.max()),
        }
        for name, pairs in groups.items()
        for pair in pairs
    ]
    write_csv(folder / "correspondence.csv", rows)
    curves = {name: cumulative(pairs, LIMITS) for name, pairs in groups.items()}
    counts = {name: np.diff(cumulative(pairs, BINS)) for name, pairs in groups.items()}
    written = {
        "summary": figures,
        "limits_cm": (100 * LIMITS).tolist(),
        "cumulative_percent": {name: curve.tolist() for name, curve in curves.items()},
        "histogram_cm": (100 * BINS).tolist(),
        "histogram_percent": {name: count.tolist() for name, count in counts.items()},
    }
    write_json(folder / "correspondence.json", written)
    lines = [Series(name, 100 * LIMITS, curve) for name, curve in curves.items()]
    bars = [Series(name, 100 * (BINS[1:] + BINS[:-1]) / 2, count) for name, count in counts.items()]
    html = page(
        "Correspondence through the Stitched Puppet",
        paragraph("Every point of a scan mapped to another scan, against its true place there."),
        [
            ("Figures", _table(figures)),
            ("Cumulative error", line_plot(lines, "cumulative error", "error, cm", "points within, %")),
            ("Histogram", line_plot(bars, "histogram", "error, cm", "points, %")),
        ],
    )
    (folder / "correspondence.html").write_text(html, encoding="utf-8")


def _table(figures: dict[str, dict[str, float]]) -> str:
    heads = ["kind", *(name.replace("_", " ") for name in next(iter(figures.values())))]
    rows = [[kind, *(f"{value:.4g}" for value in row.values())] for kind, row in figures.items()]
    return table(heads, rows, range(1, len(heads)), "Means over pairs; distances in centimetres.")
