# SPDX-License-Identifier: Apache-2.0
"""Track the people of a recorded clip: `track_clip` with the whole clip in view, `track_live` image by image.

clip = Clip.of(open_frames("video.mp4"))
for frame in track_clip(clip, DeformableStructures.load()):
    for puppet in frame.puppets:
        print(frame.index, puppet.id, puppet.joints)
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Literal

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.thesis_loop.clip import ThesisClip, evidence_from_keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet, TrackResult
from flowing_puppet_ros.image.video.detection_worker import DetectionWorker
from flowing_puppet_ros.image.video.live_tracker import LiveTracker
from flowing_puppet_ros.image.video.network_tracker import NetworkTracker
from flowing_puppet_ros.image.video.offline_smoother import OfflineSmoother
from flowing_puppet_ros.image.video.settings import (
    EVERY_IMAGE,
    ClipDetectionSettings,
    ClipSettings,
    LiveDetectionSettings,
)
from flowing_puppet_ros.image.video.tracklets import Tracklet, TrackletLinker
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.process.threads import one_opencv_thread

type Method = Literal["smoothed", "thesis"]
type DetectedFrame = tuple[VideoFrame, Sequence[Keypoints] | None]
"""A frame and the people that somebody found in it; None where nobody looked."""
type Progress = Callable[[Iterable[DetectedFrame], str], Iterable[DetectedFrame]]
"""Passes frames through and shows how far they are, under a title."""


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """Frames in order, which can be read more than once; `has_keypoints`: people come with them, none are detected."""

    frames: Iterable[DetectedFrame]
    has_keypoints: bool = False

    @classmethod
    def of(cls, frames: Iterable[VideoFrame], keypoints: Mapping[int, Sequence[Keypoints]] | None = None) -> Clip:
        """Make a clip of frames, with the people of some of them by the frame's index, or with none."""
        return cls(_Paired(frames, keypoints or {}), keypoints is not None)


@dataclass(frozen=True, slots=True, eq=False)
class _Paired:
    frames: Iterable[VideoFrame]
    keypoints: Mapping[int, Sequence[Keypoints]]

    def __iter__(self) -> Iterator[DetectedFrame]:
        for frame in self.frames:
            yield frame, self.keypoints.get(frame.index)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """The people of one frame."""

    index: int
    stamp_ns: int
    path: str
    puppets: list[TrackedPuppet]


def track_clip(
    clip: Clip,
    model: DeformableStructures,
    settings: ClipSettings | None = None,
    *,
    method: Method = "smoothed",
    worker: DetectionWorker | None = None,
    networks: KeypointSource | None = None,
    views: MultiViewStructures | None = None,
    flow_of: Callable[[VideoFrame], FlowPair] | None = None,
    warn: Callable[[str], None] | None = None,
    progress: Progress = lambda frames, title: frames,
) -> Iterator[TrackedFrame]:
    """Track the people of a clip with all of it in view.

    Args:
        clip: its frames, with the people in them where these are known; else the detector finds them, in a pass of
            its own over the frames.
        model: the puppet.
        settings: of tracker, flow, detection, arms and smoothing.
        method: `smoothed`: the best path of the arms' hypotheses, then all joints smoothed along the flow; `thesis`:
            the loop of the thesis's video chapter (Eqs. 33-37), a slow reference.
        worker: the detector, and the model that scores arms; the package's own when not given.
        networks: find the people instead of the detector.
        views: puppets for people who are seen from the side; `model` for everybody when not given.
        flow_of: (forward, backward) flow to a frame from the one before; computed when not given.
        warn: is told of what is left out; without it the first unusable frame is an error.
        progress: shows how far the passes over the frames are.

    Yields:
        The people of every frame that can be used, in order.

    Raises:
        InputError: when a frame cannot be used and `warn` is not given.
    """
    settings = settings or ClipSettings()
    run = _ClipRun(clip, model, views, settings, method, flow_of, warn)
    collector = run.collector()
    stamps = []
    if clip.has_keypoints:
        steps = run.track_keypoints(progress)
    elif networks is not None:
        steps = run.track_networks(networks, progress)
    else:
        steps = run.track_detections(worker, progress)
    for frame, result, evidence in steps:
        collector.add(result, evidence)
        stamps.append((frame.index, frame.stamp_ns, frame.path))
    for stamp, puppets in zip(stamps, collector.people(), strict=True):
        yield TrackedFrame(*stamp, puppets)


def track_live(
    clip: Clip,
    model: DeformableStructures,
    settings: ClipSettings | None = None,
    detection: LiveDetectionSettings = EVERY_IMAGE,
    *,
    worker: DetectionWorker | None = None,
    networks: KeypointSource | None = None,
    views: MultiViewStructures | None = None,
    warn: Callable[[str], None] | None = None,
    progress: Progress = lambda frames, title: frames,
) -> Iterator[TrackedFrame]:
    """Track the people of a clip as a live node does, with no frame after the current one in view.

    Arguments are those of `track_clip`; `detection` says when the detector runs, by default in every image.
    """
    run = _ClipRun(clip, model, views, settings or ClipSettings(), "smoothed", None, warn)
    tracker = run.make_tracker()
    live: LiveTracker | NetworkTracker
    if networks is None:
        live = LiveTracker(tracker, detection, worker=worker)
    else:
        live = NetworkTracker(tracker, detection, networks)

    def step(frame: VideoFrame, keypoints: Sequence[Keypoints] | None) -> tuple[TrackResult, None]:
        if clip.has_keypoints:
            return tracker.step(frame.image, frame.stamp_ns, keypoints), None
        return live.step(frame.image, frame.stamp_ns), None

    for frame, result, _ in run.step_through(progress(clip.frames, "track"), step):
        yield TrackedFrame(frame.index, frame.stamp_ns, frame.path, result.puppets)


def find_people(
    clip: Clip, worker: DetectionWorker, settings: ClipDetectionSettings, max_people: int, progress: Progress
) -> list[Tracklet]:
    """Detect the people of a whole clip before it is tracked; frames that cannot be used are passed over."""
    linker = TrackletLinker(settings.min_probability, max_people, settings.stride)
    for number, (frame, _) in enumerate(progress(clip.frames, "detect")):
        if number % settings.stride == 0:
            with contextlib.suppress(InputError), one_opencv_thread():
                linker.add(number, worker.detector.propose(frame.image))
    return linker.link()


@dataclass(frozen=True, slots=True, eq=False)
class _ClipRun:
    """One pass of a tracker through a clip. The evidence that it yields is what its collector takes."""

    clip: Clip
    model: DeformableStructures
    views: MultiViewStructures | None
    settings: ClipSettings
    method: Method
    flow_of: Callable[[VideoFrame], FlowPair] | None
    warn: Callable[[str], None] | None

    def collector(self) -> Any:
        """Return what takes the results of all frames and then gives the people of each."""
        if self.method == "thesis":
            thesis = self.settings.thesis
            return ThesisClip(self.model, HandDetectors.load(), thesis.loop, thesis.energy)
        return OfflineSmoother(self.model, self.settings.smoothing, self.settings.arms)

    def track_keypoints(self, progress: Progress) -> Iterator[tuple[VideoFrame, TrackResult, Any]]:
        """Track the people who come with the frames."""
        tracker = self.make_tracker()
        likelihood = self._load_likelihood()

        def step(frame: VideoFrame, keypoints: Sequence[Keypoints] | None) -> tuple[TrackResult, Any]:
            result = tracker.step(frame.image, frame.stamp_ns, keypoints, self._flow(frame))
            return result, self._extract_evidence(likelihood, frame, result, keypoints)

        yield from self.step_through(progress(self.clip.frames, "track"), step)

    def track_networks(
        self, networks: KeypointSource, progress: Progress
    ) -> Iterator[tuple[VideoFrame, TrackResult, Any]]:
        """Track the people whom the networks find in each frame, with a close look at where the tracks lead."""
        live = NetworkTracker(self.make_tracker(), EVERY_IMAGE, networks)
        likelihood = self._load_likelihood()

        def step(frame: VideoFrame, _: Sequence[Keypoints] | None) -> tuple[TrackResult, Any]:
            result = live.step(frame.image, frame.stamp_ns, self._flow(frame))
            return result, self._extract_evidence(likelihood, frame, result, live.people)

        yield from self.step_through(progress(self.clip.frames, "track"), step)

    def track_detections(
        self, worker: DetectionWorker | None, progress: Progress
    ) -> Iterator[tuple[VideoFrame, TrackResult, Any]]:
        """Detect the people of the whole clip, then track them where their tracklets lead."""
        worker = worker or DetectionWorker(PartDetector.load(), ArmEvidenceModel.load(self.model.gender))
        tracker = self.make_tracker()
        tracklets = find_people(self.clip, worker, self.settings.detection, self.settings.tracker.max_people, progress)

        numbers = count()

        def step(frame: VideoFrame, _: Sequence[Keypoints] | None) -> tuple[TrackResult, Any]:
            number = next(numbers)
            places = [place for tracklet in tracklets if (place := tracklet.at(number)) is not None]
            found = worker.detector.detect_at(frame.image, places)
            keypoints = [person.keypoints for person in found]
            result = tracker.step(frame.image, frame.stamp_ns, keypoints, self._flow(frame))
            return result, {
                puppet.id: worker.evidence_model.extract(
                    frame.image, puppet, None if puppet.detection is None else found[puppet.detection]
                )
                for puppet in result.puppets
            }

        yield from self.step_through(progress(self.clip.frames, "track"), step)

    def step_through(
        self,
        frames: Iterable[DetectedFrame],
        step: Callable[[VideoFrame, Sequence[Keypoints] | None], tuple[TrackResult, Any]],
    ) -> Iterator[tuple[VideoFrame, TrackResult, Any]]:
        """Step through the frames; one that cannot be used is warned of and left out."""
        last = ""
        for frame, keypoints in frames:
            try:
                with one_opencv_thread():
                    result, evidence = step(frame, keypoints)
            except InputError as error:
                if self.warn is None:
                    raise
                self.warn(f"frame {frame.index}: {error}")
                continue
            for warning in result.warnings:
                if warning != last and self.warn is not None:
                    self.warn(f"frame {frame.index}: {warning}")
                last = warning
            yield frame, result, evidence

    def make_tracker(self) -> FlowingPuppetTracker:
        """Return a tracker that has seen nothing."""
        return FlowingPuppetTracker(self.model, self.settings.tracker, self.settings.flow, self.views)

    def _load_likelihood(self) -> PartLikelihood | None:
        return PartLikelihood.load() if self.method == "thesis" else None

    def _extract_evidence(
        self,
        likelihood: PartLikelihood | None,
        frame: VideoFrame,
        result: TrackResult,
        people: Sequence[Keypoints] | None,
    ) -> Any:
        """Return what the loop of the thesis takes of a frame; None where it is not what is run."""
        if likelihood is None:
            return None
        return evidence_from_keypoints(self.model, likelihood, frame.image, result, people)

    def _flow(self, frame: VideoFrame) -> FlowPair | None:
        return None if self.flow_of is None else self.flow_of(frame)
