# SPDX-License-Identifier: Apache-2.0
"""Recordings whose stamps do not advance are replayed by the times of recording, and that is told."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import POINT_CLOUD

FACTORY = BagMessageFactory()
TENTH = 100_000_000


def cloud(stamp: int) -> Any:
    return make_cloud(FACTORY, make_header(FACTORY, stamp, "map"), np.zeros((0, 3)))


@pytest.mark.parametrize(
    ("stamps", "wanted"),
    [
        ([0, 0, 0, 0], [0, 10, 20, 30]),
        ([70, 70, 70, 70], [70, 80, 90, 100]),
        ([1, 1, 2, 2], [1, 11, 21, 31]),
        ([5, 6, 7, 8], [5, 6, 7, 8]),
        ([5, 6, 6, 7], [5, 6, 6, 7]),
    ],
)
def test_stamps_follow_the_times_of_recording_where_they_stand_still(
    stamps: list[int], wanted: list[int], tmp_path: Path
) -> None:
    with BagWriter(tmp_path / "in.mcap") as writer:
        writer.add_topic("/lidar/points", POINT_CLOUD)
        for k, stamp in enumerate(stamps):
            writer.write("/lidar/points", 10**12 + 10 * k * TENTH, cloud(stamp * TENTH))
    summary = replay(tmp_path / "in.mcap", tmp_path / "out.mcap", ReplayOptions(progress=False))
    with open_bag(tmp_path / "out.mcap") as out:
        assert [stamp_ns(record.message) for record in out.messages(["/lidar/bodies"])] == [
            stamp * TENTH for stamp in wanted
        ]
    told = [text for text in summary["warnings"] if "one stamp" in text]
    assert told == (
        ["the messages on /lidar/points all have one stamp: they follow one another by their times of recording"]
        if wanted != stamps
        else []
    )
