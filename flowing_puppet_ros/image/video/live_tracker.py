# SPDX-License-Identifier: Apache-2.0
"""When the detector looks at an image of a live stream, and what its answer says of a later image.

A look takes longer than an image may wait, so it runs beside the tracking and its answer is used at a fixed age,
carried there along the flow. Searches of the whole image are rare; glances at the known people are quick and many. When
an answer is used follows from the stamps alone: a replay, where each look is finished at once, gives the same puppets
as the live node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Flow, Image
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.image.arms.evidence import ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import ArmFilter
from flowing_puppet_ros.image.arms.viterbi import PathSettings
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.detector.part_detector import PartDetector
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackedPuppet, TrackResult
from flowing_puppet_ros.image.video.detection_jobs import DetectedPerson, DetectionWorker, match_to_tracks
from flowing_puppet_ros.image.video.detection_memory import KnownPeople
from flowing_puppet_ros.image.video.tracklets import TrackletLinker
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.units import NANOSECONDS

FRAME_NS = NANOSECONDS // 30
"""What is taken to have passed when a stamp does not go on (drivers that stamp nothing)."""
MAX_GAP_NS = 10 * NANOSECONDS
"""What is counted at most between two images."""
BESIDE = 3.0
"""How much longer a search may take while people are tracked and glanced at beside it."""
COARSE = 2
"""Flow is kept at this share of its resolution: a keypoint moves with its surroundings, and less memory is taken."""


@dataclass(frozen=True)
class LiveTrackerSettings(Settings):
    """When the detector looks for people."""

    detect: bool = setting(True, "find people by itself when nobody publishes detections")
    detect_interval: float = setting(
        2.0, "time from one search for people to the next while some are known", unit="s", low=0.05, high=3600.0
    )
    search_interval: float = setting(0.7, "the same while nobody is known", unit="s", low=0.05, high=3600.0)
    detect_delay: float = setting(
        0.4, "age at which the answer of a search is used; thrice that while people are tracked", unit="s", low=0.0,
        high=10.0,
    )  # fmt: skip
    glance_interval: float = setting(
        0.2, "time from one glance at the known people to the next, for each of them", unit="s", low=0.0, high=3600.0
    )
    glance_delay: float = setting(
        0.13, "age at which the answer of a glance is used, for each person in it", unit="s", low=0.0, high=10.0
    )
    least_person: float = setting(0.3, "probability from which a detected person is tracked", low=0.0, high=1.0)


@dataclass(slots=True, eq=False)
class _PendingDetection:
    """An image that is being looked at, when its answer is due, and the flow since then (None: broken off).

    `glanced` are the places of a glance by whom they belong to, and of people who are new; empty for a search.
    """

    image: Image
    stamp_ns: int
    due_ns: int
    seen: Future[list[DetectedPerson]]
    roi: dict[str, PersonCandidate] = field(default_factory=dict)
    flows: list[Flow] | None = field(default_factory=list)

    def record(self, flow: FlowPair | None) -> None:
        """Take the flow to the next image."""
        if flow is None:
            self.flows = None
        elif self.flows is not None:
            self.flows.append(_coarse(flow[0]))


class LiveTracker:
    """Has the detector look at some of the images that are tracked, and the tracker told whom it saw."""

    def __init__(
        self,
        settings: LiveTrackerSettings,
        tracker: FlowingPuppetTracker,
        counters: Counter[str],
        looker: DetectionWorker | None = None,
    ) -> None:
        """Without a `looker` load none yet: whoever publishes detections needs no detector."""
        self._looker = looker
        self._tracker = tracker
        self._settings = settings
        self._counters = counters
        self.reset()

    def reconfigure(self, settings: LiveTrackerSettings) -> None:
        """Go on with these settings."""
        self._settings = settings
        self._watch.searches.least, self._watch.searches.most = self._limits()

    def warm_up(self, image: Image, puppet: TrackedPuppet) -> None:
        """Load the detector and have it look at an image of no interest, if it will ever look at any."""
        if self._settings.detect:
            neck, face = (puppet.joints[self._tracker.model.joint_names.index(name)] for name in ("neck", "face"))
            place = PersonCandidate(neck, face, puppet.scale * self._tracker.model.shoulder_width, 0.0)
            arms = {puppet.id: ArmFilter(PathSettings())}
            self._detect_full_frame(image, self._forget_people(), 0)
            for _look in range(2):
                self._detect_in_rois(image, [place], [puppet], arms)

    def reset(self) -> None:
        """Forget the images; the next one is looked at."""
        self._now_ns = 0
        self._searches = 0
        self._previous: tuple[int, Image] | None = None
        self._forget()

    def _forget(self) -> None:
        """Know nobody, and look for people in the next image."""
        self._watch = self._forget_people()
        self._arms: dict[str, ArmFilter] = {}
        self._new: list[PersonCandidate] = []
        self._search_look: _PendingDetection | None = None
        self._glance_look: _PendingDetection | None = None
        self._searched_ns: int | None = None
        self._glanced_ns: int | None = None

    def _forget_people(self) -> KnownPeople:
        return KnownPeople(TrackletLinker(*self._limits(), 1))

    def _limits(self) -> tuple[float, int]:
        return self._settings.least_person, min(self._tracker.settings.most_people, 80)

    def step(self, image: Image, stamp_ns: int, flow: FlowPair | None, beside: Executor | None) -> TrackResult:
        """Track the next `image` (H, W, 3) RGB, with what the looks saw whose answers are due.

        `flow` is as `FlowingPuppetTracker.step` takes it; a look runs on the executor `beside`, or at once.
        """
        self._pass_time(image, stamp_ns)
        search, glance = self._due(self._search_look), self._due(self._glance_look)
        if search is not None:
            self._search_look = None
            self._counters["searches with people"] += bool(search.seen.result())
        if search is not None and not self._tracker.people:
            result = self._start_from_search(search, image, stamp_ns)
        else:
            result = self._track_with_detections(glance, image, stamp_ns, flow)
            if search is not None and not result.restarted:
                self._learn(search, result)
        self._previous = stamp_ns, image
        if self._search_look is None:
            self._search_look = self._next_full_frame(image, stamp_ns, result, beside)
        if self._glance_look is None:
            self._glance_look = self._next_roi(image, stamp_ns, result, beside)
        return result

    def _pass_time(self, image: Image, stamp_ns: int) -> None:
        previous = self._previous
        if previous is not None and (stamp_ns < previous[0] or image.shape != previous[1].shape):
            self.reset()
        elif previous is not None:
            passed = stamp_ns - previous[0]
            self._now_ns += min(passed, MAX_GAP_NS) if passed > 0 else FRAME_NS

    def _due(self, look: _PendingDetection | None) -> _PendingDetection | None:
        return look if look is not None and self._previous is not None and self._now_ns >= look.due_ns else None

    def _start_from_search(self, search: _PendingDetection, image: Image, stamp_ns: int) -> TrackResult:
        """Begin tracks in the image that was searched; one long flow leads from there to this one."""
        self._glance_look, self._arms, warnings = None, {}, []
        if found := search.seen.result():
            self._tracker.reset()
            begun = self._tracker.step(search.image, search.stamp_ns, [person.keypoints for person in found])
            warnings = begun.warnings
            self._watch.update({p.id: found[p.detection].candidate for p in begun.puppets if p.detection is not None})
        result = self._record_flow(self._tracker.step(image, stamp_ns))
        return replace(result, warnings=[*warnings, *result.warnings])

    def _track_with_detections(
        self, glance: _PendingDetection | None, image: Image, stamp_ns: int, flow: FlowPair | None
    ) -> TrackResult:
        """Track an image, with the answer of a glance where one is due."""
        if glance is None or not self._tracker.people or glance.flows is None:
            if glance is not None:
                self._glance_look, self._arms = None, {}
            return self._record_flow(self._tracker.step(image, stamp_ns, None, flow))
        assert self._previous is not None
        self._glance_look = None
        self._counters["glances"] += 1
        flow = flow or self._tracker.optical_flow.at_working_scale(self._previous[1], image)
        size = image.shape[1], image.shape[0]
        move = partial(propagate_points, flows=[*glance.flows, _coarse(flow[0])], size=size)
        # The arms are the glance's until it has ended.
        seen = [person.move(move) for person in glance.seen.result()]
        for arms in self._arms.values():
            arms.predict(partial(propagate_points, flows=glance.flows, size=size, keep=True), len(glance.flows))
        keypoints = [person.keypoints for person in seen]
        result = self._record_flow(self._tracker.step(image, stamp_ns, keypoints, flow, glance.roi))
        if result.restarted:
            self._tracker.reset()
            empty = self._tracker.step(image, stamp_ns)
            return replace(empty, warnings=result.warnings, restarted=True)
        owned = {puppet.id: seen[puppet.detection] for puppet in result.puppets if puppet.detection is not None}
        self._watch.add({identity: person.candidate for identity, person in owned.items()})
        arms_seen = {identity: person.arms for identity, person in owned.items() if person.identity == identity}
        return self._tracker.override_joints(result, arms_seen)

    def _record_flow(self, result: TrackResult) -> TrackResult:
        """The same result; what is known of the image before is carried to its image."""
        if result.restarted:
            # Nobody stands any more where they stood before a cut.
            self._forget()
        if self._search_look is not None:
            self._search_look.record(result.flow)
        if self._glance_look is not None:
            self._glance_look.record(result.flow)
        else:
            for arms in self._arms.values():
                arms.propagate(result.flow, result.grid)
        return result

    def _learn(self, search: _PendingDetection, result: TrackResult) -> None:
        """Take the places of a search: those where nobody is tracked are glanced at next."""
        self._new = []
        if search.flows is None or result.flow is None:
            return
        search.record(result.flow)
        places = [
            person.move(partial(propagate_points, flows=search.flows, size=result.grid.image)).candidate
            for person in search.seen.result()
        ]
        owners = match_to_tracks(places, result.puppets, self._tracker.model)
        self._watch.update({puppet.id: places[index] for index, puppet in owners.items()})
        self._new = [
            place
            for index, place in enumerate(places)
            if index not in owners and np.isfinite([*place.neck, *place.face]).all()
        ]

    def _next_full_frame(
        self, image: Image, stamp_ns: int, result: TrackResult, beside: Executor | None
    ) -> _PendingDetection | None:
        """Begin to search the image that was just tracked, where it is time for it."""
        settings, people = self._settings, [puppet.id for puppet in result.puppets]
        known = self._watch.known(people)
        interval = settings.detect_interval if known else settings.search_interval
        if self._searched_ns is not None and self._now_ns - self._searched_ns < _ns(interval):
            return None
        self._searched_ns = self._now_ns
        self._searches += 1
        look = partial(self._detect_full_frame, image, self._watch, self._searches)
        delay = settings.detect_delay * (BESIDE if people else 1.0)
        return _PendingDetection(image, stamp_ns, self._now_ns + _ns(delay), _done(look, beside))

    def _next_roi(
        self, image: Image, stamp_ns: int, result: TrackResult, beside: Executor | None
    ) -> _PendingDetection | None:
        """Begin to glance at the known people of the image that was just tracked, where it is time for it."""
        joints = {puppet.id: puppet.joints for puppet in result.puppets}
        glanced = self._watch.places(self._tracker.model.joint_names, joints)
        glanced |= {f"new {number}": place for number, place in enumerate(self._new)}
        since = None if self._glanced_ns is None else self._now_ns - self._glanced_ns
        if not glanced or (since is not None and since < _ns(self._settings.glance_interval * len(glanced))):
            return None
        self._new, self._glanced_ns = [], self._now_ns
        self._arms = {identity: self._arms.get(identity, ArmFilter(PathSettings())) for identity in joints}
        look = partial(self._detect_in_rois, image, list(glanced.values()), result.puppets, self._arms)
        due_ns = self._now_ns + _ns(self._settings.glance_delay * len(glanced))
        return _PendingDetection(image, stamp_ns, due_ns, _done(look, beside), glanced)

    def _detect_full_frame(self, image: Image, watch: KnownPeople, number: int) -> list[DetectedPerson]:
        return self._load().detect_full_frame(image, watch, number)

    def _detect_in_rois(
        self,
        image: Image,
        places: Sequence[PersonCandidate],
        puppets: Sequence[TrackedPuppet],
        arms: Mapping[str, ArmFilter],
    ) -> list[DetectedPerson]:
        return self._load().detect_in_rois(image, places, puppets, arms)

    def _load(self) -> DetectionWorker:
        if self._looker is None:
            self._looker = DetectionWorker(PartDetector.load(), ArmEvidenceModel.load(self._tracker.model.gender))
        return self._looker


def _ns(seconds: float) -> int:
    return round(seconds * NANOSECONDS)


def _done(look: Callable[[], list[DetectedPerson]], beside: Executor | None) -> Future[list[DetectedPerson]]:
    if beside is not None:
        return beside.submit(look)
    seen: Future[list[DetectedPerson]] = Future()
    seen.set_result(look())
    return seen


def propagate_points(places: F64, flows: Sequence[Flow], size: tuple[int, int], keep: bool = False) -> F64:
    """Return places (..., 2) px that moved along forward flows, one image after the other.

    `flows` are (h, w, 2), displacements as shares of the image's width and height; `size` is (width, height) of the
    image that the places are in. Where the flow is unknown so is the place, or it is what it was, to `keep` it.
    """
    if not places.size:
        return places
    shares = (places.reshape(-1, 2) + 0.5) / size
    for flow in flows:
        at = (shares * (flow.shape[1], flow.shape[0]) - 0.5).astype(np.float32)
        moved = cv2.remap(flow, at[:, None, :], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        step = np.where(np.isfinite(at), moved[:, 0], np.nan)
        shares = shares + (np.nan_to_num(step) if keep else step)
    return np.asarray(shares * size - 0.5).reshape(places.shape)


def _coarse(flow: Flow) -> Flow:
    """A flow field (h, w, 2) in pixels at a share of its resolution, as shares of its width and height."""
    height, width = flow.shape[:2]
    small = max(1, width // COARSE), max(1, height // COARSE)
    shares = np.array([1 / width, 1 / height], np.float32)
    return np.asarray(cv2.resize(flow, small, interpolation=cv2.INTER_AREA) * shares, np.float32)
