# SPDX-License-Identifier: Apache-2.0
"""Ids of a track against the people of the truth, whose place in the list of a frame is their identity."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowing_puppet_ros.evaluate.bag.recording import Joints
from flowing_puppet_ros.evaluate.identity import FrameIdentities, IdentityCounts, count_identities
from flowing_puppet_ros.evaluate.people import Unmatched
from flowing_puppet_ros.evaluate.similarity import SIGMAS, can_compare, measure_similarity, stand_on_anybody
from flowing_puppet_ros.evaluate.video.errors import is_inside
from flowing_puppet_ros.evaluate.video.tracks import known_joints
from flowing_puppet_ros.evaluate.video.truth import PeopleByFrame


def measure_identities(
    track: Mapping[int, Mapping[str, Joints]], truth: PeopleByFrame, size: tuple[int, int], unmatched: Unmatched
) -> IdentityCounts:
    """Compare the people of a clip by frame and id with the true ones in its annotated frames.

    Joints count if COCO has a deviation for them, somebody in the track has them, and they are inside the image of
    `size` (width, height). True people without such a joint are left out, and found ones who stand on nobody if these
    are unknown.
    """
    listed = {name for people in track.values() for joints in people.values() for name in joints}
    names = [name for name in SIGMAS if name in listed]
    frames = []
    for index, persons in sorted(truth.items()):
        inside = (
            {name: point for name, point in known_joints(person).items() if is_inside(point, size)}
            for person in persons
        )
        # Without any track every joint is missed, whichever it is.
        true = {who: joints for who, joints in enumerate(inside) if can_compare(joints, names or [*SIGMAS])}
        found = dict(track.get(index, {}))
        if unmatched == "unknown":
            chosen = stand_on_anybody([*found.values()], [*true.values()], names)
            found = {who: found[who] for who, on in zip([*found], chosen, strict=True) if on}
        similarity = measure_similarity([*found.values()], [*true.values()], names)
        frames.append(FrameIdentities((*true,), (*found,), np.nan_to_num(similarity).T))
    return count_identities(frames)
