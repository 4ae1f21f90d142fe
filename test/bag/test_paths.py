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
        (["lab_0.mcap", "lab_1.mcap", "lab_2.mcap"], True),
        (["lab_1.mcap", "lab_2.mcap"], False),
        (["lab_0.db3.zstd", "lab_1.db3.zstd"], True),
        (["lab_2019-05-03-12-41-38_0.bag", "lab_2019-05-03-12-42-18_1.bag"], True),
        (["lab_2019-05-03-12-41-38.bag", "lab_2019-05-03-12-42-18.bag"], False),
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
    for name in ("a.bag", "a.bag.active", "a.bag.gz", "a.mcap.zst", "a.mcap.lz4", "a.db3.zstd"):
        assert is_bag(tmp_path / name)


def test_a_renamed_file_is_a_bag_by_its_content(tmp_path: Path) -> None:
    for head, bag in (
        (b"\x89MCAP0\r\n", True),
        (b"#ROSBAG V2.0\n", True),
        (b"SQLite format 3\0", True),
        (b"text", False),
    ):
        (tmp_path / "recording").write_bytes(head)
        assert is_bag(tmp_path / "recording") == bag
