# SPDX-License-Identifier: Apache-2.0
"""The tracker of a live stream whose people are found by keypoint networks.

The networks look for everybody now and then, and closely at the people who are tracked, in turn. They run beside the
tracking. When they run, and which image uses the result, follows from the stamps alone: a replay, where each run
finishes at once, gives the same puppets as the live node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from flowing_puppet_ros.arrays import F64, Image
from flowing_puppet_ros.flow.estimate import MIN_SIDE_PX, FlowPair
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.agreement import calibrate
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.image.tracking.track import Track
from flowing_puppet_ros.image.tracking.tracker import (
    DetectedInTracks,
    FlowingPuppetTracker,
    TrackedPuppet,
    TrackResult,
)
from flowing_puppet_ros.image.video.pending_detection import (
    StreamClock,
    propagate_points,
    reduce_flow,
    submit,
    to_ns,
)
from flowing_puppet_ros.image.video.settings import LiveDetectionSettings
from flowing_puppet_ros.images import as_image
from flowing_puppet_ros.units import NANOSECONDS

SEVERAL_SHARE = 0.5
"""Of the looks at one tracked person: those that there is time for where several are tracked."""


def known_keypoints(names: Sequence[str], joints: F64, confidence: F64) -> Keypoints:
    """Return the keypoints of a tracked person; joints that only the model has placed count little."""
    return Keypoints(tuple(names), joints, np.maximum(confidence, 1e-3))


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A run of the networks on an image; `searched` are the ids of the people looked at, None where everybody was."""

    image: Image
    stamp_ns: int
    people: Future[list[Keypoints]]
    searched: Collection[str] | None


class NetworkTracker:
    """Runs the networks on the images that are tracked, and gives the tracker whom they find."""

    def __init__(
        self,
        tracker: FlowingPuppetTracker,
        settings: LiveDetectionSettings,
        source: KeypointSource,
        counters: Counter[str] | None = None,
    ) -> None:
        """Track with `tracker` the people that `source` finds."""
        self._tracker = tracker
        self._settings = settings.networks
        self._source = source
        self._counters: Counter[str] = Counter() if counters is None else counters
        self.people: list[Keypoints] | None = None
        """Whom the networks have found in the last image, where that waited for them."""
        self.reset()

    def reconfigure(self, settings: LiveDetectionSettings) -> None:
        """Go on with other settings."""
        self._settings = settings.networks

    def warm_up(self, image: Image, puppet: TrackedPuppet) -> None:
        """Run the networks on an image of no interest."""
        known = known_keypoints(self._tracker.model.joint_names, puppet.joints, puppet.confidence)
        for _run in range(2):
            self._source.find(image, [known])

    def reset(self) -> None:
        """Forget the images; everybody is looked for in the next one."""
        self._clock = StreamClock()
        self._forget_stream()

    def _forget_stream(self) -> None:
        self._run: _Run | None = None
        self._everybody_ns: int | None = None
        self._looked_ns: dict[str, int] = {}
        self._looks = 0.0

    def step(
        self, image: Image, stamp_ns: int, flow: FlowPair | None = None, executor: Executor | None = None
    ) -> TrackResult:
        """Track the next `image` (H, W, 3) RGB or (H, W) grey; InputError, and nothing has changed, if it is not one.

        `flow` is as `FlowingPuppetTracker.step` takes it. Runs of the networks go to the `executor`, or finish at once.
        In a slow stream an image waits for the run on itself; in a fast one, tracking goes on beside it, and the next
        image uses what it finds.
        """
        image = as_image(image, MIN_SIDE_PX)
        if not self._clock.advance(image, stamp_ns):
            self._forget_stream()
        passed = to_ns(self._settings.min_wait) if self._clock.passed_ns is None else self._clock.passed_ns
        due, self._run = self._run, self._start_run(image, stamp_ns, passed, executor)
        if passed >= to_ns(self._settings.min_wait):
            result = self._track_here(image, stamp_ns, flow)
        else:
            result = self._track(due, image, stamp_ns, flow)
        # The tracker weighs joints by their raw confidence; what is told is a probability.
        told = [
            replace(one, confidence=calibrate(one.confidence / one.visible) * one.visible) for one in result.puppets
        ]
        return replace(result, puppets=told)

    def _track_here(self, image: Image, stamp_ns: int, flow: FlowPair | None) -> TrackResult:
        """Track an image with what the run on itself finds."""
        run, self._run, self.people = self._run, None, None

        def detect(tracks: Sequence[Track], _: FlowPair | None) -> DetectedInTracks:
            if run is None:
                return None, None
            self.people = run.people.result()
            return self.people, run.searched

        return self._forget_after_cut(self._tracker.step(image, stamp_ns, flow=flow, detect=detect))

    def _track(self, run: _Run | None, image: Image, stamp_ns: int, flow: FlowPair | None) -> TrackResult:
        """Track an image with what a run on the image before has found."""
        self.people = None
        if run is not None and not self._tracker.tracks:
            return self._start_tracks(run, image, stamp_ns, flow)

        def detect(tracks: Sequence[Track], between: FlowPair | None) -> DetectedInTracks:
            if run is None or between is None:
                return None, None  # after a cut the people of the image before are not there
            size = image.shape[1], image.shape[0]
            move = partial(propagate_points, flows=[reduce_flow(between[0])], size=size)
            return [
                replace(person, xy=move(person.xy), mask=person.mask and person.mask.carry(between[0], size))
                for person in run.people.result()
            ], run.searched

        return self._forget_after_cut(self._tracker.step(image, stamp_ns, flow=flow, detect=detect))

    def _start_tracks(self, run: _Run, image: Image, stamp_ns: int, flow: FlowPair | None) -> TrackResult:
        """Start tracks in the image of a run, and track from there to `image`."""
        people = run.people.result()
        if not people:
            return self._tracker.step(image, stamp_ns, None, flow)
        self._tracker.reset()
        started = self._tracker.step(run.image, run.stamp_ns, people)
        result = self._forget_after_cut(self._tracker.step(image, stamp_ns, None, flow))
        return replace(result, warnings=[*started.warnings, *result.warnings])

    def _forget_after_cut(self, result: TrackResult) -> TrackResult:
        if result.restarted:
            self._everybody_ns = None
        return result

    def _start_run(self, image: Image, stamp_ns: int, passed_ns: int, executor: Executor | None) -> _Run | None:
        """Start a run on the next image: a search for everybody, or as many looks as there is time for."""
        settings, tracks = self._settings, self._tracker.tracks
        waits = passed_ns >= to_ns(settings.min_wait)
        # Only an image that waits for them can take all looks and a search besides.
        most = max(1.0, len(tracks) + waits)
        rate = settings.looks if len(tracks) < 2 else SEVERAL_SHARE * settings.looks
        self._looks = min(self._looks + rate * passed_ns / NANOSECONDS, most)
        interval = settings.everybody_interval if tracks else settings.search_interval
        everybody = self._everybody_ns is None or self._clock.now_ns - self._everybody_ns >= to_ns(interval)
        chosen = self._choose(tracks, everybody)
        if not (chosen or everybody):
            return None
        if everybody:
            self._everybody_ns = self._clock.now_ns
        names = self._tracker.model.joint_names
        known = [known_keypoints(names, track.mean, track.confidence) for track in chosen]
        # Counted here: two runs may be under way at once.
        self._counters["searches for everybody"] += everybody
        self._counters["close looks"] += len(known)
        people = submit(partial(self._look, image, known, everybody), executor)
        searched = None if everybody else frozenset(track.id for track in chosen)
        return _Run(image, stamp_ns, people, searched)

    def _choose(self, tracks: Sequence[Track], everybody: bool) -> list[Track]:
        """Return whom to look at: those whom nobody has looked at for longest, as many as there is time for.

        A search takes the time of a look, and sees those who are not looked at too.
        """
        # Half a look is enough: streams of the nominal rate are a little too fast now and then.
        count = int(self._looks + 0.5) - (everybody and self._looks < len(tracks) + 1)
        order = sorted(tracks, key=lambda track: self._looked_ns.get(track.id, -1))
        chosen = order[: max(count, 0)]
        self._looks -= len(chosen) + everybody
        self._looked_ns = {track.id: self._looked_ns.get(track.id, -1) for track in tracks}
        self._looked_ns |= {track.id: self._clock.now_ns for track in chosen}
        return chosen

    def _look(self, image: Image, known: Sequence[Keypoints], everybody: bool) -> list[Keypoints]:
        people = self._source.find(image, known, everybody, self._tracker.settings.max_people)
        return [person.keypoints for person in people]
