# SPDX-License-Identifier: Apache-2.0
"""Clock offsets between cameras, to about one image: the shift at which the rays of moving joints come nearest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.bundle.joint_tracks import MEASURED_JOINTS, CameraFrames, JointTrack
from flowing_puppet_ros.multiview.camera import Camera

_SAMPLES = 60
_MAX_DISTANCE_M = 0.3  # of two rays, at which a joint no longer speaks for a shift
_MIN_GAIN = 0.15  # share by which a shift must lower the distance to be believed
_MIN_SHARE = 0.4  # of the samples that both cameras must show
_UNSEEN_DISTANCE_M = 0.1  # of a sample that one camera alone shows: a step later all walkers look as they did before


def find_coarse_offsets(
    names: Sequence[str], cameras: Mapping[str, Camera], frames: CameraFrames, max_offset: float
) -> dict[str, float]:
    """Return seconds to add to each camera's stamps, within `max_offset`; 0 for the first camera.

    Each camera is compared with the first one, each pair of its people and the first one's. A shift that brings hardly
    anything is left out: the bundle adjustment finds fractions of an image.
    """
    chosen = [index for index, name in enumerate(names) if name in MEASURED_JOINTS]
    leader, *others = cameras
    tracks = {name: _collect(cameras[name], frames[name], chosen) for name in cameras}
    found = {leader: 0.0}
    for name in others:
        found[name] = _find_offset(cameras[leader], tracks[leader], cameras[name], tracks[name], max_offset)
    return found


def _collect(
    camera: Camera, frames: Sequence[tuple[float, Sequence[PersonInView]]], chosen: list[int]
) -> list[JointTrack]:
    """Return the tracks of a camera's own ids, of two images or more."""
    by_id: dict[str, list[tuple[float, PersonInView]]] = {}
    for time, people in frames:
        for person in people:
            by_id.setdefault(person.id, []).append((time, person))
    tracks = []
    for entries in by_id.values():
        plane = camera.undistort(np.stack([person.joints[chosen] for _, person in entries]))
        weight = np.stack([person.confidence[chosen] for _, person in entries])
        known = np.isfinite(plane).all(axis=2)
        times = np.array([time for time, _ in entries])
        tracks.append(JointTrack(times, np.where(known[..., None], plane, 0.0), np.where(known, weight, 0.0)))
    return [track for track in tracks if len(track.times) > 1]


def _find_offset(
    one: Camera, tracks: Sequence[JointTrack], other: Camera, others: Sequence[JointTrack], max_offset: float
) -> float:
    best: tuple[float, float] | None = None
    for track in tracks:
        times = np.linspace(track.times[0], track.times[-1], _SAMPLES)
        plane, weight = track.interpolate(times)
        step = float(np.median(np.diff(track.times)))
        shifts = step * np.arange(-round(max_offset / step), round(max_offset / step) + 1)
        for theirs in others:
            costs = np.array(
                [_measure_distance(one, plane, weight, other, *theirs.interpolate(times - s)) for s in shifts]
            )
            at_zero, lowest = float(costs[len(shifts) // 2]), int(costs.argmin())
            believed = costs[lowest] < (1 - _MIN_GAIN) * at_zero
            candidate = (float(costs[lowest]), float(shifts[lowest])) if believed else (at_zero, 0.0)
            if np.isfinite(candidate[0]) and (best is None or candidate[0] < best[0]):
                best = candidate
    return best[1] if best is not None else 0.0


def _measure_distance(
    one: Camera, plane: F64, weight: F64, other: Camera, their_plane: F64, their_weight: F64
) -> float:
    """Return the mean distance (m, at most _MAX_DISTANCE_M) of the rays of the same joints (M, J); inf if too few.

    The samples that the other camera does not show count as _UNSEEN_DISTANCE_M.
    """
    both = np.minimum(weight, their_weight)
    shown, seen_by_both = (int(np.count_nonzero((each > 0).any(axis=1))) for each in (weight, both))
    share = seen_by_both / max(shown, 1)
    if share < _MIN_SHARE:
        return np.inf
    rays = [
        np.concatenate([each, np.ones((*each.shape[:-1], 1))], axis=-1) @ camera.rotation
        for each, camera in ((plane, one), (their_plane, other))
    ]
    normal = np.cross(rays[0], rays[1])
    length = np.linalg.norm(normal, axis=-1)
    distance = np.abs(normal @ (other.centre - one.centre)) / np.maximum(length, 1e-9)
    mean = float((both * np.minimum(distance, _MAX_DISTANCE_M)).sum() / both.sum())
    return share * mean + (1 - share) * _UNSEEN_DISTANCE_M
