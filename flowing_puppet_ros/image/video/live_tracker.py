# SPDX-License-Identifier: Apache-2.0
"""The tracker of a live stream, with asynchronous detection beside tracking.

A detector run takes longer than an image may wait. It runs beside the tracking, and its result is used at a fixed age,
propagated along the flow to the image that is tracked then. Full-frame detections, which find everybody, are rare;
re-detections in the regions (ROIs) of known people are fast and frequent. When a result is used follows from the stamps
alone: a replay, where each run finishes at once, gives the same puppets as the live node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.arms.viterbi import ArmPathSettings
from flowing_puppet_ros.image.detector.detection import PersonCandidate, PersonDetection
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.networks.choice import load_networks
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.image.tracking.tracker import (
    DetectedInTracks,
    FlowingPuppetTracker,
    TrackedPuppet,
    TrackResult,
)
from flowing_puppet_ros.image.video.detection_worker import DetectedPerson, DetectionWorker, match_to_tracks
from flowing_puppet_ros.image.video.known_people import KnownPeople
from flowing_puppet_ros.image.video.network_tracker import NetworkTracker
from flowing_puppet_ros.image.video.pending_detection import (
    PendingDetection,
    StreamClock,
    propagate_points,
    reduce_flow,
    submit,
    to_ns,
)
from flowing_puppet_ros.image.video.settings import LiveDetectionSettings
from flowing_puppet_ros.image.video.tracklets import TrackletLinker

BUSY_FACTOR = 3.0
"""How much longer a full-frame detection may take while people are tracked and re-detected beside it."""
MAX_PEOPLE = 80
"""Maximum number of people that a detector run looks for."""


@dataclass(slots=True, eq=False)
class _RoiDetection(PendingDetection[DetectedPerson]):
    """A re-detection; `rois` are the candidates by the ids of the people, and of new ones."""

    rois: dict[str, PersonCandidate] = field(default_factory=dict)


def make_live_tracker(
    tracker: FlowingPuppetTracker, settings: LiveDetectionSettings, counters: Counter[str] | None = None
) -> LiveTracker | NetworkTracker:
    """Return what tracks a live stream with the source of people that the settings name.

    Raises:
        InputError: when the source is `neural` and the networks are not installed.
    """
    networks = None if settings.source == "none" else load_networks(settings.source, description=settings.network)
    if networks is not None:
        return NetworkTracker(tracker, settings, networks, counters)
    return LiveTracker(tracker, settings, counters)


class LiveTracker:
    """Runs the detector on some of the images that are tracked, and gives the tracker what it finds."""

    def __init__(
        self,
        tracker: FlowingPuppetTracker,
        settings: LiveDetectionSettings,
        counters: Counter[str] | None = None,
        worker: DetectionWorker | None = None,
    ) -> None:
        """Track with `tracker`; without a `worker` the package's detector is loaded at its first run."""
        self._tracker = tracker
        self._settings = settings
        self._counters: Counter[str] = Counter() if counters is None else counters
        self._worker = worker
        self.reset()

    def reconfigure(self, settings: LiveDetectionSettings) -> None:
        """Go on with other settings."""
        self._settings = settings
        linker = self._known.linker
        linker.min_probability, linker.max_people = self._limits()

    def warm_up(self, image: Image, puppet: TrackedPuppet) -> None:
        """Load the detector and run it on an image of no interest, if it is ever going to run."""
        if self._settings.source != "none":
            neck, face = (puppet.joints[self._tracker.model.joint_names.index(name)] for name in ("neck", "face"))
            place = PersonCandidate(neck, face, puppet.scale * self._tracker.model.shoulder_width, 0.0)
            arms = {puppet.id: ArmFilter(ArmPathSettings())}
            self._load_worker().detect_full_frame(image, self._know_nobody(), 0)
            for _run in range(2):
                self._load_worker().detect_in_rois(image, [place], [puppet], arms)

    def reset(self) -> None:
        """Forget the images; the detector runs on the next one."""
        self._clock = StreamClock()
        self._forget_stream()

    def _forget_stream(self) -> None:
        self._full_frames = 0
        self._previous: tuple[int, Image] | None = None
        self._forget_people()

    def _forget_people(self) -> None:
        self._known = self._know_nobody()
        self._arms: dict[str, ArmFilter] = {}
        self._new: list[PersonCandidate] = []
        self._full_frame: PendingDetection[DetectedPerson] | None = None
        self._roi: _RoiDetection | None = None
        self._full_frame_ns: int | None = None
        self._roi_ns: int | None = None

    def _know_nobody(self) -> KnownPeople:
        return KnownPeople(TrackletLinker(*self._limits(), 1))

    def _limits(self) -> tuple[float, int]:
        return self._settings.min_probability, min(self._tracker.settings.max_people, MAX_PEOPLE)

    def step(
        self, image: Image, stamp_ns: int, flow: FlowPair | None = None, executor: Executor | None = None
    ) -> TrackResult:
        """Track the next `image` (H, W, 3) RGB, with the results of the detector runs that are due.

        `flow` is as `FlowingPuppetTracker.step` takes it. Detector runs go to the `executor`, or finish at once.

            full frame due | people tracked | what is done
            yes            | no             | start tracks in its image, track from there to this one
            yes            | yes            | track; update the known people, re-detect the new ones next
            no             |                | track, with the ROI re-detection that is due, if any
        """
        if not self._clock.advance(image, stamp_ns):
            self._forget_stream()
        full_frame, roi = self._take_due_full_frame(), self._roi if self._is_due(self._roi) else None
        if full_frame is not None and not self._tracker.tracks:
            result = self._start_tracks(full_frame, image, stamp_ns)
        else:
            result = self._track(roi, image, stamp_ns, flow)
            if full_frame is not None and not result.restarted:
                self._update_known_people(full_frame, result)
        self._previous = stamp_ns, image
        if self._full_frame is None:
            self._full_frame = self._run_full_frame(image, stamp_ns, result, executor)
            if not self._tracker.tracks and (full_frame := self._take_due_full_frame()) is not None:
                result = self._start_tracks(full_frame, image, stamp_ns, result)
        if self._roi is None:
            self._roi = self._run_roi(image, stamp_ns, result, executor)
        return result

    def _is_due(self, run: PendingDetection[DetectedPerson] | None) -> bool:
        return run is not None and self._clock.now_ns >= run.due_ns

    def _take_due_full_frame(self) -> PendingDetection[DetectedPerson] | None:
        if not self._is_due(self._full_frame):
            return None
        run, self._full_frame = self._full_frame, None
        assert run is not None
        self._counters["full frames with people"] += bool(run.people.result())
        return run

    def _start_tracks(
        self, run: PendingDetection[DetectedPerson], image: Image, stamp_ns: int, result: TrackResult | None = None
    ) -> TrackResult:
        """Start tracks in the image of a full-frame detection; one long flow leads from there to `image`.

        Where `image` itself was detected in, its `result` so far, without anybody, is given.
        """
        self._roi, self._arms = None, {}
        warnings = [] if result is None else result.warnings
        restarted = result is not None and result.restarted
        if people := run.people.result():
            self._tracker.reset()
            started = self._tracker.step(run.image, run.stamp_ns, [person.keypoints for person in people])
            warnings = [*warnings, *started.warnings]
            self._known.update(
                {p.id: people[p.detection].candidate for p in started.puppets if p.detection is not None}
            )
            if result is not None:
                seen = {p.id: people[p.detection].detection for p in started.puppets if p.detection is not None}
                started = self._refine_arms(started, image, seen)
                return replace(started, warnings=warnings, restarted=restarted)
        if result is not None:
            return result
        result = self._record_flow(self._tracker.step(image, stamp_ns))
        return replace(result, warnings=[*warnings, *result.warnings])

    def _track(self, run: _RoiDetection | None, image: Image, stamp_ns: int, flow: FlowPair | None) -> TrackResult:
        """Track an image, with the result of an ROI re-detection where one is due."""
        if run is None and self._settings.roi_delay == 0:
            return self._track_and_detect(image, stamp_ns, flow)
        if run is None or not self._tracker.tracks or run.flows is None:
            if run is not None:
                self._roi, self._arms = None, {}
            return self._record_flow(self._tracker.step(image, stamp_ns, None, flow))
        assert self._previous is not None
        self._roi = None
        self._counters["ROI re-detections"] += 1
        flow = flow or self._tracker.optical_flow.estimate_at_working_scale(self._previous[1], image)
        size = image.shape[1], image.shape[0]
        move = partial(propagate_points, flows=[*run.flows, reduce_flow(flow[0])], size=size)
        # The arms belong to the detector run until it has finished.
        people = [person.move(move) for person in run.people.result()]
        for arms in self._arms.values():
            arms.predict(partial(propagate_points, flows=run.flows, size=size, keep=True), len(run.flows))
        keypoints = [person.keypoints for person in people]
        result = self._record_flow(self._tracker.step(image, stamp_ns, keypoints, flow, run.rois))
        if result.restarted:
            self._tracker.reset()
            empty = self._tracker.step(image, stamp_ns)
            return replace(empty, warnings=result.warnings, restarted=True)
        matched = {puppet.id: people[puppet.detection] for puppet in result.puppets if puppet.detection is not None}
        self._known.add({identity: person.candidate for identity, person in matched.items()})
        arms_seen = {identity: person.arms for identity, person in matched.items() if person.identity == identity}
        return self._tracker.override_joints(result, arms_seen)

    def _track_and_detect(self, image: Image, stamp_ns: int, flow: FlowPair | None) -> TrackResult:
        """Track an image, with an ROI re-detection in it where the tracks lead."""
        seen: list[DetectedPerson] = []

        def detect(tracks: Sequence[Track], _: FlowPair | None) -> DetectedInTracks:
            rois = self._take_rois({track.id: track.mean for track in tracks}) if tracks else {}
            if not rois:
                return None, None
            self._counters["ROI re-detections"] += 1
            seen.extend(self._load_worker().detect_at(image, list(rois.values())))
            return [person.keypoints for person in seen], rois

        result = self._record_flow(self._tracker.step(image, stamp_ns, flow=flow, detect=detect))
        matched = {puppet.id: seen[puppet.detection] for puppet in result.puppets if puppet.detection is not None}
        self._known.add({identity: person.candidate for identity, person in matched.items()})
        if not seen:
            return result
        return self._refine_arms(result, image, {identity: one.detection for identity, one in matched.items()})

    def _refine_arms(self, result: TrackResult, image: Image, seen: Mapping[str, PersonDetection]) -> TrackResult:
        """Return the result with elbows and wrists by the best hypotheses; `seen` are this image's detections by id."""
        self._keep_arms(result.puppets)
        worker = self._load_worker()
        joints = {
            puppet.id: worker.step_arms(self._arms[puppet.id], image, puppet, seen.get(puppet.id))
            for puppet in result.puppets
        }
        return self._tracker.override_joints(result, joints)

    def _keep_arms(self, puppets: Sequence[TrackedPuppet]) -> None:
        """Keep the filters of these people's arms, and begin those of the new ones."""
        self._arms = {puppet.id: self._arms.get(puppet.id) or ArmFilter(ArmPathSettings()) for puppet in puppets}

    def _record_flow(self, result: TrackResult) -> TrackResult:
        """Return the result; propagate what is pending, and the hypotheses of the arms, to its image."""
        if result.restarted:
            # After a cut nobody is where they were before.
            self._forget_people()
        if self._full_frame is not None:
            self._full_frame.record(result.flow)
        if self._roi is not None:
            self._roi.record(result.flow)
        else:
            for arms in self._arms.values():
                arms.propagate(result.flow, result.grid)
        return result

    def _update_known_people(self, run: PendingDetection[DetectedPerson], result: TrackResult) -> None:
        """Take the places of a full-frame detection; those without a track are re-detected next."""
        self._new = []
        if run.flows is None or result.flow is None:
            return
        run.record(result.flow)
        move = partial(propagate_points, flows=run.flows, size=result.grid.image)
        places = [person.move(move).candidate for person in run.people.result()]
        owners = match_to_tracks(places, result.puppets, self._tracker.model)
        self._known.update({puppet.id: places[index] for index, puppet in owners.items()})
        self._new = [
            place
            for index, place in enumerate(places)
            if index not in owners and np.isfinite([*place.neck, *place.face]).all()
        ]

    def _run_full_frame(
        self, image: Image, stamp_ns: int, result: TrackResult, executor: Executor | None
    ) -> PendingDetection[DetectedPerson] | None:
        """Start a full-frame detection on the image that was just tracked, if it is time for one."""
        settings, people = self._settings, [puppet.id for puppet in result.puppets]
        confirmed = self._known.are_confirmed(people, settings.confirming_full_frames)
        interval = settings.full_frame_interval if confirmed else settings.search_interval
        if self._full_frame_ns is not None and self._clock.now_ns - self._full_frame_ns < to_ns(interval):
            return None
        self._full_frame_ns = self._clock.now_ns
        self._full_frames += 1
        run = partial(self._detect_full_frame, image, self._known, self._full_frames)
        delay = settings.full_frame_delay * (BUSY_FACTOR if people else 1.0)
        return PendingDetection(image, stamp_ns, self._clock.now_ns + to_ns(delay), submit(run, executor))

    def _run_roi(
        self, image: Image, stamp_ns: int, result: TrackResult, executor: Executor | None
    ) -> _RoiDetection | None:
        """Start a re-detection of the known people in the image that was just tracked, if it is time for one."""
        if self._settings.roi_delay == 0:
            return None
        joints = {puppet.id: puppet.joints for puppet in result.puppets}
        rois = self._take_rois(joints)
        if not rois:
            return None
        self._keep_arms(result.puppets)
        run = partial(self._detect_in_rois, image, list(rois.values()), result.puppets, self._arms)
        due_ns = self._clock.now_ns + to_ns(self._settings.roi_delay * len(rois))
        return _RoiDetection(image, stamp_ns, due_ns, submit(run, executor), rois=rois)

    def _take_rois(self, joints: Mapping[str, F64]) -> dict[str, PersonCandidate]:
        """Return where to re-detect people whose joints (J, 2) px are given by id, if it is time for that."""
        rois = self._known.candidates(self._tracker.model.joint_names, joints)
        rois |= {f"new {number}": place for number, place in enumerate(self._new)}
        since = None if self._roi_ns is None else self._clock.now_ns - self._roi_ns
        if not rois or (since is not None and since < to_ns(self._settings.roi_interval * len(rois))):
            return {}
        self._new, self._roi_ns = [], self._clock.now_ns
        return rois

    # The detector is loaded where it runs: not in the thread that tracks.
    def _detect_full_frame(self, image: Image, known: KnownPeople, number: int) -> list[DetectedPerson]:
        return self._load_worker().detect_full_frame(image, known, number)

    def _detect_in_rois(
        self,
        image: Image,
        places: list[PersonCandidate],
        puppets: list[TrackedPuppet],
        arms: dict[str, ArmFilter],
    ) -> list[DetectedPerson]:
        return self._load_worker().detect_in_rois(image, places, puppets, arms)

    def _load_worker(self) -> DetectionWorker:
        if self._worker is None:
            self._worker = DetectionWorker(PartDetector.load(), ArmEvidenceModel.load(self._tracker.model.gender))
        return self._worker
