# SPDX-License-Identifier: Apache-2.0
"""Association of detections with tracks, by distance, appearance and the ids of the detector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.assignment import assign_cheapest
from flowing_puppet_ros.image.tracking.appearance import TorsoAppearance, hellinger_distance
from flowing_puppet_ros.image.tracking.track import Track

type Detection = tuple[F64, F64]  # joints (J, 2) px with NaN unknown, confidence (J,)

APPEARANCE_WEIGHT_M = 0.6  # distance of joints that costs as much as the maximum appearance distance
SAME_ID_BONUS_M = 0.05  # distance of joints that an id of the detector, the same as last time, makes up for
MAX_SAME_DISTANCE = 0.45  # appearance distance up to which a lost person is recognised ...
MIN_OTHER_MARGIN = 0.15  # ... if all others differ by so much more
REIDENTIFY_FACTOR = 3.0  # search radius for a person after an occlusion, in match distances


def joint_distance(track: Track, detection: Detection) -> float:
    """Return the median distance in metres over the joints known to both; infinite if those are fewer than three."""
    both = np.isfinite(detection[0]).all(axis=1) & ~track.unknown
    if np.count_nonzero(both) < 3:
        return np.inf
    offset = detection[0][both] - track.mean[both]
    return float(np.median(np.hypot(offset[:, 0], offset[:, 1]))) / track.scale


def associate(
    tracks: Sequence[Track],
    detections: Sequence[Detection],
    limit: float,
    appearances: Sequence[TorsoAppearance | None] | None = None,
    ids: Sequence[str] | None = None,
) -> tuple[dict[int, int], list[int]]:
    """Match tracks and detections one to one, by joint distance (at most `limit` metres) and appearance.

    `appearances` are those of the detected people. `ids` are the detector's own, empty for none: a hint that decides
    between people at nearly the same distance, since some detectors exchange ids just when people meet. A track without
    a match that has overlapped with another, and may have been occluded by it, is re-identified by an appearance that
    no other track has, within REIDENTIFY_FACTOR times the limit.

    Returns {track: detection} and the unmatched detections; a second detection of a matched track (within `limit`) is
    not among them.
    """
    if not tracks or not detections:
        return {}, list(range(len(detections)))
    distance = np.array([[joint_distance(track, detection) for detection in detections] for track in tracks])
    cost = np.minimum(distance, 1e3 * limit)
    dissimilarity = _appearance_distance(tracks, appearances, distance.shape)
    bonus = SAME_ID_BONUS_M * (_has_same_id(tracks, ids, distance.shape) & (distance <= limit))
    rows, columns = assign_cheapest(cost + APPEARANCE_WEIGHT_M * dissimilarity - bonus)
    pairs = zip(rows, columns, strict=True)
    matched = {int(row): int(column) for row, column in pairs if distance[row, column] <= limit}
    matched |= _reidentify(tracks, distance, dissimilarity, matched, REIDENTIFY_FACTOR * limit)
    taken = set(matched.values())
    free = [k for k in range(len(detections)) if k not in taken and not (distance[list(matched), k] <= limit).any()]
    return matched, free


def _has_same_id(tracks: Sequence[Track], ids: Sequence[str] | None, shape: tuple[int, int]) -> Bools:
    """Return where (tracks, detections) the detector's id is the one that the track was last matched with."""
    same = [[bool(identity) and identity == track.detector_id for identity in ids or ()] for track in tracks]
    return np.array(same, dtype=bool) if ids else np.zeros(shape, dtype=bool)


def _appearance_distance(
    tracks: Sequence[Track], appearances: Sequence[TorsoAppearance | None] | None, shape: tuple[int, int]
) -> F64:
    """Return the appearance distances (tracks, detections) in [0, 1]; 0.5 where one is not known."""
    distance = np.full(shape, 0.5)
    for row, track in enumerate(tracks):
        for column, appearance in enumerate(appearances or ()):
            if track.appearance is not None and appearance is not None:
                distance[row, column] = hellinger_distance(track.appearance, appearance.colours)
    return distance


def _reidentify(
    tracks: Sequence[Track], distance: F64, dissimilarity: F64, matched: dict[int, int], limit: float
) -> dict[int, int]:
    """Match unmatched tracks that have overlapped with others by appearance, the most similar first."""
    rows = [k for k, track in enumerate(tracks) if k not in matched and track.overlapped]
    columns = [k for k in range(distance.shape[1]) if k not in matched.values()]
    found: dict[int, int] = {}
    for row, column in sorted(((r, c) for r in rows for c in columns), key=lambda pair: float(dissimilarity[pair])):
        others = min((dissimilarity[k, column] for k in range(len(tracks)) if k != row), default=1.0)
        same = dissimilarity[row, column] <= min(MAX_SAME_DISTANCE, others - MIN_OTHER_MARGIN)
        if same and distance[row, column] <= limit and row not in found and column not in found.values():
            found[row] = column
    return found
