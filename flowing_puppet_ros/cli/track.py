# SPDX-License-Identifier: Apache-2.0
"""Track people in a video, a folder of frames or a bag: joints, part outlines and depth order in every frame.

The keypoints of --init or of a bag say where people are, otherwise the detector of this package; optical flow carries
them on. At the end the hypotheses of the arms are joined and the joints smoothed along the flow, over the whole input,
unless --live is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros.bag.paths import is_bag
from flowing_puppet_ros.draw.overlay_video import check_overlay, drawn_tracks, write_overlay
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import FlowSettings
from flowing_puppet_ros.image.arms.evidence import ArmEvidence, ArmEvidenceModel
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.tracks_json import puppet_entry, read_keypoints, write_tracks
from flowing_puppet_ros.image.formats.video_reader import VideoFrame, open_frames
from flowing_puppet_ros.image.tracking.smoothing import SmoothingSettings
from flowing_puppet_ros.image.tracking.track import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet, TrackResult
from flowing_puppet_ros.image.video.offline_smoother import OfflineSmoother
from flowing_puppet_ros.image.video.tracking_by_detection import DetectingTracker, DetectionSettings
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

type Detected = tuple[VideoFrame, list[Keypoints] | None]
type Stepped = tuple[TrackResult, dict[str, ArmEvidence] | None]
type Stepper = Callable[[VideoFrame, list[Keypoints] | None], Stepped]
type Tracked = tuple[int, int, str, list[TrackedPuppet]]  # index, stamp, path of a frame, and its people


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("input", help="video file, folder of images, or bag (.mcap, .db3 or a rosbag2 folder)")
    parser.add_argument("--out", required=True, help="tracks.json to write")
    parser.add_argument("--init", help="keypoints.json or sticks.txt, people of one or more frames, for the detector")
    parser.add_argument("--topic", default="", help="image topic of a bag [the first camera with detections]")
    parser.add_argument("--salvage", action="store_true", help="read what is whole of a truncated or damaged .mcap")
    parser.add_argument("--model", default="neutral", choices=("neutral", "female", "male"), help="body [neutral]")
    parser.add_argument("--parts", type=int, default=10, choices=(10, 14), help="14 adds hands and feet [10]")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object")
    parser.add_argument("--overlay", help="video to write: the puppets on the frames and on the flow (.mp4 or .avi)")
    parser.add_argument("--live", action="store_true", help="use no frame after the one on show, as the nodes do")
    TrackerSettings.add_arguments(parser)
    FlowSettings.add_arguments(parser)
    DetectionSettings.add_arguments(parser)
    PathSettings.add_arguments(parser)
    SmoothingSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Track through the whole input and write the tracks."""
    model = DeformableStructures.load(arguments.model, arguments.parts)
    settings = TrackerSettings.from_arguments(arguments), FlowSettings.from_arguments(arguments)
    clip = OfflineSmoother(model, SmoothingSettings.from_arguments(arguments), PathSettings.from_arguments(arguments))
    tracker = FlowingPuppetTracker(model, *settings)
    if arguments.overlay:
        check_overlay(Path(arguments.overlay))
    source = _open(arguments, _warn)
    tally = _Tally()
    shown = tqdm(source.frames, total=source.count or None, unit="frame", disable=None)
    steps = _tracked(_stepper(arguments, tracker, source.given), shown)
    people = _live(steps) if arguments.live else _whole(steps, clip)
    began = time.monotonic()
    write_tracks(arguments.out, model.joint_names, source.fps, tally.counted(_entries(people, model)))
    if not tally.frames:
        Path(arguments.out).unlink(missing_ok=True)
        raise InputError(f"{arguments.input} has no image that can be used")
    if arguments.overlay:
        _draw(arguments, source.fps)
    _summarise(arguments, tally, time.monotonic() - began)
    return 0


def _draw(arguments: argparse.Namespace, fps: float) -> None:
    """Write --overlay: the input again, with what was written to --out."""
    images = ((frame.index, frame.image) for frame, _ in _open(arguments, lambda _: None).frames)
    write_overlay(Path(arguments.overlay), images, drawn_tracks(Path(arguments.out)), fps)


def _stepper(arguments: argparse.Namespace, tracker: FlowingPuppetTracker, given: bool) -> Stepper:
    """What steps the tracker: with the keypoints that are `given`, or with the detector."""
    if given:
        return lambda frame, detections: (tracker.step(frame.image, frame.stamp_ns, detections), None)
    settings = DetectionSettings.from_arguments(arguments)
    video = DetectingTracker(tracker, PartDetector.load(), ArmEvidenceModel.load(arguments.model), settings)
    if arguments.live:
        return lambda frame, _: (video.step(frame.image, frame.stamp_ns)[0], None)
    again = _open(arguments, lambda _: None)
    searched = tqdm(again.frames, "search", total=again.count or None, unit="frame", disable=None)
    paths = video.search(frame.image for frame, _ in searched)

    def step(frame: VideoFrame, detections: list[Keypoints] | None) -> Stepped:
        result, found = video.step(frame.image, frame.stamp_ns, paths=paths)
        return result, video.arm_evidence(frame.image, result, found)

    return step


@dataclass
class _Tally:
    """What was written."""

    frames: int = 0
    with_people: int = 0
    ids: set[str] = field(default_factory=set)

    def counted(self, entries: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        for entry in entries:
            self.frames += 1
            self.with_people += bool(entry["puppets"])
            self.ids |= {puppet["id"] for puppet in entry["puppets"]}
            yield entry


def _tracked(step: Stepper, detected: Iterable[Detected]) -> Iterator[tuple[VideoFrame, Stepped]]:
    """Step through the frames; one that cannot be used is warned of and left out."""
    last = ""
    for frame, detections in detected:
        try:
            result, sights = step(frame, detections)
        except InputError as error:
            _warn(f"frame {frame.index}: {error}")
            continue
        for warning in result.warnings:
            if warning != last:
                _warn(f"frame {frame.index}: {warning}")
            last = warning
        yield frame, (result, sights)


def _live(steps: Iterable[tuple[VideoFrame, Stepped]]) -> Iterator[Tracked]:
    for frame, (result, _) in steps:
        yield frame.index, frame.stamp_ns, frame.path, result.puppets


def _whole(steps: Iterable[tuple[VideoFrame, Stepped]], clip: OfflineSmoother) -> Iterator[Tracked]:
    seen = []
    for frame, (result, sights) in steps:
        clip.add(result, sights)
        seen.append((frame.index, frame.stamp_ns, frame.path))
    for (index, stamp_ns, path), puppets in zip(seen, clip.people(), strict=True):
        yield index, stamp_ns, path, puppets


def _entries(tracked: Iterable[Tracked], model: DeformableStructures) -> Iterator[dict[str, Any]]:
    for index, stamp_ns, path, puppets in tracked:
        people = [puppet_entry(puppet, model.tree) for puppet in puppets]
        entry: dict[str, Any] = {"index": index, "stamp_ns": stamp_ns, "puppets": people}
        yield entry | ({"path": path} if path else {})


def _warn(sentence: str) -> None:
    print(f"flowing-puppet track: {sentence}", file=sys.stderr)


@dataclass(frozen=True)
class _Source:
    """Frames with the keypoints `given` for them (or none at all), their rate and number (0 unknown)."""

    frames: Iterable[Detected]
    fps: float
    count: int
    given: bool


def _open(arguments: argparse.Namespace, warn: Callable[[str], None]) -> _Source:
    """The input's frames with the keypoints that it or --init has; `warn` is told what is left out of it."""
    path, init, out = Path(arguments.input), arguments.init, Path(arguments.out)
    if out.resolve() in {Path(name).resolve() for name in (path, init) if name}:
        raise InputError(f"{out} is an input itself: name another output")
    keypoints = None if init is None else read_keypoints(init)
    if is_bag(path):
        # Only bags need the bag stack, which takes a while to import.
        from flowing_puppet_ros.bag.frames import open_bag_frames

        bag = open_bag_frames(path, arguments.topic, arguments.salvage, warn)
        if keypoints is None:
            return _Source(bag, bag.fps, bag.count, bool(bag.detections))
        _check_reach(keypoints, bag.count, arguments)
        return _Source(((frame, keypoints.get(frame.index)) for frame, _ in bag), bag.fps, bag.count, True)
    source = open_frames(path, warn)
    if keypoints is None:
        return _Source(((frame, None) for frame in source), source.fps, source.count, False)
    _check_reach(keypoints, source.count, arguments)
    return _Source(((frame, keypoints.get(frame.index)) for frame in source), source.fps, source.count, True)


def _check_reach(keypoints: dict[int, list[Keypoints]], count: int, arguments: argparse.Namespace) -> None:
    """Refuse keypoints that begin after the last of `count` frames (0 unknown)."""
    first = min(index for index, people in keypoints.items() if people)
    if count and first >= count:
        raise InputError(
            f"{arguments.init} has keypoints from frame {first} on, but {arguments.input} has {count} frames"
        )


def _summarise(arguments: argparse.Namespace, tally: _Tally, seconds: float) -> None:
    ids = sorted(tally.ids)
    if arguments.json:
        counts = {"frames": tally.frames, "frames_with_people": tally.with_people, "ids": ids}
        print(json.dumps({"input": arguments.input, "out": arguments.out} | counts | {"seconds": round(seconds, 3)}))
    else:
        rate = tally.frames / max(seconds, 1e-9)
        names = ", ".join(ids) or "none"
        print(
            f"{arguments.out}: {tally.frames} frames, people in {tally.with_people}, ids {names}, {rate:.1f} frames/s"
        )
