# SPDX-License-Identifier: Apache-2.0
"""Recognises people who come back: by the cameras' own ids, by place, by colours and by size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.track_3d import PersonTrack3D
from flowing_puppet_ros.multiview.association.view import PersonInView

_SPEED_M_S = 2.0  # of somebody who is not seen
_REACH_M = 0.5  # at any time
_MAX_SECONDS_BY_PLACE = 2.0  # after which a place says nothing
_MIN_VOTES = 5  # sets in which a camera's id was this person
_MAX_COLOUR_DISTANCE = 0.45  # Hellinger, mean over the cameras
_MAX_SIZE_DIFFERENCE = 0.12  # relative, median over the bones


def choose_returning(
    stamp: int, tracks: Sequence[PersonTrack3D], seen: Mapping[str, PersonInView], joints: F64
) -> PersonTrack3D | None:
    """Return who of `tracks`, unseen at the moment, the views `seen` (by camera) with joints (J, 3) m show; or None.

    Nobody of another size or with other colours; of the others the one that the cameras' trackers recognise, else one
    whom the colours tell, else one who was near a moment ago.
    """
    scored: list[tuple[float, str, PersonTrack3D]] = []
    for track in tracks:
        size, colour = track.compare_size(joints), _compare_colours(track, seen)
        if size > _MAX_SIZE_DIFFERENCE or colour > _MAX_COLOUR_DISTANCE:
            continue
        votes = sum(track.votes.get((name, person.id), 0) for name, person in seen.items())
        seconds = (stamp - track.stamp) * 1e-9
        distance = float(np.linalg.norm(np.nanmedian(joints, axis=0) - track.centre))
        near = seconds <= _MAX_SECONDS_BY_PLACE and distance <= _REACH_M + _SPEED_M_S * seconds
        if votes >= _MIN_VOTES or near or not np.isnan(colour):
            score = (
                (0.0 if votes >= _MIN_VOTES else 1.0) + (1.0 if np.isnan(colour) else colour) + (0.0 if near else 0.5)
            )
            scored.append((score, track.id, track))
    return min(scored, key=lambda entry: entry[:2])[2] if scored else None


def _compare_colours(track: PersonTrack3D, seen: Mapping[str, PersonInView]) -> float:
    """Return the mean Hellinger distance of torso colours in the cameras that know both; NaN if there are none."""
    distances = [
        float(np.sqrt(max(0.0, 1.0 - np.sqrt(person.colours * track.colours[name]).sum())))
        for name, person in seen.items()
        if person.colours is not None and name in track.colours
    ]
    return float(np.mean(distances)) if distances else np.nan
