# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet bench`: that every part measures what it says, not how fast this machine is."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import peer_runs, scenes, speed, stages, streams
from benchmarks.verb import PARTS
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evidence.cloud.nearest import NearestPoints


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes at which every part takes a moment."""
    monkeypatch.setattr(speed, "LOOK_UPS", 2000)
    monkeypatch.setattr(speed, "BASE", {"points": 500, "particles": 4, "iterations": 1})
    monkeypatch.setattr(speed, "GROWTH", {"points": (400, 500), "iterations": (1, 2)})
    monkeypatch.setattr(speed, "PLAIN_SIZE", (4, 1))
    monkeypatch.setattr(speed, "TRACKED_POINTS", 600)
    monkeypatch.setattr(speed, "TRACKED_FRAMES", 2)
    monkeypatch.setattr(streams, "SIZES", ((160, 120), (200, 150)))
    monkeypatch.setattr(streams, "PEOPLE", (1, 2))
    monkeypatch.setattr(streams, "MIDDLE", (200, 150))
    monkeypatch.setattr(streams, "FRAMES", 3)


@pytest.mark.slow
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


@pytest.mark.slow
def test_growth_changes_one_size_at_a_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "growth", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["growth"]
    assert [(row["points"], row["iterations"]) for row in rows] == [(400, 1), (500, 1), (500, 1), (500, 2)]
    assert all(row["search_seconds"] > 0 for row in rows)


def test_tracking_is_measured_without_the_first_search(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any, **_: Any) -> BodyFit:
        searched.append(viewpoint is None)
        return fitter.assess(made._body, fitter.prepare_cloud(points, normals, viewpoint))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    made = speed.Bench()
    rows = made.measure_tracking()
    assert [row["sides"] for row in rows] == ["all", "one"]
    assert [row["searched"] for row in rows] == [1, 1]
    assert searched == [True, False]
    assert all(row["milliseconds_a_frame"] > 0 for row in rows)


@pytest.mark.slow
def test_the_stages_of_a_tracked_cloud_and_of_a_fit_make_up_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "TRACKED_FRAMES", 3)
    monkeypatch.setattr(speed, "STAGE_FITS", 2)
    query = NearestPoints.query
    rows = speed.Bench().measure_stages()
    assert NearestPoints.query is query, "what was measured is as it was"
    for path in ("tracked, all sides", "tracked, one side", "whole fit", "one-sided fit"):
        own = [row for row in rows if row["path"] == path]
        assert sum(row["percent"] for row in own) == pytest.approx(100)
        assert {"normal equations", "hands"} & {row["stage"] for row in own}
        assert all(row["milliseconds"] > -0.1 for row in own)


@pytest.mark.slow
def test_the_stages_of_a_scan_are_those_of_everybody_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("open3d")
    monkeypatch.setattr(scenes, "SCANS", 2)
    monkeypatch.setattr(scenes, "PEOPLE", 2)
    monkeypatch.setattr(scenes, "RANGE_M", (5.0, 6.0))
    rows = scenes.measure_scene(0)
    assert {row["points"] for row in rows} == {scenes.POINTS} and {row["people"] for row in rows} == {2}
    for path, stage in (("first scan", "new bodies"), ("tracked", "tracked bodies")):
        spent = {str(row["stage"]): float(row["percent"]) for row in rows if row["path"] == path}
        assert sum(spent.values()) == pytest.approx(100)
        assert spent[stage] > spent["filter"] > 0


def test_a_stage_does_not_count_the_stages_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(stages.time, "process_time", lambda: now[0])

    class Work:
        def outer(self) -> int:
            now[0] += 2
            return self.inner()

        def inner(self) -> int:
            now[0] += 5
            return 7

    with stages.measure_stages({"outer": [(Work, "outer")], "inner": [(Work, "inner")]}) as spent:
        assert Work().outer() == 7
        now[0] += 3
    assert spent == {"outer": 2, "inner": 5, stages.REST: 3}


def test_images_are_measured_by_size_and_people_who_are_all_tracked(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "images", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["images"]
    assert [(row["width"], row["people"]) for row in rows] == [(160, 1), (200, 1), (200, 2)]
    assert all(row["tracked"] == row["people"] and row["milliseconds_an_image"] > 0 for row in rows)


def test_a_fit_is_compared_with_gradients_at_equal_time_and_at_equal_error() -> None:
    curve = np.array([[1.0, 0.30], [2.0, 0.10], [4.0, 0.04], [9.0, 0.02]])
    row = peer_runs.compare_curve(0.05, 3.0, curve)
    assert row["gradient_cm_then"] == pytest.approx(10)
    assert row["gradient_seconds_as_good"] == 4.0
    assert row["gradient_cm_end"] == pytest.approx(2)
    assert peer_runs.compare_curve(0.01, 0.5, curve)["gradient_seconds_as_good"] == float("inf")
    assert np.isnan(peer_runs.compare_curve(0.01, 0.5, curve)["gradient_cm_then"])


def test_a_peer_is_installed_once_and_speaks_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "echo.py").write_text("import json, sys\nprint('noise')\nprint(json.dumps(sys.argv[1:]))\n")
    (tmp_path / "fail.py").write_text("raise SystemExit('no such thing')\n")
    monkeypatch.setattr(peer_runs, "SCRIPTS", tmp_path)
    calls: list[list[str]] = []
    really = peer_runs._run

    def run(command: list[str]) -> str:
        calls.append(command)
        return really(command)

    monkeypatch.setattr(peer_runs, "_run", run)
    (tmp_path / "echo" / "bin").mkdir(parents=True)
    (tmp_path / "echo" / "bin" / "python").symlink_to(sys.executable)
    (tmp_path / "echo" / "installed").write_text("()")
    assert peer_runs.Peer("echo", "echo.py", ()).run(tmp_path, "a", "b") == ["a", "b"]
    assert len(calls) == 1
    (tmp_path / "fail").symlink_to(tmp_path / "echo")
    with pytest.raises(PuppetError, match="no such thing"):
        peer_runs.Peer("fail", "fail.py", ()).run(tmp_path)
    with pytest.raises(InputError, match="source tree"):
        peer_runs.Peer("echo", "gone.py", ()).run(tmp_path)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["gradient", "--count", "0"], "--count is 0"),
        (["gradient", "--seed", "-1"], "--seed is -1"),
        (["mediapipe"], "--clips and --truth"),
    ],
)
def test_unusable_arguments_of_peers_are_named(
    flags: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "peers", *flags]) == 2
    assert named in capsys.readouterr().err


def test_tables_are_headed_by_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "look-ups"]) == 0
    assert capsys.readouterr().out.startswith("look-ups: Measure closest points by the grid")


@pytest.mark.parametrize(
    ("flags", "named"), [(["nothing"], "'nothing' is not a part"), (["--seed", "-2"], "--seed is -2")]
)
def test_unusable_arguments_are_named(flags: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *flags]) == 2
    assert named in capsys.readouterr().err


def test_the_parts_are_the_benchs_own() -> None:
    measured = [name for name in vars(speed.Bench) if not name.startswith("_")]
    assert ["measure_" + part.replace("-", "_") for part in PARTS] == measured
