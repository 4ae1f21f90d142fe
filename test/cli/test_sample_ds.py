# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet sample ds` draws a sheet, repeats itself with its seed, and refuses what it cannot use."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main


def sheet(folder: Path, *flags: str) -> np.ndarray:
    assert main(["sample", "ds", "--count", "3", "--out", str(folder), *flags]) == 0
    (picture,) = folder.glob("*.png")
    image = cv2.imread(str(picture))
    assert image is not None
    return image


@pytest.mark.parametrize("flags", [("--parts", "14"), ("--gender", "male")])
def test_sheet_shows_coloured_puppets(tmp_path: Path, flags: tuple[str, ...]) -> None:
    image = sheet(tmp_path, *flags)
    coloured = np.ptp(image.astype(int), axis=2) > 40
    assert 0.03 < coloured.mean() < 0.6
    columns = coloured.any(axis=0).astype(int)
    assert (np.diff(columns) == 1).sum() >= 2, "white gaps keep the puppets apart"


def test_seed_decides_the_sheet(tmp_path: Path) -> None:
    first, again, other = (sheet(tmp_path / str(k), "--seed", seed) for k, seed in enumerate(("4", "4", "5")))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--gender", "child"), "no ds model called 'child-10'"),
        (("--count", "0"), "--count is 0"),
        (("--seed", "-1"), "--seed is -1"),
    ],
)
def test_bad_input_is_told_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...], message: str
) -> None:
    assert main(["sample", "ds", "--out", str(tmp_path), *flags]) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1


def test_folder_that_is_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("no folder")
    assert main(["sample", "ds", "--out", str(tmp_path / "file")]) == 2
    assert "choose another folder" in capsys.readouterr().err


@pytest.mark.parametrize(("view", "columns"), [("all", 9), ("WSW", 3)])
def test_sides_are_drawn(tmp_path: Path, view: str, columns: int) -> None:
    image = sheet(tmp_path, "--view", view)
    filled = (np.ptp(image.astype(int), axis=2) > 40).any(axis=0).astype(int)
    assert (np.diff(filled) == 1).sum() >= columns - 1
    assert (tmp_path / f"ds_neutral-10-{view}.png").exists()
