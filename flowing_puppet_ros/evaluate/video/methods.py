# SPDX-License-Identifier: Apache-2.0
"""The rows of `evaluate video`: every way to track the people of a clip, from the detector alone to the default.

A row whose name begins with `init-` starts from given keypoints instead of the detector.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.video.truth import People
from flowing_puppet_ros.evidence.image.hands import HandDetectors
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import FlowPair, FlowSettings, working_size
from flowing_puppet_ros.image.arms.evidence import ArmEvidence, ArmEvidenceModel
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.part_detector import DetectorSettings, PartDetector
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.thesis_loop.clip import ThesisClip, evidence_from_keypoints
from flowing_puppet_ros.image.thesis_loop.energy import EnergySettings
from flowing_puppet_ros.image.thesis_loop.loop import LoopSettings
from flowing_puppet_ros.image.tracking.smoothing import SmoothingSettings
from flowing_puppet_ros.image.tracking.track import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet, TrackResult
from flowing_puppet_ros.image.video.detection_jobs import DetectionWorker
from flowing_puppet_ros.image.video.live_tracker import FRAME_NS, LiveTracker, LiveTrackerSettings
from flowing_puppet_ros.image.video.offline_smoother import OfflineSmoother
from flowing_puppet_ros.image.video.tracking_by_detection import DetectingTracker, DetectionSettings, DetectorLike
from flowing_puppet_ros.model.ds.puppet import DeformableStructures


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """One person in one image: `joints` (J, 2) px, NaN where unknown, and `confidence` (J,)."""

    id: str
    joints: F64
    confidence: F64


type Track = list[list[Located]]
"""The people of each frame of a clip."""


@dataclass(frozen=True, slots=True)
class VideoSettings:
    """Settings of all that the rows run."""

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    flow: FlowSettings = field(default_factory=FlowSettings)
    detection: DetectionSettings = field(default_factory=DetectionSettings)
    path: PathSettings = field(default_factory=PathSettings)
    smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)
    loop: LoopSettings = field(default_factory=LoopSettings)
    energy: EnergySettings = field(default_factory=EnergySettings)


@dataclass(slots=True, eq=False)
class _Remembering:
    """A detector that looks at each image once, for all rows."""

    detector: DetectorLike
    _seen: dict[tuple[bytes, DetectorSettings], list[PersonDetection]] = field(default_factory=dict)
    _candidates: dict[bytes, list[PersonCandidate]] = field(default_factory=dict)

    def propose(self, image: U8) -> list[PersonCandidate]:
        key = image.tobytes()
        if key not in self._candidates:
            self._candidates[key] = self.detector.propose(image)
        return self._candidates[key]

    def detect_at(self, image: U8, places: Sequence[PersonCandidate]) -> list[PersonDetection]:
        return self.detector.detect_at(image, places)

    def detect(self, image: U8, settings: DetectorSettings) -> list[PersonDetection]:
        key = image.tobytes(), settings
        if key not in self._seen:
            self._seen[key] = self.detector.detect(image, settings)
        return self._seen[key]


@dataclass(frozen=True, slots=True, eq=False)
class ClipRun:
    """One clip, and what the rows need to run on it. `given` are keypoints to start from, by frame."""

    model: DeformableStructures
    frames: Sequence[VideoFrame]
    detector: DetectorLike
    likelihood: PartLikelihood
    given: People | None
    settings: VideoSettings

    @classmethod
    def load(cls, frames: Sequence[VideoFrame], given: People | None, settings: VideoSettings) -> ClipRun:
        """A run with the shipped model, detector and likelihood."""
        model = DeformableStructures.load()
        detector = _Remembering(PartDetector.load())
        return cls(model, frames, detector, PartLikelihood.load(), given, settings)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of all rows."""
        return self.model.joint_names

    def keypoints(self, frame: VideoFrame) -> Sequence[Keypoints] | None:
        """The given people of a frame; None when nobody looked there."""
        return (self.given or {}).get(frame.index)

    def video(self) -> DetectingTracker:
        """A new tracker with the detector of this run."""
        return DetectingTracker(
            self.tracker(), self.detector, ArmEvidenceModel(self.model, self.likelihood), self.settings.detection
        )

    def tracker(self) -> FlowingPuppetTracker:
        """A new tracker without a detector."""
        return FlowingPuppetTracker(self.model, self.settings.tracker, self.settings.flow)


def _alone(run: ClipRun) -> Track:
    """Whom the detector finds in each frame alone, or the given keypoints as they are."""
    video = run.video()
    return [
        [
            Located(f"d{number}", *joints_from_keypoints(run.model, person))
            for number, person in enumerate(_keypoints(run, video, frame))
        ]
        for frame in run.frames
    ]


def _keypoints(run: ClipRun, video: DetectingTracker, frame: VideoFrame) -> Sequence[Keypoints]:
    if run.given is not None:
        return run.keypoints(frame) or ()
    return [person.keypoints for person in video.detect(frame.image)]


def _steps(
    run: ClipRun, still: bool = False, whole: bool = True
) -> Iterator[tuple[TrackResult, dict[str, ArmEvidence] | None]]:
    """Step through the clip; `still`: nothing is said to move; `whole`: it is searched for people first."""
    video, tracker = run.video(), run.tracker()
    paths = video.search(frame.image for frame in run.frames) if whole and run.given is None else None
    for frame in run.frames:
        flow = _no_flow(run, frame) if still else None
        if run.given is not None:
            yield tracker.step(frame.image, frame.stamp_ns, run.keypoints(frame), flow), None
        else:
            result, found = video.step(frame.image, frame.stamp_ns, flow, paths)
            yield result, video.arm_evidence(frame.image, result, found)


def _no_flow(run: ClipRun, frame: VideoFrame) -> FlowPair:
    width, height = working_size(frame.image.shape, run.settings.flow.max_side)
    nothing = np.zeros((height, width, 2), np.float32)
    return nothing, nothing


def _live(run: ClipRun) -> Track:
    return [_located(result.puppets) for result, _ in _steps(run, whole=False)]


def _node(run: ClipRun) -> Track:
    """What the tracker's node says at 30 Hz of somebody who has been there for some time.

    The clip is shown forth, back and forth again; the last time counts.
    """
    if run.given is not None:
        return _live(run)
    settings = replace(run.settings.flow, preset="fast")
    tracker = FlowingPuppetTracker(run.model, run.settings.tracker, settings)
    looker = DetectionWorker(run.detector, ArmEvidenceModel(run.model, run.likelihood), run.settings.path)
    lookout = LiveTracker(LiveTrackerSettings(), tracker, Counter(), looker)
    shown = [*run.frames, *run.frames[::-1], *run.frames]
    results = [lookout.step(frame.image, number * FRAME_NS, None, None) for number, frame in enumerate(shown)]
    return [_located(result.puppets) for result in results[-len(run.frames) :]]


def _whole(run: ClipRun, still: bool = False) -> Track:
    clip = OfflineSmoother(run.model, run.settings.smoothing, run.settings.path)
    for result, sights in _steps(run, still):
        clip.add(result, sights)
    return [_located(puppets) for puppets in clip.people()]


def _unflowed(run: ClipRun) -> Track:
    """The default without any use of the flow: each image decides alone."""
    settings = replace(
        run.settings,
        path=replace(run.settings.path, flow_strength=0.0),
        smoothing=replace(run.settings.smoothing, flow_weight=0.0),
    )
    return _whole(replace(run, settings=settings), still=True)


def _thesis(run: ClipRun, flow: bool = True, hands: bool = True) -> Track:
    """The loop of the thesis, without the flow in propagation and likelihood, or without hands, where so told."""
    loop, energy = run.settings.loop, run.settings.energy
    if not flow:
        loop, energy = replace(loop, carried=0), replace(energy, forward=False, backward=False)
    if not hands:
        energy = replace(energy, hand_weight=0.0)
    clip = ThesisClip(run.model, HandDetectors.load(), loop, energy)
    for frame, (result, sights) in zip(run.frames, _steps(run), strict=True):
        if sights is None:
            given = evidence_from_keypoints(run.model, run.likelihood, frame.image, result, run.keypoints(frame))
            clip.add(result, given)
        else:
            clip.add(result, sights)
    return [_located(puppets) for puppets in clip.people()]


def _located(puppets: Sequence[TrackedPuppet]) -> list[Located]:
    return [Located(puppet.id, puppet.joints, puppet.confidence) for puppet in puppets]


METHODS: Mapping[str, Callable[[ClipRun], Track]] = {
    "detector": _alone,
    "node": _node,
    "live": _live,
    "default-still": lambda run: _whole(run, still=True),
    "default-noflow": _unflowed,
    "default": _whole,
    "thesis-noflow": lambda run: _thesis(run, flow=False),
    "thesis-nohands": lambda run: _thesis(run, hands=False),
    "thesis": _thesis,
}
"""Rows by name. `still`: the flow says that nothing moves; `noflow`: it is not used for anything that is judged."""

MEDIAN = "-median"
INIT = "init-"


def all_names(with_init: bool) -> list[str]:
    """The rows that are measured when none is chosen."""
    names = [*METHODS]
    names += [f"{name}{MEDIAN}" for name in ("detector", "thesis")]
    from_init = ("detector", f"detector{MEDIAN}", "live", "default", f"thesis{MEDIAN}")
    return names + [f"{INIT}{name}" for name in from_init] if with_init else names


def checked_names(names: Sequence[str], with_init: bool) -> list[str]:
    """The rows that are asked for; InputError for one that is unknown or has nothing to start from."""
    for name in names:
        bare = name.removesuffix(MEDIAN)
        if bare.removeprefix(INIT) not in METHODS:
            raise InputError(
                f"there is no method {name!r}; known are {', '.join(METHODS)}, each also as {INIT}NAME, from given"
                f" keypoints, and as NAME{MEDIAN}, with a median filter over three frames"
            )
        if bare.startswith(INIT) and not with_init:
            raise InputError(f"the method {name} starts from keypoints: name them with --init")
    return list(dict.fromkeys(names))


def run_method(name: str, run: ClipRun) -> Track:
    """The people of each frame by one of the rows, before any median filter."""
    if not name.startswith(INIT):
        run = replace(run, given=None)
    return METHODS[name.removeprefix(INIT)](run)


def median_filtered(track: Track) -> Track:
    """The median over three frames of every joint of who is in all three (thesis, "Experiments" on video)."""
    known = [{person.id: person.joints for person in people} for people in track]
    filtered = []
    for k, people in enumerate(track):
        around: list[dict[str, Any]] = known[max(k - 1, 0) : k + 2]
        kept = []
        for person in people:
            places = [there[person.id] for there in around if person.id in there]
            middle = np.median(places, axis=0) if len(places) == 3 else person.joints
            kept.append(replace(person, joints=middle))
        filtered.append(kept)
    return filtered
