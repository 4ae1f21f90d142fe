# SPDX-License-Identifier: Apache-2.0
"""The rows of `evaluate video`: every way to track the people of a clip, from the detector alone to the default.

A row whose name begins with `init-` starts from given keypoints instead of the detector, one that begins with
`networks-` from the keypoint networks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.video.truth import PeopleByFrame
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import FlowPair, working_size
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.interface import DetectorLike
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.formats.video_reader import VideoFrame
from flowing_puppet_ros.image.networks.choice import are_installed, load_networks
from flowing_puppet_ros.image.networks.files import REMEDY
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.settings import DetectorSettings
from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
from flowing_puppet_ros.image.video.clip import Clip, Method, TrackedFrame, track_clip, track_live
from flowing_puppet_ros.image.video.detection_worker import DetectionWorker
from flowing_puppet_ros.image.video.pending_detection import FRAME_NS
from flowing_puppet_ros.image.video.settings import ClipSettings, LiveDetectionSettings
from flowing_puppet_ros.image.video.tracklets import FIRST
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MAX_PEOPLE = 80


@dataclass(frozen=True, slots=True, eq=False)
class LocatedPerson:
    """One person in one image: `joints` (J, 2) px, NaN where unknown, and `confidence` (J,)."""

    id: str
    joints: F64
    confidence: F64


type ClipTrack = list[list[LocatedPerson]]
"""The people of each frame of a clip."""


@dataclass(slots=True, eq=False)
class _CachedDetector:
    """A detector that runs on each image once, for all rows."""

    detector: DetectorLike
    _detections: dict[tuple[bytes, DetectorSettings], list[PersonDetection]] = field(default_factory=dict)
    _candidates: dict[bytes, list[PersonCandidate]] = field(default_factory=dict)

    def propose(self, image: Image) -> list[PersonCandidate]:
        key = image.tobytes()
        if key not in self._candidates:
            self._candidates[key] = self.detector.propose(image)
        return self._candidates[key]

    def detect_at(self, image: Image, candidates: Sequence[PersonCandidate]) -> list[PersonDetection]:
        return self.detector.detect_at(image, candidates)

    def detect(self, image: Image, settings: DetectorSettings) -> list[PersonDetection]:
        key = image.tobytes(), settings
        if key not in self._detections:
            self._detections[key] = self.detector.detect(image, settings)
        return self._detections[key]


@dataclass(frozen=True, slots=True, eq=False)
class ClipRun:
    """One clip, and what the rows need to run on it; `given` are keypoints to start from, by frame."""

    model: DeformableStructures
    frames: Sequence[VideoFrame]
    worker: DetectionWorker
    given: PeopleByFrame | None
    settings: ClipSettings
    networks: KeypointSource | None = None
    views: MultiViewStructures | None = None

    @classmethod
    def load(cls, frames: Sequence[VideoFrame], given: PeopleByFrame | None, settings: ClipSettings) -> ClipRun:
        """Load the shipped model, detector and likelihood."""
        model = DeformableStructures.load()
        worker = DetectionWorker(_CachedDetector(PartDetector.load()), ArmEvidenceModel(model, PartLikelihood.load()))
        return cls(model, frames, worker, given, settings, views=MultiViewStructures.load())

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of all rows."""
        return self.model.joint_names

    def clip(self) -> Clip:
        """Return the clip with the given keypoints, if there are any."""
        return Clip.of(self.frames, self.given)

    def track(self, method: Method = "smoothed", flow_of: Callable[[VideoFrame], FlowPair] | None = None) -> ClipTrack:
        """Track the clip with all of it in view."""
        return _locate(
            track_clip(
                self.clip(),
                self.model,
                self.settings,
                method=method,
                worker=self.worker,
                networks=self.networks,
                views=self.views,
                flow_of=flow_of,
            )
        )


def _detect_alone(run: ClipRun) -> ClipTrack:
    """Take whom the detector finds in each frame alone, or the given keypoints as they are."""
    return [
        [
            LocatedPerson(f"d{number}", *joints_from_keypoints(run.model, person))
            for number, person in enumerate(_keypoints(run, frame))
        ]
        for frame in run.frames
    ]


def _keypoints(run: ClipRun, frame: VideoFrame) -> Sequence[Keypoints]:
    if run.given is not None:
        return run.given.get(frame.index) or ()
    if run.networks is not None:
        return [person.keypoints for person in run.networks.find(frame.image)]
    people, minimum = min(run.settings.tracker.max_people, MAX_PEOPLE), run.settings.detection.min_probability
    settings = DetectorSettings(min_confidence=FIRST * minimum, max_people=people, mirrored=False)
    found = run.worker.detector.detect(frame.image, settings)
    return [person.keypoints for turn, person in enumerate(found) if turn == 0 or person.confidence >= minimum]


def _zero_flow(run: ClipRun, frame: VideoFrame) -> FlowPair:
    width, height = working_size(frame.image.shape, run.settings.flow.max_side)
    nothing = np.zeros((height, width, 2), np.float32)
    return nothing, nothing


def _track_live(run: ClipRun) -> ClipTrack:
    return _locate(
        track_live(run.clip(), run.model, run.settings, worker=run.worker, networks=run.networks, views=run.views)
    )


def _track_as_node(run: ClipRun) -> ClipTrack:
    """Track as the node does at 30 Hz, somebody who has been there for some time.

    The clip is played forwards, backwards and forwards again; the last time counts.
    """
    if run.given is not None:
        return _track_live(run)
    settings = replace(run.settings, flow=replace(run.settings.flow, preset="fast"))
    played = [*run.frames, *run.frames[::-1], *run.frames]
    stamped = [replace(frame, index=k, stamp_ns=k * FRAME_NS) for k, frame in enumerate(played)]
    frames = track_live(
        Clip.of(stamped),
        run.model,
        settings,
        LiveDetectionSettings(),
        worker=run.worker,
        networks=run.networks,
        views=run.views,
    )
    return _locate(frames)[-len(run.frames) :]


def _track_still(run: ClipRun) -> ClipTrack:
    return run.track(flow_of=lambda frame: _zero_flow(run, frame))


def _track_without_flow(run: ClipRun) -> ClipTrack:
    """Track by the default without any use of the flow: each image decides alone."""
    settings = replace(
        run.settings,
        arms=replace(run.settings.arms, flow_strength=0.0),
        smoothing=replace(run.settings.smoothing, flow_weight=0.0),
    )
    return _track_still(replace(run, settings=settings))


def _track_by_thesis(run: ClipRun, flow: bool = True, hands: bool = True) -> ClipTrack:
    """Track by the loop of the thesis; without `flow` in propagation and likelihood, or without `hands`."""
    loop, energy = run.settings.thesis.loop, run.settings.thesis.energy
    if not flow:
        loop, energy = replace(loop, max_propagated=0), replace(energy, forward_flow=False, backward_flow=False)
    if not hands:
        energy = replace(energy, hand_weight=0.0)
    thesis = replace(run.settings.thesis, loop=loop, energy=energy)
    return replace(run, settings=replace(run.settings, thesis=thesis)).track("thesis")


def _locate(frames: Iterable[TrackedFrame]) -> ClipTrack:
    return [[_located(puppet) for puppet in frame.puppets] for frame in frames]


def _located(puppet: TrackedPuppet) -> LocatedPerson:
    return LocatedPerson(puppet.id, puppet.joints, puppet.confidence)


METHODS: Mapping[str, Callable[[ClipRun], ClipTrack]] = {
    "detector": _detect_alone,
    "node": _track_as_node,
    "live": _track_live,
    "default-still": _track_still,
    "default-noflow": _track_without_flow,
    "default": lambda run: run.track(),
    "thesis-noflow": lambda run: _track_by_thesis(run, flow=False),
    "thesis-nohands": lambda run: _track_by_thesis(run, hands=False),
    "thesis": _track_by_thesis,
}
"""Rows by name. `still`: the flow says that nothing moves; `noflow`: it is not used for anything that is scored."""

MEDIAN = "-median"
INIT, NETWORKS = "init-", "networks-"


def all_names(with_init: bool) -> list[str]:
    """Return the rows that are measured when none is chosen."""
    names = [*METHODS]
    names += [f"{name}{MEDIAN}" for name in ("detector", "thesis")]
    if are_installed():
        names += [f"{NETWORKS}{name}" for name in ("detector", "node", "live", "default")]
    from_init = ("detector", f"detector{MEDIAN}", "live", "default", f"thesis{MEDIAN}")
    return names + [f"{INIT}{name}" for name in from_init] if with_init else names


def check_names(names: Sequence[str], with_init: bool) -> list[str]:
    """Return the rows that are asked for; InputError for one that is unknown or has nothing to start from."""
    for name in names:
        bare = name.removesuffix(MEDIAN)
        if bare.removeprefix(INIT if bare.startswith(INIT) else NETWORKS) not in METHODS:
            raise InputError(
                f"there is no method {name!r}; known are {', '.join(METHODS)}, each also as {INIT}NAME, from given"
                f" keypoints, as {NETWORKS}NAME, from the keypoint networks, and as NAME{MEDIAN}, with a median filter"
                " over three frames"
            )
        if bare.startswith(INIT) and not with_init:
            raise InputError(f"the method {name} starts from keypoints: name them with --init")
        if bare.startswith(NETWORKS) and not are_installed():
            raise InputError(f"the method {name} needs the keypoint networks, which are not installed: {REMEDY}")
    return list(dict.fromkeys(names))


def run_method(name: str, run: ClipRun) -> ClipTrack:
    """Return the people of each frame by one of the rows, before any median filter."""
    if not name.startswith(INIT):
        run = replace(run, given=None)
    if name.startswith(NETWORKS):
        run = replace(run, networks=load_networks("neural"))
    return METHODS[name.removeprefix(INIT).removeprefix(NETWORKS)](run)


def filter_by_median(track: ClipTrack) -> ClipTrack:
    """Return the median over three frames of the joints of who is in all three (thesis, video, "Experiments")."""
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
