# SPDX-License-Identifier: Apache-2.0
"""The images of one camera of a bag with the detections of their stamps."""

from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.images import decode_image

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"


def test_images_come_with_the_detections_of_their_stamps() -> None:
    source = open_bag_frames(GOLDEN, "/cam3/image/compressed")
    assert (source.count, round(source.fps, 6)) == (8, 30.0)
    with open_bag(GOLDEN) as bag:
        pictures = [decode_image(record.message) for record in bag.messages(["/cam3/image/compressed"])]
    for index, ((frame, people), picture) in enumerate(zip(source, pictures, strict=True)):
        assert frame.index == index
        np.testing.assert_array_equal(frame.image, picture)
        assert (people is None) == (index in (3, 6))
        assert people is None or [len(person.names) for person in people] == [17]


def test_the_first_camera_with_detections_is_taken() -> None:
    assert open_bag_frames(GOLDEN).topic == "/cam1/image/compressed"


def test_missing_and_silent_topics_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no images on /cam9/image; its image topics are: /cam1/image/compressed"):
        open_bag_frames(GOLDEN, "/cam9/image")
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/cam/image", "sensor_msgs/msg/Image")
    with pytest.raises(InputError, match="no message on /cam/image"):
        open_bag_frames(tmp_path / "a.mcap")
