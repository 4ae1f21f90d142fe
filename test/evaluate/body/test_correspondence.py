# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate correspondence` on meshes whose correspondence is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scan import write_ply
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.evaluate.body.correspondence import (
    PairError,
    cumulative_percent,
    pair_scans,
    read_fitted_scans,
    summarise,
)
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

UNIT = 0.01  # metres: the meshes are in centimetres


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


def _write(folder: Path, model: StitchedPuppet, name: str, state: BodyState) -> None:
    """Write a mesh in centimetres and its fit."""
    (folder / "scans").mkdir(exist_ok=True)
    (folder / "fits").mkdir(exist_ok=True)
    vertices = model.vertices(state)
    write_ply(folder / "scans" / f"{name}.ply", vertices / UNIT, model.faces, None)
    np.savez(
        folder / "fits" / f"{name}.npz",
        vertices=(vertices / UNIT).astype(np.float32),
        all_shape_coefficients=state.shape.astype(np.float32),
        model=model.name,
    )


@pytest.fixture
def people(tmp_path: Path, model: StitchedPuppet) -> Path:
    """Two people in two poses each."""
    for person in range(2):
        states = [model.sample(np.random.default_rng(seed)) for seed in (10 + person, 20 + person)]
        for pose, state in enumerate(states):
            _write(tmp_path, model, f"tr_reg_0{person}{pose}", replace(state, shape=states[0].shape))
    return tmp_path


def _run(folder: Path, *flags: str) -> int:
    return main(["evaluate", "correspondence", str(folder / "scans"), "--fits", str(folder / "fits"), *flags])


@pytest.mark.slow
def test_true_fits_give_true_correspondence(people: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(people, "--pairs", "all", "--json", "--out", str(people / "out")) == 0
    runs = json.loads(capsys.readouterr().out)
    figures = runs["fits"]
    assert (figures["intra pairs"], figures["inter pairs"]) == (4, 8)
    assert figures["intra mean_cm"] < 0.05
    assert figures["inter mean_cm"] < 0.05
    written = json.loads((people / "out" / "correspondence.json").read_text())
    assert written["figures"] == runs
    assert written["cumulative_percent"]["fits"]["intra"][-1] > 99
    assert sum(written["histogram_percent"]["fits"]["inter"]) == pytest.approx(100)
    assert [len(written["pairs"]["fits"][kind]) for kind in ("intra", "inter")] == [4, 8]
    assert len((people / "out" / "correspondence.csv").read_text().splitlines()) == 1 + len(figures)
    for chart in ("cumulative", "histogram"):
        assert (people / "out" / f"correspondence-{chart}.png").is_file()
        assert (people / "out" / f"correspondence-{chart}.svg").is_file()


def test_errors_are_in_the_unit_of_the_fit(tmp_path: Path, model: StitchedPuppet) -> None:
    state = model.rest_state()
    _write(tmp_path, model, "anna0", state)
    _write(tmp_path, model, "anna1", state)
    scans, _ = read_fitted_scans(tmp_path / "scans", tmp_path / "fits", None)
    assert scans[0].subject == "anna"
    assert scans[0].metres == pytest.approx(UNIT, rel=1e-4)
    assert scans[0].stature == pytest.approx(np.ptp(model.vertices(state)[:, 2]), rel=1e-6)


def test_a_crossed_fit_is_seen(tmp_path: Path, model: StitchedPuppet, capsys: pytest.CaptureFixture[str]) -> None:
    _write(tmp_path, model, "anna0", model.rest_state())
    _write(tmp_path, model, "anna1", model.rest_state())
    fit = dict(np.load(tmp_path / "fits" / "anna1.npz"))
    np.savez(tmp_path / "fits" / "anna1.npz", **fit | {"vertices": fit["vertices"][model.mirror_vertex]})
    assert _run(tmp_path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["fits"]["intra mean_percent_of_stature"] > 5


@pytest.mark.slow
def test_vertex_lists_name_the_common_points(
    people: Path, model: StitchedPuppet, capsys: pytest.CaptureFixture[str]
) -> None:
    common, turned = np.array([4, 3000, 2000]), np.array([3000, 4, 2000])
    for person in range(2):
        for pose in range(2):
            path = people / f"tr_reg_0{person}{pose}.vts"
            np.savetxt(path, (common if (person, pose) != (1, 1) else turned) + 1, fmt="%d")
    assert _run(people, "--vts", str(people), "--json", "--subject", r"tr_reg_0(\d)") == 0
    figures = json.loads(capsys.readouterr().out)["fits"]
    assert figures["intra worst_pair_cm"] > 5
    assert figures["intra median_pair_cm"] < figures["intra worst_pair_cm"]
    path.write_text("0\n")
    assert _run(people, "--vts", str(people)) == 2
    assert "numbers from 1 to" in capsys.readouterr().err


def test_pairs_with_the_first(people: Path) -> None:
    scans, _ = read_fitted_scans(people / "scans", people / "fits", None)
    intra = [(a.name, b.name) for a, b in pair_scans(scans, every=False, inter=False)]
    assert intra == [("tr_reg_001", "tr_reg_000"), ("tr_reg_011", "tr_reg_010")]
    inter = [(a.name, b.name) for a, b in pair_scans(scans, every=False, inter=True)]
    assert ("tr_reg_001", "tr_reg_010") in inter
    assert len(inter) == 4


def test_figures_of_known_errors() -> None:
    pairs = [
        PairError("a", "b", True, np.array([0.0, 0.01, 0.03]), 2.0),
        PairError("c", "b", True, np.full(3, 0.06), 2.0),
    ]
    figures = summarise(pairs)
    assert figures["mean_cm"] == pytest.approx((4 / 3 + 6) / 2)
    assert figures["worst_percent_of_stature"] == pytest.approx(3)
    assert figures["share_within_2_cm"] == pytest.approx(2 / 6)
    np.testing.assert_allclose(cumulative_percent(pairs, np.array([0.0, 0.03, 0.1])), [100 / 6, 50, 100])


@pytest.mark.parametrize(
    ("flags", "spoil", "sentence"),
    [
        ([], "fits/tr_reg_000.npz", "not a fit; make one with"),
        (["--subject", "(x)"], None, "finds no subject"),
        (["--subject", "("], None, "not a regular expression"),
        (["--vts", "nowhere"], None, "cannot be read as vertex numbers"),
    ],
)
def test_unusable_input_is_named(
    people: Path, flags: list[str], spoil: str | None, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if spoil is not None:
        (people / spoil).write_bytes(b"nothing")
    assert _run(people, *flags) == 2
    assert sentence in capsys.readouterr().err


def test_a_folder_needs_two_meshes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(tmp_path) == 2
    assert "a pair needs two" in capsys.readouterr().err
