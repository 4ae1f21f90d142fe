# SPDX-License-Identifier: Apache-2.0
"""The figures of a replay's bag: bodies against true people or triangulated detections, ids, latency, drops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Recording, read_recording, track_and_detections, triangulated
from flowing_puppet_ros.evaluate.bag.timing import timing
from flowing_puppet_ros.evaluate.bag.truth import People, Person, matched, people_of, to_surface
from flowing_puppet_ros.evaluate.joints import (
    ARM_JOINTS,
    LEG_JOINTS,
    JointErrors,
    id_switches,
    jitter,
    joint_errors,
    swapped_share,
)

WITHIN_CM = (5, 10)


@dataclass(frozen=True, slots=True, eq=False)
class BagFigures:
    """Figures by name; distances (T, J) of T people's joints in metres, and the seconds (T,) at which they were."""

    figures: dict[str, float]
    errors: JointErrors
    seconds: np.ndarray


def measured(given: Bag, made: Bag, truth: People | None) -> BagFigures:
    """Figures of the results in `made`, whose input is `given` (the same bag when it holds both).

    Without `truth` the bodies' reference are joints triangulated from the detections, as far as there are any.

    Raises:
        InputError: when there is a truth and nothing to compare with it.
    """
    recording = read_recording(given, made)
    found = people_of(made, recording)
    reference = _triangulated(recording, found) if truth is None else truth
    pairs = matched(found, reference)
    frames = {row: body.joints for row, (_, _, body) in enumerate(pairs) if body is not None}
    errors = joint_errors(frames, {row: person.joints for row, (_, person, _) in enumerate(pairs)})
    if truth is not None and not errors.known.size:
        raise InputError(f"{made.path} has no body at a stamp of the truth; check that both come from one recording")
    figures: dict[str, float] = {}
    if errors.known.size:
        figures |= _joint_figures(errors)
        figures["people found, %"] = 100 * len(frames) / len(pairs)
        figures |= _surface(pairs, found, reference) | _swaps(pairs)
    figures |= _bodies(recording, found) | _puppets(recording)
    start = recording.start
    seconds = np.array([(stamp - start) * 1e-9 for stamp, _, body in pairs if body is not None])
    return BagFigures(figures | timing(given, made), errors, seconds)


def _triangulated(recording: Recording, found: People) -> People:
    first = {stamp: people[0].joints for stamp, people in found.at.items() if people}
    at = {stamp: [Person(joints)] for stamp, joints in triangulated(recording, first).items()}
    return People(at, found.triangles[:0])


def _joint_figures(errors: JointErrors) -> dict[str, float]:
    centimetres = JointErrors(errors.names, 100 * errors.distance)
    figures = {"MPJPE, cm": centimetres.mean}
    for name, percent in (("median", 50), ("90 %", 90), ("worst", 100)):
        figures[f"joint error, {name} cm"] = centimetres.percentile(percent)
    return figures | {f"joints within {limit} cm, %": 100 * centimetres.fraction_within(limit) for limit in WITHIN_CM}


def _surface(pairs: list[tuple[int, Person, Person | None]], found: People, reference: People) -> dict[str, float]:
    """Mean distance from the vertices of the bodies to the true surfaces."""
    distances = [
        to_surface(body.vertices, person.vertices, reference.triangles)
        for _, person, body in pairs
        if body is not None and body.vertices is not None and person.vertices is not None
    ]
    return {"vertex to surface, cm": 100 * float(np.mean(distances))} if distances else {}


def _swaps(pairs: list[tuple[int, Person, Person | None]]) -> dict[str, float]:
    frames = {row: body.joints for row, (_, _, body) in enumerate(pairs) if body is not None}
    reference = {row: pairs[row][1].joints for row in frames}
    figures = {}
    for limbs, joints in (("arms", ARM_JOINTS), ("legs", LEG_JOINTS)):
        swapped, told = swapped_share(frames, reference, joints)
        if told:
            figures[f"{limbs} swapped, %"] = 100 * swapped / told
    return figures


def _bodies(recording: Recording, found: People) -> dict[str, float]:
    if not recording.bodies:
        return {}
    tracks: dict[str, dict[int, dict[str, np.ndarray]]] = {}
    for stamp, bodies in recording.bodies.items():
        for body, person in zip(bodies, found.at[stamp], strict=True):
            tracks.setdefault(body.id, {})[stamp] = person.joints
    bends = np.concatenate([jitter(frames) for frames in tracks.values()] or [np.empty(0)])
    ids = [[body.id for body in recording.bodies[stamp]] for stamp in sorted(recording.bodies)]
    figures = {"jitter of bodies, cm": 100 * float(bends.mean())} if bends.size else {}
    return figures | {"id switches of bodies": float(id_switches(ids))}


def _puppets(recording: Recording) -> dict[str, float]:
    cameras = [camera for camera in recording.cameras.values() if camera.puppets]
    if not cameras:
        return {}
    switches, distances = 0, []
    for camera in cameras:
        ids = [[puppet.id for puppet in camera.puppets[stamp]] for stamp in sorted(camera.puppets)]
        switches += id_switches(ids)
        distances.append(joint_errors(*track_and_detections(camera)).known)
    apart = np.concatenate(distances)
    figures = {"puppet joints to detections, median px": float(np.median(apart))} if apart.size else {}
    return figures | {"id switches of puppets": float(switches)}
