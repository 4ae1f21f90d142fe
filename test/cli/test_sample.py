# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample sp` and the arguments of `learn`."""

from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.model.sp import StitchedPuppet


def test_meshes_and_sheet_are_written_and_repeat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("a", "b"):
        assert main(["sample", "sp", "--count", "2", "--seed", "3", "--out", str(tmp_path / folder)]) == 0
    paths = capsys.readouterr().out.split()
    assert [Path(path).name for path in paths[:3]] == ["sp_neutral_000.ply", "sp_neutral_001.ply", "sp_neutral.png"]
    for path in paths[:3]:
        assert Path(path).read_bytes() == (tmp_path / "b" / Path(path).name).read_bytes()
    model = StitchedPuppet.load("neutral")
    expected = model.vertices(model.sample(np.random.default_rng(3)))
    np.testing.assert_allclose(read_scan(Path(paths[0])).points, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["sample", "sp", "--count", "0"], "--count is 0"),
        (["sample", "sp", "--seed", "-1"], "--seed is -1"),
        (["sample", "sp", "--gender", "robot"], "'robot'"),
        (["learn", "sp", "--poses", "3"], "poses is 3"),
    ],
)
def test_bad_arguments_are_one_sentence(
    arguments: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    message = capsys.readouterr().err.strip()
    assert named in message
    assert len(message.splitlines()) == 1


def test_a_file_where_the_folder_should_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("")
    assert main(["sample", "sp", "--out", str(tmp_path / "taken")]) == 2
    assert "choose another folder" in capsys.readouterr().err
