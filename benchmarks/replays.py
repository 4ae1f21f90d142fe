# SPDX-License-Identifier: Apache-2.0
"""Speed and memory of replays of the repository's small recording of four cameras, all output written.

Replays on one thread and on all cores follow one another several times, so that what else the machine does disturbs
them alike; of each the fastest counts. Their files must have the same bytes.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.process.threads import MAX_THREADS, usable_threads
from flowing_puppet_ros.units import NANOSECONDS

GOLDEN = Path(__file__).resolve().parent.parent / "bags" / "golden"
TRIES = 3  # replays on one thread, and as many on all cores
LENGTHS = (1, 4, 12)  # of the recordings by which memory is measured, in lengths of the small one
PAUSE_NS = 100_000_000  # between its repetitions


def measure_replay(seed: int) -> list[Row]:
    """Measure replays on one thread and on all cores: wall-clock and processor time, and the seconds of each stage."""
    _check_source()
    cores = usable_threads(MAX_THREADS)
    best: dict[int, Row] = {}
    contents = set()
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "out.mcap"
        replay(GOLDEN, target, ReplayOptions(seed=seed, progress=False))  # compiles
        for _ in range(TRIES):
            for threads in sorted({1, cores}):
                row = _measure_once(target, seed, threads)
                contents.add(target.read_bytes())
                best[threads] = min(row, best.get(threads, row), key=lambda each: each["seconds"])
    if len(contents) > 1:
        raise PuppetError(f"replays on 1 and {cores} threads wrote different bytes")
    return [row | {"times_one_thread": best[1]["seconds"] / row["seconds"]} for row in best.values()]


def _measure_once(target: Path, seed: int, threads: int) -> Row:
    started = time.process_time(), time.perf_counter()
    summary = replay(GOLDEN, target, ReplayOptions(seed=seed, progress=False, jobs=threads))
    processor, seconds = time.process_time() - started[0], time.perf_counter() - started[1]
    stages = {"trackers": 0.0}
    for name, spent in summary["seconds_of"].items():
        stage = "trackers" if name.endswith("puppet_tracker") else name
        stages[stage] = stages.get(stage, 0.0) + spent
    row = {"threads": threads, "images": summary["frames"], "bodies": summary["bodies"]}
    row |= {"processor_seconds": processor, "seconds": seconds, "images_a_second": summary["frames"] / seconds}
    return row | {f"{stage}_seconds": spent for stage, spent in stages.items()}


def measure_memory(seed: int) -> list[Row]:
    """Measure the peak memory of replays of recordings of different lengths, each in a process of its own."""
    _check_source()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for length in LENGTHS:
            source = Path(folder) / f"{length}.mcap"
            repeat_recording(GOLDEN, source, length)
            command = [
                sys.executable,
                "-m",
                "benchmarks.replays",
                str(source),
                str(Path(folder) / "out.mcap"),
                str(seed),
            ]
            done = subprocess.run(command, capture_output=True, text=True, cwd=GOLDEN.parents[1])
            if done.returncode:
                raise PuppetError(f"the replay of {length} recordings failed: {done.stderr.strip()[-300:]}")
            images, megabytes = (float(value) for value in done.stdout.split()[-2:])
            rows.append({"recordings": length, "images": int(images), "peak_megabytes": megabytes})
    return rows


def repeat_recording(source: Path, target: Path, times: int) -> None:
    """Write a bag in which a recording follows itself so many times, with the stamps of one long recording."""
    store = typestore()
    with open_bag(source) as bag, BagWriter(target) as writer:
        for name, topic in bag.details.items():
            writer.add_topic(name, topic.type, topic.qos)
        records = list(bag.messages())
        length = records[-1].log_time - records[0].log_time + PAUSE_NS
        for shift in range(0, times * length, length):
            for record in records:
                message = record.message
                if hasattr(message, "header"):
                    stamp = message.header.stamp
                    now = stamp.sec * NANOSECONDS + stamp.nanosec + shift
                    stamp.sec, stamp.nanosec = divmod(now, NANOSECONDS)
                raw = bytes(store.serialize_cdr(message, record.type))
                writer.write_raw(record.topic, record.log_time + shift, raw)


def _check_source() -> None:
    if not GOLDEN.is_dir():
        raise InputError(f"the replay is measured on {GOLDEN}, which only the source tree has")


def main(source: str, target: str, seed: str) -> None:
    """Replay a bag and print the number of its images and this process's peak memory in megabytes."""
    summary = replay(Path(source), Path(target), ReplayOptions(seed=int(seed), progress=False))
    print(summary["frames"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


if __name__ == "__main__":
    main(*sys.argv[1:])
