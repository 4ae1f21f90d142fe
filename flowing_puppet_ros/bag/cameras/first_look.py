# SPDX-License-Identifier: Apache-2.0
"""The people in a few images of each camera, enough to see whether a calibration can be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flowing_puppet_ros.bag.cameras.sources import CameraSource
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointSource
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.multiview.association.view import PersonInView

_INSTANTS = 8


def look_at_people(
    sources: Sequence[CameraSource], offsets: Mapping[str, float], networks: KeypointSource | None
) -> tuple[tuple[str, ...], list[dict[str, list[PersonInView]]]]:
    """Return the names of the joints, and the people by camera at some instants spread over the recording.

    From the keypoint files where there are any, else found by `networks`; nobody without either. Cameras have different
    rates, so instants are times.
    """
    model = DeformableStructures.load()
    lengths = [(len(s.frames.files) or s.frames.count or 1) / s.frames.fps for s in sources]
    times = [(k + 0.5) * min(lengths) / _INSTANTS for k in range(_INSTANTS)]
    instants: list[dict[str, list[PersonInView]]] = [{} for _ in times]
    for source in sources:
        wanted = [max(0, round((time - offsets.get(source.name, 0.0)) * source.frames.fps)) for time in times]
        found = _find_people(source, set(wanted), networks)
        for people, index in zip(instants, wanted, strict=True):
            group = [_convert(model, number, person) for number, person in enumerate(found.get(index, ()))]
            people[source.name] = [person for person in group if np.isfinite(person.joints).any()]
    return tuple(model.joint_names), instants


def _find_people(
    source: CameraSource, wanted: set[int], networks: KeypointSource | None
) -> Mapping[int, Sequence[Keypoints]]:
    if source.people is not None:
        return source.people
    if networks is None:
        return {}
    found = {}
    for frame in source.frames:
        if frame.index in wanted:
            found[frame.index] = [person.keypoints for person in networks.find(frame.image)]
        if frame.index >= max(wanted):
            break
    return found


def _convert(model: DeformableStructures, number: int, person: Keypoints) -> PersonInView:
    joints, confidence = joints_from_keypoints(model, person)
    return PersonInView(person.track_id or f"p{number}", joints, confidence)
