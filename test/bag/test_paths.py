# SPDX-License-Identifier: Apache-2.0
"""What looks like one bag, and what like a folder of several."""

from pathlib import Path

import pytest

from flowing_puppet_ros.bag.storage.paths import is_bag


@pytest.mark.parametrize(
    ("files", "one"),
    [
        (["metadata.yaml"], True),
        (["anything.mcap"], True),
        (["anything.db3", "notes.txt"], True),
        (["drive_0.mcap", "drive_1.mcap", "drive_10.mcap"], True),
        (["drive_0.mcap", "other.mcap"], False),
        (["a.mcap", "b.mcap"], False),
        (["a.png"], False),
        ([], False),
    ],
)
def test_a_folder_is_a_bag_when_one_was_recorded_in_it(tmp_path: Path, files: list[str], one: bool) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    for name in files:
        (folder / name).touch()
    assert is_bag(folder) == one


def test_a_file_is_a_bag_by_its_ending(tmp_path: Path) -> None:
    assert is_bag(tmp_path / "a.mcap") and is_bag(tmp_path / "a.DB3") and not is_bag(tmp_path / "a.mp4")
