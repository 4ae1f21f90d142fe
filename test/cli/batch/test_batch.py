# SPDX-License-Identifier: Apache-2.0
"""Many inputs of `fit` and `replay`: in order, in processes, resumed, on a cluster, failures reported and skipped."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from batch_work import Plan, work  # type: ignore[import-not-found]
from distributed import Client

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.cli.batch.cluster import run_on_cluster
from flowing_puppet_ros.cli.batch.processes import run_in_processes
from flowing_puppet_ros.cli.batch.task import BatchTask
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

FAST = ["--particles", "4", "--iterations", "2", "--restarts", "0", "--max-limb-repairs", "0", "--levenberg-steps", "1"]
FAST += ["--gauss-newton-steps", "3", "--max-points", "800", "--no-nonrigid", "--up", "z", "--unit", "m"]
BAGS = 5
ROOT = Path(__file__).resolve().parents[3]
GOLDEN = ROOT / "bags" / "golden" / "golden.mcap"


def write_scans(folder: Path, count: int) -> Path:
    """Write clouds of one standing person at several places, and one without a point."""
    folder.mkdir()
    model = StitchedPuppet.load()
    vertices = model.vertices(model.rest_state())
    for k in range(count):
        np.save(folder / f"person{k}.npy", vertices + np.array([0.1 * k, 0.0, 1.0]))
    np.save(folder / "nothing.npy", np.empty((0, 3)))
    return folder


def write_bags(folder: Path, names: Sequence[str]) -> Path:
    """Write identical bags of the first camera of the golden bag."""
    folder.mkdir()
    with open_bag(GOLDEN) as bag, BagWriter(folder / f"{names[0]}.mcap") as writer:
        topics = [name for name in bag.topics if name.startswith("/cam1/")]
        for name in topics:
            writer.add_topic(name, bag.topics[name], bag.details[name].qos)
        for record in bag.messages(topics):
            writer.write_raw(record.topic, record.log_time, record.raw)
    for name in names[1:]:
        (folder / f"{name}.mcap").write_bytes((folder / f"{names[0]}.mcap").read_bytes())
    return folder


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, list[dict[str, Any]], str]:
    """Return the exit status, the JSON objects and the text on stderr."""
    status = main([*map(str, words), "--json"])
    output = capsys.readouterr()
    return status, [json.loads(line) for line in output.out.splitlines()], output.err


def contents(folder: Path) -> dict[str, Any]:
    """Return every result in a folder; of a fit, all but its time."""
    found: dict[str, Any] = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".npz"}
    for path in folder.glob("*.npz"):
        with np.load(path) as arrays:
            found[path.name] = {key: arrays[key].tobytes() for key in arrays.files if key != "seconds"}
    return {name: value for name, value in found.items() if not name.endswith(".jsonl")}


def test_a_folder_is_fitted_in_processes_as_one_by_one_and_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scans = write_scans(tmp_path / "scans", 2)
    serial, parallel = tmp_path / "serial", tmp_path / "parallel"
    status, summaries, said = run(capsys, "fit", scans, "--out", serial, "--jobs", "1", *FAST)
    assert status == 1
    assert [Path(summary["input"]).stem for summary in summaries] == ["nothing", "person0", "person1"]
    assert "points" in summaries[0]["error"] and summaries[0]["error"] in said
    assert f"1 of 3 inputs failed: {scans / 'nothing.npy'}" in said
    status, others, _ = run(capsys, "fit", scans, "--out", parallel, "--jobs", "2", *FAST)
    assert status == 1 and [one["input"] for one in others] == [one["input"] for one in summaries]
    assert len(contents(serial)) == 4 and contents(serial) == contents(parallel)

    (parallel / "person1.ply").unlink()
    stamps = {path: path.stat().st_mtime_ns for path in parallel.glob("*.npz")}
    status, again, said = run(capsys, "fit", scans, "--out", parallel, *FAST)
    assert status == 1 and "1 finished inputs are skipped" in said
    assert again[1] == others[1] and again[2]["output"] == others[2]["output"]
    changed = {path.stem for path, stamp in stamps.items() if path.stat().st_mtime_ns != stamp}
    assert changed == {"person1"} and contents(parallel) == contents(serial)


def test_other_settings_a_changed_input_and_again_are_worked_on_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scans = write_scans(tmp_path / "scans", 1)
    (scans / "nothing.npy").unlink()
    words: list[str | Path] = ["fit", scans, "--out", tmp_path / "out", *FAST]
    assert run(capsys, *words)[0] == 0
    ledger = tmp_path / "out" / "fit.jsonl"
    ledger.write_text(ledger.read_text() + '\n{"key": "cut o')
    assert "1 finished inputs are skipped" in run(capsys, *words)[2]
    assert "skipped" not in run(capsys, *words, "--seed", "1")[2]
    assert "skipped" not in run(capsys, *words)[2], "the other seed's result stands there now"
    assert "skipped" not in run(capsys, *words, "--again")[2]
    np.save(scans / "person0.npy", np.load(scans / "person0.npy")[::2])
    assert "skipped" not in run(capsys, *words)[2]
    assert "1 finished inputs are skipped" in run(capsys, *words)[2]


def test_bags_of_a_folder_are_replayed_as_one_by_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags, one = tmp_path / "bags", tmp_path / "one" / "good.mcap"
    write_bags(bags, ["good"])
    (bags / "cut.mcap").write_bytes((bags / "good.mcap").read_bytes()[:20_000])
    words: list[str | Path] = ["replay", bags, "--out", tmp_path / "out", "--report", tmp_path / "reports"]
    status, (cut, good), said = run(capsys, *words)
    assert status == 1 and "1 of 2 inputs failed" in said and "--salvage" in cut["error"]
    assert Path(good["output"]) == tmp_path / "out" / "good.mcap"
    assert Path(good["report"]) == tmp_path / "reports" / "good.html" and Path(good["report"]).is_file()
    assert run(capsys, "replay", bags / "good.mcap", "--out", one)[0] == 0
    assert (tmp_path / "out" / "good.mcap").read_bytes() == one.read_bytes()
    assert "1 finished inputs are skipped" in run(capsys, *words)[2]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["fit", "a/x.ply", "b/x.npz", "--out", "o"], "two inputs are called 'x'"),
        (["fit", "a.ply", "b.ply", "--out", "o", "--jobs", "0"], "--jobs is 0"),
        (["fit", "empty", "--out", "o"], "has no scan"),
        (["fit", "scan.npz", "--out", "."], "would overwrite it"),
        (["fit", "a.ply", "--out", "o", "--scheduler", "tcp://127.0.0.1:9"], "no Dask scheduler answers"),
        (["replay", "a.mcap", "b.mcap", "--out", "o.mcap"], "need a folder"),
    ],
)
def test_unusable_arguments_are_one_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flowing_puppet_ros.cli.batch.cluster.CONNECT_TIMEOUT_S", 1.0)
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "scan.npz", points=np.zeros((9, 3)))
    assert main(words) == 2
    assert sentence in capsys.readouterr().err


def test_a_process_that_dies_takes_no_other_input_with_it(tmp_path: Path) -> None:
    names = ["a", "dies", "b", "unusable", "dies_once", "broken", "c"]
    tasks = [BatchTask(work, tmp_path / "inputs" / name, Plan(tmp_path)) for name in names]
    answers = dict(run_in_processes(tasks, 2))
    assert sorted(answers) == list(range(len(names)))
    errors = {names[index]: found.error for index, found in answers.items() if found.error}
    assert set(errors) == {"dies", "unusable", "broken"}
    assert "by signal 9" in errors["dies"] and errors["unusable"] == "it is unusable"
    assert errors["broken"].endswith("broken failed: ZeroDivisionError: oh")
    done = [found.summary for found in answers.values() if not found.error]
    assert os.getpid() not in {summary["process"] for summary in done}
    assert {summary["threads"] for summary in done} == {"1"}


@contextmanager
def started(*words: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a program that is killed at the end."""
    paths = os.pathsep.join([str(ROOT / "test" / "helpers"), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths, "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", *map(str, words)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def wait(holds: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come to hold"
        time.sleep(0.02)


@contextmanager
def cluster(place: Path) -> Iterator[str]:
    """Start a scheduler without workers that writes its address to `place`; return the address."""
    options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", place)
    with started("dask", "scheduler", *options):
        wait(lambda: place.exists() and place.read_text().endswith("}"))
        yield str(json.loads(place.read_text())["address"])


def worker(place: Path) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """Start a worker of the scheduler whose address is at `place`."""
    local = ("--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", place)
    return started("dask", "worker", "--nthreads", "1", "--no-nanny", *local)


def test_all_results_arrive_although_a_worker_is_killed(tmp_path: Path) -> None:
    bags = write_bags(tmp_path / "bags", [f"bag{k}" for k in range(BAGS)])
    done = tmp_path / "out"
    place = tmp_path / "scheduler.json"
    with cluster(place) as address, worker(place) as doomed, worker(place), ExitStack() as stack:
        batch = stack.enter_context(
            started("flowing_puppet_ros", "replay", bags, "--out", done, "--scheduler", address)
        )
        wait(lambda: any(done.glob("*.mcap")))
        doomed.kill()
        assert len(list(done.glob("*.mcap"))) < BAGS, "the worker was to be killed in the middle"
        assert batch.wait(120) == 0
    assert main(["replay", str(bags), "--out", str(tmp_path / "serial"), "--jobs", "1"]) == 0
    assert len(contents(done)) == BAGS and contents(done) == contents(tmp_path / "serial")


def test_results_that_die_with_their_worker_are_made_again(tmp_path: Path) -> None:
    names = [f"leaves_a_mark{k}" for k in range(6)]
    tasks = [BatchTask(work, Path(name), Plan(tmp_path)) for name in names]
    place = tmp_path / "scheduler.json"
    with cluster(place) as address, worker(place) as dead:
        answers = run_on_cluster(tasks, address)
        first, found = next(answers)
        wait(lambda: all((tmp_path / name).exists() for name in names))
        dead.kill()
        with Client(address) as client:
            wait(lambda: not client.scheduler_info()["workers"])
        time.sleep(0.5)  # until the other client was told of it too
        with worker(place) as other:
            rest = dict(answers)
    assert sorted([first, *rest]) == list(range(len(names))) and found.summary["process"] == dead.pid
    assert {late.summary["process"] for late in rest.values()} <= {dead.pid, other.pid}
    assert other.pid in {late.summary["process"] for late in rest.values()}


def test_a_cluster_without_workers_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = write_scans(tmp_path / "scans", 1)
    monkeypatch.setattr("flowing_puppet_ros.cli.batch.cluster.MAX_IDLE_S", 0.3)
    with cluster(tmp_path / "scheduler.json") as address:
        assert main(["fit", str(scans), "--out", str(tmp_path / "out"), "--scheduler", address, *FAST]) == 1
