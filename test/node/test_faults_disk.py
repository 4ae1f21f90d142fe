# SPDX-License-Identifier: Apache-2.0
"""Outputs that cannot be finished: killed while recording, no space on the disk."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from flowing_puppet_ros.bag.reader import open_bag

pytestmark = pytest.mark.slow

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
WRITTEN, MEGABYTE = 40, 1024 * 1024

KILLED = f"""
import os, signal, sys
from pathlib import Path
import numpy as np
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.geometry import make_header
factory, rng = BagMessageFactory(), np.random.default_rng(0)
writer = BagWriter(Path(sys.argv[1]))
writer.add_topic("/image", "sensor_msgs/msg/Image")
for number in range({WRITTEN}):
    noise = rng.integers(0, 256, (256, 1024), np.uint8)
    writer.write("/image", number, make_image(factory, make_header(factory, number, "camera"), noise, "mono8"))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_recording_that_was_killed_is_salvaged(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, tmp_path / "out.mcap"], capture_output=True)
    assert done.returncode == -9
    partial = tmp_path / "out.mcap.partial"
    assert partial.stat().st_size > 0 and not (tmp_path / "out.mcap").exists()
    found = partial.rename(tmp_path / "found.mcap")
    with open_bag(found, True) as bag:
        numbers = [record.log_time for record in bag.messages()]
    # What was in the chunk that was being filled is lost: at most a megabyte, here four messages and one more.
    assert numbers == list(range(len(numbers))) and len(numbers) >= WRITTEN - 5


def test_a_full_disk_is_one_sentence_and_leaves_no_broken_bag(tmp_path: Path) -> None:
    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    command = [str(Path(sys.executable).with_name("flowing-puppet")), "replay", str(GOLDEN)]
    # A first chunk of a megabyte would not be reached by this recording: the limit lies where it is finished.
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "out.mcap")], capture_output=True, text=True, preexec_fn=small
    )
    said = [
        line for line in done.stderr.splitlines() if line.startswith("flowing-puppet replay: ") and "failed" in line
    ]
    assert done.returncode == 1
    assert len(said) == 1 and "File too large" in said[0]
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
