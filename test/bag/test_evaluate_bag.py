# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet evaluate bag` on the golden replay, whose true joints are known."""

import json
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.cli import main


def _run(golden: Any, *flags: str) -> int:
    return main(["evaluate", "bag", str(golden.replays[0]), "--input", str(golden.source), *flags])


def _truth(golden: Any, folder: Path, stamps: int = 0, up: float = 0.0) -> str:
    moved = {
        str(int(stamp) + stamps): {name: [x, y, z + up] for name, (x, y, z) in joints.items()}
        for stamp, joints in golden.truth.items()
    }
    path = folder / "truth.json"
    path.write_text(json.dumps(moved))
    return str(path)


def test_bodies_are_near_the_truth(golden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    assert _run(golden, "--truth", _truth(golden, tmp_path), "--json", "--out", str(out)) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["mean"] < 0.15
    assert figures["arms swapped"] == figures["legs swapped"] == 0
    written = json.loads(out.read_text())
    assert written["summary"] == figures
    assert written["joints"]["left_wrist"]["frames"] == figures["frames"]
    assert _run(golden, "--truth", _truth(golden, tmp_path, up=1.0), "--json") == 0
    raised = json.loads(capsys.readouterr().out)
    assert raised["mean"] == pytest.approx(1.0, abs=0.15)


def test_without_truth_detections_are_triangulated(golden: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(golden, "--json") == 0
    assert json.loads(capsys.readouterr().out)["mean"] < 0.2


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
