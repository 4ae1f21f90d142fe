# SPDX-License-Identifier: Apache-2.0
"""The joints of people in the images of several cameras over time, and what they are at any instant between images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, I64
from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings

MEASURED_JOINTS = tuple(
    f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
"""Joints that detectors measure; those derived from them say nothing new."""
_MAX_GAP_S = 0.15  # between two images, over which joints are not interpolated

type CameraFrames = Mapping[str, Sequence[tuple[float, Sequence[PersonInView]]]]
"""Camera -> (stamp in seconds, people) of its images, in order."""


@dataclass(frozen=True, slots=True, eq=False)
class JointTrack:
    """One person in one camera: `times` (N,) s, `plane` (N, J, 2) undistorted, `weight` (N, J), 0 where unknown."""

    times: F64
    plane: F64
    weight: F64

    def interpolate(self, times: F64) -> tuple[F64, F64]:
        """Return the joints (M, J, 2) on the image plane and weights (M, J) at `times` (M,), 0 where unknown."""
        if len(self.times) < 2:
            return np.zeros((len(times), *self.plane.shape[1:])), np.zeros((len(times), self.weight.shape[1]))
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        before = after - 1
        gap = self.times[after] - self.times[before]
        share = (times - self.times[before]) / gap
        plane = self._interpolate_cubic(before, after, share)
        inside = (share >= -1e-6) & (share <= 1 + 1e-6) & (gap <= _MAX_GAP_S)
        weight = np.minimum(self.weight[before], self.weight[after]) * inside[:, None]
        return plane, weight

    def _interpolate_cubic(self, before: I64, after: I64, share: F64) -> F64:
        """Interpolate between two images, by a cubic where the joint is known in the images beside them too.

        A straight line would smooth joints more between images than at them, which moves clocks.
        """
        first, last = np.maximum(before - 1, 0), np.minimum(after + 1, len(self.times) - 1)
        s = share[:, None, None]
        p0, p1, p2, p3 = (self.plane[index] for index in (first, before, after, last))
        linear = p1 + s * (p2 - p1)
        cubic = p1 + 0.5 * s * (p2 - p0 + s * (2 * p0 - 5 * p1 + 4 * p2 - p3 + s * (3 * (p1 - p2) + p3 - p0)))
        known = np.minimum(self.weight[first], self.weight[last]) > 0
        steps = np.diff(self.times[np.stack([first, before, after, last])], axis=0)
        even = (steps.max(axis=0) < 1.5 * np.maximum(steps.min(axis=0), 1e-9))[:, None]
        return np.where((known & even)[..., None], cubic, linear)


@dataclass(frozen=True, slots=True, eq=False)
class PeopleTracks:
    """Everybody's tracks: `tracks[person][camera]`; joints are those of `names`; `period` is that of the images, s."""

    names: tuple[str, ...]
    tracks: Mapping[str, Mapping[str, JointTrack]]
    period: float

    @property
    def span(self) -> tuple[float, float]:
        """First and last time at which any camera shows anybody, s."""
        times = [track.times[[0, -1]] for person in self.tracks.values() for track in person.values()]
        return float(min(t[0] for t in times)), float(max(t[1] for t in times))


def associate_tracks(
    names: Sequence[str],
    cameras: Mapping[str, Camera],
    frames: CameraFrames,
    offsets: Mapping[str, float],
    settings: AssociationSettings,
    triangulation: TriangulationSettings,
) -> PeopleTracks:
    """Associate people across cameras at the images of the first camera and collect the measured joints of each.

    `offsets` are seconds to add to the stamps of each camera; the times of the tracks are stamps without them.
    """
    tracker = PeopleTracker3D(names, settings, triangulation)
    chosen = [index for index, name in enumerate(names) if name in MEASURED_JOINTS]
    leader = next(iter(frames))
    stamps = {name: np.array([time for time, _ in group]) + offsets.get(name, 0.0) for name, group in frames.items()}
    period = float(np.median(np.diff(stamps[leader]))) if len(stamps[leader]) > 1 else _MAX_GAP_S
    collected: dict[str, dict[str, list[tuple[float, PersonInView, F64]]]] = {}
    for time in stamps[leader]:
        people: dict[str, Sequence[PersonInView]] = {}
        times: dict[str, float] = {}
        for name, group in frames.items():
            index = int(np.abs(stamps[name] - time).argmin()) if len(group) else 0
            if len(group) and abs(stamps[name][index] - time) <= max(period, 0.02):
                times[name], people[name] = group[index]
        for person in tracker.step(round(time * 1e9), cameras, people):
            for name, view in person.seen.items():
                entry = times[name], view, person.weights[name]
                collected.setdefault(person.id, {}).setdefault(name, []).append(entry)
    tracks = {
        person: {name: _make_track(cameras[name], entries, chosen) for name, entries in by_camera.items()}
        for person, by_camera in collected.items()
    }
    return PeopleTracks(tuple(names[index] for index in chosen), tracks, period)


def _make_track(camera: Camera, entries: list[tuple[float, PersonInView, F64]], chosen: list[int]) -> JointTrack:
    unique = {time: (person, weight) for time, person, weight in entries}
    times = np.array(sorted(unique))
    joints = np.stack([unique[time][0].joints[chosen] for time in times])
    weight = np.stack([unique[time][1][chosen] for time in times])
    plane = camera.undistort(joints)
    known = np.isfinite(plane).all(axis=2)
    return JointTrack(times, np.where(known[..., None], plane, 0.0), np.where(known, weight, 0.0))
