# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet bench`: that every part measures what it says, not how fast this machine is."""

import json
from typing import Any

import pytest

from flowing_puppet_ros.body.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.cli.bench import PARTS
from flowing_puppet_ros.evaluate import bench


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes at which every part takes a moment."""
    monkeypatch.setattr(bench, "LOOK_UPS", 2000)
    monkeypatch.setattr(bench, "BASE", {"points": 500, "particles": 4, "iterations": 1})
    monkeypatch.setattr(bench, "GROWTH", {"points": (400, 500), "iterations": (1, 2)})
    monkeypatch.setattr(bench, "PLAIN_SIZE", (4, 1))
    monkeypatch.setattr(bench, "TRACKED_POINTS", 600)
    monkeypatch.setattr(bench, "TRACKED_FRAMES", 2)


def test_each_step_is_compared_with_the_plain_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "look-ups", "steps", "search", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures) == ["look-ups", "steps", "search"]
    for row in figures["steps"] + figures["search"]:
        assert row["ratio"] == pytest.approx(row["plain_milliseconds"] / row["milliseconds"])
        assert row["milliseconds"] > 0
    looked = figures["look-ups"][0]
    assert looked["ratio"] == pytest.approx(looked["grid_millions_a_second"] / looked["tree_millions_a_second"])
    assert 0 <= looked["grid_too_far_mm"] < 25


def test_growth_changes_one_size_at_a_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "growth", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["growth"]
    assert [(row["points"], row["iterations"]) for row in rows] == [(400, 1), (500, 1), (500, 1), (500, 2)]
    assert all(row["search_seconds"] > 0 for row in rows)


def test_tracking_is_measured_without_the_first_search(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any, **_: Any) -> BodyFit:
        searched.append(viewpoint is None)
        return fitter.result(made._body, fitter.cloud(points, normals, viewpoint))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    made = bench.Bench()
    rows = made.tracking()
    assert [row["sides"] for row in rows] == ["all", "one"]
    assert [row["searched"] for row in rows] == [1, 1]
    assert searched == [True, False]
    assert all(row["milliseconds_a_frame"] > 0 for row in rows)


def test_tables_are_headed_by_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "look-ups"]) == 0
    assert capsys.readouterr().out.startswith("look-ups: Closest points by the grid")


@pytest.mark.parametrize(
    ("flags", "named"), [(["nothing"], "'nothing' is no part"), (["--seed", "-2"], "--seed is -2")]
)
def test_unusable_arguments_are_named(flags: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *flags]) == 2
    assert named in capsys.readouterr().err


def test_the_parts_are_the_benchs_own() -> None:
    measured = [name for name in vars(bench.Bench) if not name.startswith("_")]
    assert [part.replace("-", "_") for part in PARTS] == measured
