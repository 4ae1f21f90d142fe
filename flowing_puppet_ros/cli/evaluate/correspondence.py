# SPDX-License-Identifier: Apache-2.0
"""Scans mapped to each other through their fits, where the truth is known; several sets of fits side by side.

The protocol of FAUST: every vertex of a scan is mapped to the model and on to another scan, of the same person (intra)
and of other people (inter); the error is its distance from its true position there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.correspondence import (
    SUBJECT_PATTERN,
    PairError,
    cumulative_percent,
    measure_pair,
    pair_scans,
    read_fitted_scans,
    summarise,
)
from flowing_puppet_ros.evaluate.output import Chart, EvaluationReport, Figures, Line, name_runs
from flowing_puppet_ros.evaluate.output import add_arguments as add_output

LIMITS_M = np.linspace(0, 0.15, 301)  # of the cumulative curve
BINS_M = np.linspace(0, 0.15, 31)  # edges of the histogram

Groups = dict[str, list[PairError]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `flowing-puppet evaluate correspondence`."""
    parser.add_argument("scans", type=Path, metavar="FOLDER", help="meshes in vertex correspondence, like FAUST's")
    parser.add_argument(
        "--fits",
        nargs="+",
        type=Path,
        required=True,
        metavar="DIR",
        help="folders written by `fit FOLDER --out DIR`, one per run",
    )
    parser.add_argument("--vts", type=Path, metavar="DIR", help="the meshes correspond by STEM.vts, like TOSCA's")
    parser.add_argument(
        "--subject", default=SUBJECT_PATTERN, metavar="REGEX", help="its group names a mesh's person [%(default)s]"
    )
    parser.add_argument("--pairs", choices=("first", "all"), default="first", help="each with a person's first [first]")
    add_output(parser, "correspondence")


def run(arguments: argparse.Namespace) -> int:
    """Measure the pairs of every run, print the figures and return the exit status."""
    names = name_runs(arguments.fits)
    runs = {name: _measure_run(fits, arguments) for name, fits in zip(names, arguments.fits, strict=True)}
    figures: Figures = {
        name: {f"{kind} {key}": value for kind, pairs in groups.items() for key, value in summarise(pairs).items()}
        for name, groups in runs.items()
    }
    EvaluationReport("correspondence", figures, _make_details(runs), _make_charts(runs)).emit(arguments)
    return 0


def _measure_run(fits: Path, arguments: argparse.Namespace) -> Groups:
    scans, faces = read_fitted_scans(arguments.scans, fits, arguments.vts, arguments.subject)
    chosen = [pair for inter in (False, True) for pair in pair_scans(scans, arguments.pairs == "all", inter)]
    if not chosen:
        raise InputError(f"no two meshes of {arguments.scans} make a pair; check --subject")
    bar = tqdm(chosen, desc=fits.name, file=sys.stderr, disable=arguments.json, unit="pair")
    errors = [measure_pair(a, b, faces) for a, b in bar]
    groups = {"intra": [pair for pair in errors if pair.intra], "inter": [pair for pair in errors if not pair.intra]}
    return {name: pairs for name, pairs in groups.items() if pairs}


def _make_details(runs: dict[str, Groups]) -> dict[str, Any]:
    """Return the figures of each pair, and the curves."""

    def each(values: Sequence[PairError]) -> list[dict[str, Any]]:
        return [
            {
                "first": pair.first,
                "second": pair.second,
                "mean_cm": 100 * float(pair.error.mean()),
                "median_cm": 100 * float(np.median(pair.error)),
                "worst_cm": 100 * float(pair.error.max()),
            }
            for pair in values
        ]

    return {
        "pairs": {run: {kind: each(pairs) for kind, pairs in groups.items()} for run, groups in runs.items()},
        "limits_cm": (100 * LIMITS_M).tolist(),
        "cumulative_percent": {
            run: {kind: cumulative_percent(pairs, LIMITS_M).tolist() for kind, pairs in groups.items()}
            for run, groups in runs.items()
        },
        "histogram_cm": (100 * BINS_M).tolist(),
        "histogram_percent": {
            run: {kind: _make_histogram(pairs).tolist() for kind, pairs in groups.items()}
            for run, groups in runs.items()
        },
    }


def _make_histogram(pairs: Sequence[PairError]) -> np.ndarray:
    """Return the percentage (30,) of all points whose error lies in each bin."""
    errors = np.concatenate([pair.error for pair in pairs])
    return 100 * np.histogram(errors, BINS_M)[0] / len(errors)


def _make_charts(runs: dict[str, Groups]) -> list[Chart]:
    labelled = [
        (kind, pairs, run if len(runs) > 1 else "") for run, groups in runs.items() for kind, pairs in groups.items()
    ]
    curves = [Line(kind, 100 * LIMITS_M, cumulative_percent(pairs, LIMITS_M), run) for kind, pairs, run in labelled]
    centres = 100 * (BINS_M[1:] + BINS_M[:-1]) / 2
    bars = [Line(kind, centres, _make_histogram(pairs), run) for kind, pairs, run in labelled]
    title = "Correspondence of scans through the model"
    return [
        Chart("cumulative", title, "error, cm", "points within, %", curves, y_limits=(0, 100)),
        Chart("histogram", title, "error, cm", "points, %", bars, "steps"),
    ]
