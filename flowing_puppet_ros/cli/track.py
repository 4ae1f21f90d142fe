# SPDX-License-Identifier: Apache-2.0
"""Track people in a video, a folder of frames or a bag: joints, part outlines and depth order in every frame.

People start at the keypoints of --init, are carried by optical flow, and are pulled back wherever keypoints are given
again. A bag brings its own detections.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import FlowSettings
from flowing_puppet_ros.image.keypoints import Keypoints
from flowing_puppet_ros.image.people import TrackerSettings
from flowing_puppet_ros.image.tracker import FlowingPuppetTracker
from flowing_puppet_ros.image.tracks import puppet_entry, read_keypoints, write_tracks
from flowing_puppet_ros.image.video import Frame, open_frames
from flowing_puppet_ros.model.ds import DeformableStructures

BAG_SUFFIXES = frozenset({".mcap", ".db3"})

type Detected = tuple[Frame, list[Keypoints] | None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("input", help="video file, folder of images, or bag (.mcap, .db3 or a rosbag2 folder)")
    parser.add_argument("--out", required=True, help="tracks.json to write")
    parser.add_argument("--init", help="keypoints.json, people of one or more frames; needed unless a bag has them")
    parser.add_argument("--topic", default="", help="image topic of a bag [the first camera with detections]")
    parser.add_argument("--model", default="neutral", choices=("neutral", "female", "male"), help="body [neutral]")
    parser.add_argument("--parts", type=int, default=10, choices=(10, 14), help="14 adds hands and feet [10]")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object")
    TrackerSettings.add_arguments(parser)
    FlowSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Track through the whole input and write the tracks."""
    model = DeformableStructures.load(arguments.model, arguments.parts)
    settings = TrackerSettings.from_arguments(arguments), FlowSettings.from_arguments(arguments)
    tracker = FlowingPuppetTracker(model, *settings)
    detected, fps, count = _open(Path(arguments.input), arguments.init, arguments.topic)
    frames: list[dict[str, Any]] = []
    began, last = time.monotonic(), ""
    for frame, detections in tqdm(detected, total=count or None, unit="frame", disable=None):
        result = tracker.step(frame.image, frame.stamp_ns, detections)
        for warning in result.warnings:
            if warning != last:
                print(f"flowing-puppet track: frame {frame.index}: {warning}", file=sys.stderr)
            last = warning
        puppets = [puppet_entry(puppet, model.tree) for puppet in result.puppets]
        entry = {"index": frame.index, "stamp_ns": frame.stamp_ns, "puppets": puppets}
        frames.append(entry | ({"path": frame.path} if frame.path else {}))
    write_tracks(arguments.out, model.joint_names, fps, frames)
    _summarise(arguments, frames, time.monotonic() - began)
    return 0


def _open(path: Path, init: str | None, topic: str) -> tuple[Iterable[Detected], float, int]:
    """The input's frames with the keypoints given for them, its frame rate and its number of frames (0 unknown)."""
    if is_bag(path):
        return _open_bag(path, init, topic)
    source = open_frames(path)
    if init is None:
        raise InputError(f"{path} says nothing about where people are; give keypoints of one frame with --init")
    keypoints = read_keypoints(init)
    if source.count and min(keypoints, default=0) >= source.count:
        raise InputError(f"{init} has keypoints from frame {min(keypoints)} on, but {path} has {source.count} frames")
    return ((frame, keypoints.get(frame.index)) for frame in source), source.fps, source.count


def is_bag(path: Path) -> bool:
    """Whether `path` is a bag file or a folder that rosbag2 wrote."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def _open_bag(path: Path, init: str | None, topic: str) -> tuple[Iterable[Detected], float, int]:
    # Only bags need the bag stack, which takes a while to import.
    from flowing_puppet_ros.bag.frames import open_bag_frames

    source = open_bag_frames(path, topic)
    if init is None:
        if not source.detections:
            raise InputError(f"{path} has no detections beside {source.topic}; give keypoints of one image with --init")
        return source, source.fps, source.count
    keypoints = read_keypoints(init)
    return ((frame, keypoints.get(frame.index)) for frame, _ in source), source.fps, source.count


def _summarise(arguments: argparse.Namespace, frames: list[dict[str, Any]], seconds: float) -> None:
    ids = sorted({puppet["id"] for frame in frames for puppet in frame["puppets"]})
    with_people = sum(bool(frame["puppets"]) for frame in frames)
    if arguments.json:
        counts = {"frames": len(frames), "frames_with_people": with_people, "ids": ids}
        print(json.dumps({"input": arguments.input, "out": arguments.out} | counts | {"seconds": round(seconds, 3)}))
    else:
        rate = len(frames) / max(seconds, 1e-9)
        names = ", ".join(ids) or "none"
        print(f"{arguments.out}: {len(frames)} frames, people in {with_people}, ids {names}, {rate:.1f} frames/s")
