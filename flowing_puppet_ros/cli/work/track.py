# SPDX-License-Identifier: Apache-2.0
"""What the verb `track` does."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros.bag.storage.paths import is_bag
from flowing_puppet_ros.draw.overlay_video import check_overlay, read_drawn_tracks, write_overlay
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.frame_names import FrameNames, Size
from flowing_puppet_ros.image.formats.keypoint_files import read_keypoints
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.tracks_json import puppet_to_json, write_tracks
from flowing_puppet_ros.image.formats.video_reader import VideoFrame, open_frames
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.networks.sources import NOT_INSTALLED
from flowing_puppet_ros.image.video.clip import Clip, DetectedFrame, TrackedFrame, track_clip, track_live
from flowing_puppet_ros.image.video.settings import ClipSettings
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread


# Held for the whole run: OpenCV makes its threads anew each time that their number changes, here at every frame.
@one_opencv_thread()
@one_blas_thread()
def run(arguments: argparse.Namespace) -> int:
    """Track through the whole input and write the tracks."""
    if arguments.live and arguments.method != "smoothed":
        raise InputError("--live and --method thesis exclude each other: the thesis's loop sees the whole input")
    model = DeformableStructures.load(arguments.model, arguments.parts)
    settings = ClipSettings.from_arguments(arguments)
    if arguments.overlay:
        check_overlay(Path(arguments.overlay))
    networks = load_networks(arguments.source, description=arguments.network)
    source = _open(arguments, _Warnings())
    if networks is None and not source.clip.has_keypoints and arguments.source == "auto":
        source.warnings(NOT_INSTALLED)
    began = time.monotonic()
    people = _track(arguments, source, model, settings, networks)
    tally = _Tally()
    write_tracks(arguments.out, model.joint_names, source.fps, tally.counted(_entries(people, model)))
    if not tally.frames:
        Path(arguments.out).unlink(missing_ok=True)
        raise InputError(f"{arguments.input} has no image that can be used")
    if arguments.overlay:
        _draw(arguments, source.fps)
    _summarise(arguments, tally, time.monotonic() - began)
    return 0


def _track(
    arguments: argparse.Namespace,
    source: _Source,
    model: DeformableStructures,
    settings: ClipSettings,
    networks: KeypointSource | None,
) -> Iterator[TrackedFrame]:
    def progress(frames: Iterable[DetectedFrame], title: str) -> Iterable[DetectedFrame]:
        return tqdm(frames, title, total=source.count or None, unit="frame", disable=None)

    views = MultiViewStructures.load(model.gender, len(model.tree))
    if arguments.live:
        return track_live(
            source.clip,
            model,
            settings,
            networks=networks,
            views=views,
            warn=source.warnings,
            progress=progress,
        )
    return track_clip(
        source.clip,
        model,
        settings,
        method=arguments.method,
        networks=networks,
        views=views,
        warn=source.warnings,
        progress=progress,
    )


def _draw(arguments: argparse.Namespace, fps: float) -> None:
    """Write --overlay: the input again, with what was written to --out."""
    images = ((frame.index, frame.image) for frame, _ in _open(arguments, _Warnings(quiet=True)).clip.frames)
    write_overlay(Path(arguments.overlay), images, read_drawn_tracks(Path(arguments.out)), fps)


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


def _entries(frames: Iterable[TrackedFrame], model: DeformableStructures) -> Iterator[dict[str, Any]]:
    for frame in frames:
        people = [puppet_to_json(puppet, model.tree) for puppet in frame.puppets]
        entry: dict[str, Any] = {"index": frame.index, "stamp_ns": frame.stamp_ns, "puppets": people}
        yield entry | ({"path": frame.path} if frame.path else {})


class _Warnings:
    """Prints each sentence once: the input may be read several times."""

    def __init__(self, quiet: bool = False) -> None:
        self._told: set[str] = set()
        self._quiet = quiet

    def __call__(self, sentence: str) -> None:
        if sentence not in self._told and not self._quiet:
            print(f"flowing-puppet track: {sentence}", file=sys.stderr)
        self._told.add(sentence)


@dataclass(frozen=True)
class _Source:
    """A clip, its frame rate and number of frames (0 unknown), and what its warnings are told."""

    clip: Clip
    fps: float
    count: int
    warnings: _Warnings


def _open(arguments: argparse.Namespace, warnings: _Warnings) -> _Source:
    """Open the input's frames with the keypoints that it or --init has."""
    path, init, out = Path(arguments.input), arguments.init, Path(arguments.out)
    if out.resolve() in {Path(name).resolve() for name in (path, init) if name}:
        raise InputError(f"{out} is an input itself: name another output")
    if is_bag(path):
        # Only bags need the bag stack, which takes a while to import.
        from flowing_puppet_ros.bag.frames import open_bag_frames

        bag = open_bag_frames(path, arguments.topic, arguments.salvage, warnings)
        if init is None:
            return _Source(Clip(bag, bool(bag.detections)), bag.fps, bag.count, warnings)
        images = _Images(bag)
        given = read_keypoints(init, FrameNames(path.stem, count=bag.count, read_size=images.read_size))
        _check_reach(given, bag.count, arguments)
        return _Source(Clip.of(images, given), bag.fps, bag.count, warnings)
    source = open_frames(path, warnings)
    keypoints = None if init is None else read_keypoints(init, FrameNames.of(source))
    if keypoints is not None:
        _check_reach(keypoints, source.count, arguments)
    return _Source(Clip.of(source, keypoints), source.fps, source.count, warnings)


@dataclass(frozen=True)
class _Images:
    """The images of a bag without the detections in it."""

    frames: Iterable[DetectedFrame]

    def __iter__(self) -> Iterator[VideoFrame]:
        return (frame for frame, _ in self.frames)

    def read_size(self, _: int) -> Size | None:
        """Return width and height of the images, px."""
        return next(((frame.image.shape[1], frame.image.shape[0]) for frame in self), None)


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
