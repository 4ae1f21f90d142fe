# SPDX-License-Identifier: Apache-2.0
"""The figures of a replay's bag: bodies against true people or triangulated detections, ids, latency, drops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import (
    Recording,
    match_track_to_detections,
    read_recording,
    triangulate_detections,
)
from flowing_puppet_ros.evaluate.bag.reprojection import (
    measure_reprojection,
    read_people_in_space,
    summarise_reprojection,
)
from flowing_puppet_ros.evaluate.bag.timing import measure_timing
from flowing_puppet_ros.evaluate.bag.truth import (
    PeopleByStamp,
    PersonGeometry,
    distance_to_surface,
    match_bodies,
    read_bodies,
)
from flowing_puppet_ros.evaluate.joints import (
    ARM_JOINTS,
    LEG_JOINTS,
    JointErrors,
    count_id_switches,
    count_swapped,
    jitter,
    measure_joint_errors,
)

THRESHOLDS_CM = (5, 10)  # of correct joints


@dataclass(frozen=True, slots=True, eq=False)
class BagFigures:
    """Figures by name; `errors` (T, J) m of the joints of T people, and the times `seconds` (T,) from the start."""

    figures: dict[str, float]
    errors: JointErrors
    seconds: np.ndarray


def measure_bag(input_bag: Bag, output_bag: Bag, truth: PeopleByStamp | None) -> BagFigures:
    """Measure the results in `output_bag`, whose input is `input_bag` (the same bag if it holds both).

    Without `truth`, the reference of the bodies is joints triangulated from the detections, if there are any.

    Raises:
        InputError: if there is a truth but nothing to compare with it.
    """
    recording = read_recording(input_bag, output_bag)
    found = read_bodies(output_bag, recording)
    reference = _triangulate_reference(recording, found) if truth is None else truth
    pairs = match_bodies(found, reference)
    frames = {row: body.joints for row, (_, _, body) in enumerate(pairs) if body is not None}
    errors = measure_joint_errors(frames, {row: person.joints for row, (_, person, _) in enumerate(pairs)})
    if truth is not None and not errors.known.size:
        raise InputError(
            f"{output_bag.path} has no body at a stamp of the truth; check that both come from one recording"
        )
    figures: dict[str, float] = {}
    if errors.known.size:
        figures |= _summarise_joints(errors)
        figures["people found, %"] = 100 * len(frames) / len(pairs)
        figures |= _measure_surface(pairs, found, reference) | _measure_swaps(pairs)
    figures |= _measure_bodies(recording, found) | _measure_puppets(recording)
    figures |= summarise_reprojection(measure_reprojection(recording, read_people_in_space(output_bag)))
    start = recording.start
    seconds = np.array([(stamp - start) * 1e-9 for stamp, _, body in pairs if body is not None])
    return BagFigures(figures | measure_timing(input_bag, output_bag), errors, seconds)


def _triangulate_reference(recording: Recording, found: PeopleByStamp) -> PeopleByStamp:
    first = {stamp: people[0].joints for stamp, people in found.at.items() if people}
    at = {stamp: [PersonGeometry(joints)] for stamp, joints in triangulate_detections(recording, first).items()}
    return PeopleByStamp(at, found.triangles[:0])


def _summarise_joints(errors: JointErrors) -> dict[str, float]:
    centimetres = JointErrors(errors.names, 100 * errors.distance)
    figures = {"MPJPE, cm": centimetres.mean}
    for name, percent in (("median", 50), ("90 %", 90), ("worst", 100)):
        figures[f"joint error, {name} cm"] = centimetres.percentile(percent)
    return figures | {
        f"joints within {limit} cm, %": 100 * centimetres.fraction_within(limit) for limit in THRESHOLDS_CM
    }


def _measure_surface(
    pairs: list[tuple[int, PersonGeometry, PersonGeometry | None]], found: PeopleByStamp, reference: PeopleByStamp
) -> dict[str, float]:
    """Measure the mean distance from the vertices of the bodies to the true surfaces."""
    distances = [
        distance_to_surface(body.vertices, person.vertices, reference.triangles)
        for _, person, body in pairs
        if body is not None and body.vertices is not None and person.vertices is not None
    ]
    return {"vertex to surface, cm": 100 * float(np.mean(distances))} if distances else {}


def _measure_swaps(pairs: list[tuple[int, PersonGeometry, PersonGeometry | None]]) -> dict[str, float]:
    frames = {row: body.joints for row, (_, _, body) in enumerate(pairs) if body is not None}
    reference = {row: pairs[row][1].joints for row in frames}
    figures = {}
    for limbs, joints in (("arms", ARM_JOINTS), ("legs", LEG_JOINTS)):
        swapped, comparable = count_swapped(frames, reference, joints)
        if comparable:
            figures[f"{limbs} swapped, %"] = 100 * swapped / comparable
    return figures


def _measure_bodies(recording: Recording, found: PeopleByStamp) -> dict[str, float]:
    if not recording.bodies:
        return {}
    tracks: dict[str, dict[int, dict[str, np.ndarray]]] = {}
    for stamp, bodies in recording.bodies.items():
        for body, person in zip(bodies, found.at[stamp], strict=True):
            tracks.setdefault(body.id, {})[stamp] = person.joints
    bends = np.concatenate([jitter(frames) for frames in tracks.values()] or [np.empty(0)])
    ids = [[body.id for body in recording.bodies[stamp]] for stamp in sorted(recording.bodies)]
    figures = {"jitter of bodies, cm": 100 * float(bends.mean())} if bends.size else {}
    return figures | {"id switches of bodies": float(count_id_switches(ids))}


def _measure_puppets(recording: Recording) -> dict[str, float]:
    cameras = [camera for camera in recording.cameras.values() if camera.puppets]
    if not cameras:
        return {}
    switches, distances = 0, []
    for camera in cameras:
        ids = [[puppet.id for puppet in camera.puppets[stamp]] for stamp in sorted(camera.puppets)]
        switches += count_id_switches(ids)
        distances.append(measure_joint_errors(*match_track_to_detections(camera)).known)
    apart = np.concatenate(distances)
    figures = {"puppet joints to detections, median px": float(np.median(apart))} if apart.size else {}
    return figures | {"id switches of puppets": float(switches)}
