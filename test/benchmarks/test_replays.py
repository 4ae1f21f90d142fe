# SPDX-License-Identifier: Apache-2.0
"""What the bench of replays compares: the same bytes on any number of threads, and longer recordings."""

import subprocess
from pathlib import Path
from typing import Any

import pytest

from benchmarks import replays
from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions
from flowing_puppet_ros.errors import PuppetError
from flowing_puppet_ros.stream.messages.geometry import stamp_ns


def pretend(monkeypatch: pytest.MonkeyPatch, contents: dict[int | None, bytes]) -> list[int | None]:
    """Replace the replay by one that writes what is given for a number of threads."""
    used: list[int | None] = []

    def replay(_: Path, target: Path, options: ReplayOptions) -> dict[str, Any]:
        used.append(options.jobs)
        target.write_bytes(contents[options.jobs])
        spent = {"cam1/puppet_tracker": 1.0, "cam2/puppet_tracker": 2.0, "body_fitter": 4.0, "writing": 0.5}
        return {"frames": 32, "bodies": 8, "seconds_of": spent}

    monkeypatch.setattr(replays, "replay", replay)
    monkeypatch.setattr(replays, "usable_threads", lambda most: 3)
    return used


def test_one_thread_and_all_cores_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    used = pretend(monkeypatch, {None: b"", 1: b"same", 3: b"same"})
    one, all_cores = replays.measure_replay(0)
    assert used == [None, *[1, 3] * replays.TRIES]
    assert (one["threads"], all_cores["threads"]) == (1, 3)
    assert one["trackers_seconds"] == 3.0 and one["body_fitter_seconds"] == 4.0 and one["writing_seconds"] == 0.5
    assert one["times_one_thread"] == 1.0
    assert all_cores["times_one_thread"] == pytest.approx(one["seconds"] / all_cores["seconds"])
    assert one["images_a_second"] == pytest.approx(32 / one["seconds"])


def test_other_bytes_on_more_threads_fail_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, {None: b"", 1: b"same", 3: b"other"})
    with pytest.raises(PuppetError, match="1 and 3 threads wrote different bytes"):
        replays.measure_replay(0)


def test_a_repeated_recording_goes_on_in_time(tmp_path: Path) -> None:
    replays.repeat_recording(replays.GOLDEN, tmp_path / "long.mcap", 3)
    with open_bag(replays.GOLDEN) as short, open_bag(tmp_path / "long.mcap") as long:
        assert long.count == 3 * short.count
        topic = "/cam2/image/compressed"
        stamps = [stamp_ns(record.message) for record in long.messages([topic])]
        given = [record.message for record in short.messages([topic])]
        pictures = [bytes(record.message.data) for record in long.messages([topic])]
    assert stamps == sorted(set(stamps)) and len(stamps) == 3 * len(given)
    assert stamps[: len(given)] == [stamp_ns(message) for message in given]
    assert pictures == [bytes(message.data) for message in given] * 3


def test_memory_is_that_of_a_process_per_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replays, "LENGTHS", (1, 2))
    counts: list[int] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        with open_bag(command[3]) as bag:
            counts.append(bag.count)
        return subprocess.CompletedProcess(
            command, 0, f"something else\n{32 * len(counts)} {200.5 + len(counts)}\n", ""
        )

    monkeypatch.setattr(replays.subprocess, "run", run)
    rows = replays.measure_memory(0)
    assert rows == [
        {"recordings": 1, "images": 32, "peak_megabytes": 201.5},
        {"recordings": 2, "images": 64, "peak_megabytes": 202.5},
    ]
    assert counts[1] == 2 * counts[0]
