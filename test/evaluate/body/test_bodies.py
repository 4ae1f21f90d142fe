# SPDX-License-Identifier: Apache-2.0
"""Scores of fitted bodies against synthetic people, and `flowing-puppet evaluate bodies`."""

import csv
import json
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.evaluate.body.bodies import draw_scans, find_visible_vertices, is_flipped, score_fit, summarise
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import RaycastScene, make_box
from flowing_puppet_ros.evaluate.tables import format_table, write_csv
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")


@pytest.fixture(scope="module")
def source() -> BodySource:
    return BodySource()


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


class _Oracle:
    """A fitter that knows the truth and errs by a known step."""

    def __init__(self, model: StitchedPuppet, vertices: np.ndarray) -> None:
        self.model, self._vertices = model, vertices

    def fit(self, *_: Any, **__: Any) -> SimpleNamespace:
        return SimpleNamespace(
            vertices=self._vertices,
            joints=self.model.joints(self._vertices),
            two_way_distance=0.01,
            confidence=0.9,
            reliable=False,
        )


def _scored(model: StitchedPuppet, source: BodySource, scan: Any, vertices: np.ndarray) -> Any:
    oracle: Any = _Oracle(model, vertices)
    body, scene, cloud = scan
    return score_fit(oracle, body, scene, cloud, source.joint_names)[1]


@LEARN
def test_scores_are_the_distance_to_the_truth(source: BodySource, model: StitchedPuppet) -> None:
    scan = next(draw_scans("single", source, 1, 0))
    truth = scan[0].template_vertices("neutral")
    exact = _scored(model, source, scan, truth)
    moved = _scored(model, source, scan, truth + np.array([0.0, 0.03, 0.04]))
    turned = _scored(model, source, scan, truth[model.mirror_vertex])
    assert (exact.vertex_error, exact.visible_error, exact.flipped) == (0, 0, False)
    assert exact.joint_error < 0.02
    assert moved.vertex_error == pytest.approx(0.05)
    assert moved.visible_error == pytest.approx(0.05)
    assert not moved.flipped
    assert turned.flipped
    figures = summarise([exact, moved, turned])
    assert figures["vertex_median_cm"] == pytest.approx(5)
    assert (figures["bodies"], figures["flipped"], figures["unreliable"]) == (3, 1, 3)
    assert figures["bad"] == figures["bad_unreliable"] == 2


@LEARN
def test_only_seen_vertices_count_as_visible(source: BodySource) -> None:
    body, scene, cloud = next(draw_scans("single", source, 1, 1))
    truth = body.template_vertices("neutral")
    seen = find_visible_vertices(scene, truth, cloud.viewpoint)
    assert 0.2 < seen.mean() < 0.6
    assert cloud.viewpoint is not None
    ahead = truth.mean(axis=0) - cloud.viewpoint
    assert (truth[seen] @ ahead).mean() < (truth[~seen] @ ahead).mean()
    assert find_visible_vertices(scene, truth, None).all()


@LEARN
@pytest.mark.parametrize("kind", ["whole", "lidar"])
def test_scans_are_drawn_by_the_seed(source: BodySource, kind: str) -> None:
    first, again = (list(draw_scans(kind, source, 2, seed)) for seed in (7, 7))
    for (_, _, cloud), (_, _, same) in zip(first, again, strict=True):
        np.testing.assert_array_equal(cloud.points, same.points)
    assert np.abs(first[0][0].vertices - first[1][0].vertices).max() > 0.05


def test_a_block_hides_its_back() -> None:
    vertices, faces = make_box(np.zeros(3), np.ones(3), np.eye(3))
    seen = find_visible_vertices(RaycastScene(vertices, faces), vertices * 0.999, np.array([5.0, 0.2, 0.3]))
    np.testing.assert_array_equal(seen, vertices[:, 0] > 0)


def test_the_mirrored_body_is_flipped(model: StitchedPuppet) -> None:
    truth = model.vertices(model.sample(np.random.default_rng(0)))
    assert not is_flipped(truth + 0.05, truth, model)
    assert is_flipped(truth[model.mirror_vertex] + 0.05, truth, model)


def test_tables_line_up(tmp_path: Path) -> None:
    rows = [{"kind": "whole", "cm": 1.23456, "flipped": True}, {"kind": "a", "cm": 12.0, "flipped": False}]
    assert format_table(rows) == "kind      cm  flipped\nwhole  1.235      yes\na         12       no"
    write_csv(tmp_path / "rows.csv", rows)
    with (tmp_path / "rows.csv").open() as file:
        assert [row["cm"] for row in csv.DictReader(file)] == ["1.23456", "12.0"]


def test_a_table_has_the_columns_of_all_rows() -> None:
    rows = [{"node": "a", "results": 12, "hz": 1.5}, {"node": "b", "hz": 30.0, "first": "1 s"}]
    assert format_table(rows) == "node  results   hz  first\na          12  1.5\nb               30  1 s"


@LEARN
def test_the_command_writes_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--particles", "4", "--iterations", "1", "--restarts", "0", "--gauss-newton-steps", "1"]
    quick += ["--local-iterations", "0", "--levenberg-steps", "0", "--max-points", "400"]
    assert (
        main(["evaluate", "bodies", "--kind", "whole", "--count", "1", "--out", str(tmp_path), "--json", *quick]) == 0
    )
    figures = json.loads(capsys.readouterr().out)
    assert figures["bodies"] == 1
    assert figures["vertex_mean_cm"] > 0
    written = json.loads((tmp_path / "bodies_whole.json").read_text())
    assert written["summary"] == figures
    assert (tmp_path / "bodies_whole.csv").read_text().startswith("hard,points,vertex_error")


@pytest.mark.parametrize("flags", [["--count", "0"], ["--people-seed", "-1"]])
def test_unusable_numbers_are_named(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "bodies", *flags]) == 2
    assert flags[0] in capsys.readouterr().err


def test_truth_needs_a_shipped_model() -> None:
    with pytest.raises(Exception, match="nobody"):
        TrueBody(np.zeros((3, 3)), np.zeros((1, 3)), False, 1.7).template_vertices("nobody")
