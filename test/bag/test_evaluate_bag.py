# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate bag` on the golden replay, whose true joints are known."""

import json
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.cli import main

pytestmark = pytest.mark.slow


def _run(golden: Any, *flags: str) -> int:
    return main(["evaluate", "bag", str(golden.replay), "--input", str(golden.source), *flags])


def _truth(golden: Any, folder: Path, stamps: int = 0, up: float = 0.0) -> str:
    moved = {
        str(int(stamp) + stamps): {name: [x, y, z + up] for name, (x, y, z) in joints.items()}
        for stamp, joints in golden.truth.items()
    }
    path = folder / "truth.json"
    path.write_text(json.dumps(moved))
    return str(path)


def _figures(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    (figures,) = json.loads(capsys.readouterr().out).values()
    return dict(figures)


def test_bodies_are_near_the_truth(golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures"
    assert _run(golden, "--truth", _truth(golden, tmp_path), "--json", "--out", str(out)) == 0
    figures = _figures(capsys)
    assert figures["MPJPE, cm"] < 15 and figures["people found, %"] == 100
    assert figures["arms swapped, %"] == figures["legs swapped, %"] == 0
    assert figures["id switches of bodies"] == figures["id switches of puppets"] == 0
    assert (figures["images"], figures["images dropped"]) == (32, 0)
    assert (figures["clouds"], figures["clouds dropped"]) == (8, 0)
    # A puppet waits for its detection, which is recorded 5 ms after the image.
    assert figures["latency of puppets, median s"] == pytest.approx(0.005)
    written = json.loads((out / "bag.json").read_text())
    assert written["figures"] == {"out": figures}
    assert written["joints, m"]["out"]["left_wrist"]["frames"] == 8
    assert {path.name for path in out.iterdir()} == {
        "bag.json", "bag.csv", "bag-accuracy.png", "bag-accuracy.svg", "bag-time.png", "bag-time.svg"
    }  # fmt: skip
    assert _run(golden, "--truth", _truth(golden, tmp_path, up=1.0), "--json") == 0
    assert _figures(capsys)["MPJPE, cm"] == pytest.approx(100, abs=15)


def test_a_bag_is_the_truth_of_another_one(golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "out.mcap").write_bytes(golden.replay.read_bytes())
    first, second = (str(tmp_path / name / "out.mcap") for name in ("first", "second"))
    words = ["evaluate", "bag", first, second, "--input", str(golden.source), "--truth", first, "--json"]
    assert main(words) == 0
    runs = json.loads(capsys.readouterr().out)
    assert list(runs) == ["first/out", "second/out"]
    for figures in runs.values():
        assert figures["MPJPE, cm"] == 0 and figures["vertex to surface, cm"] < 1e-4


def test_without_truth_detections_are_triangulated(golden: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(golden, "--json") == 0
    assert _figures(capsys)["MPJPE, cm"] < 20


@pytest.mark.parametrize(
    ("text", "sentence"), [("[]", "is not of the form"), ('{"1": {"neck": [1]}}', "is not of the")]
)
def test_unusable_truth_is_named(
    golden: Any, tmp_path: Path, text: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "truth.json"
    path.write_text(text)
    assert _run(golden, "--truth", str(path)) == 2
    assert sentence in capsys.readouterr().err


def test_another_recording_is_named(golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(golden, "--truth", _truth(golden, tmp_path, stamps=10**12)) == 2
    assert "no body at a stamp of the truth" in capsys.readouterr().err
