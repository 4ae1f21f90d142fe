# SPDX-License-Identifier: Apache-2.0
"""What a report shows, gathered from the two bags of a replay: figures, series over time, and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.evaluate.from_bag import (
    CameraRecord,
    Joints,
    Recording,
    body_joints,
    first_bodies,
    frontality,
    read_recording,
    track_and_detections,
    triangulated,
)
from flowing_puppet_ros.evaluate.joints import (
    ARM_JOINTS,
    LEG_JOINTS,
    JointErrors,
    id_switches,
    joint_errors,
    swapped_share,
)
from flowing_puppet_ros.view.plots import Series
from flowing_puppet_ros.view.report_pictures import (
    BodyShot,
    FlowShot,
    body_mesh,
    body_shot,
    fetch,
    flow_shot,
    moving_stamps,
    people_box,
    picture_of,
    spread_over,
    track_shot,
)

STRIP_FRAMES, FLOW_FRAMES, BODY_FRAMES, MOST_VIEWS = 12, 4, 3, 6


@dataclass(frozen=True, slots=True, eq=False)
class CameraData:
    """The figures of one camera's track; rows of arrays follow `seconds` (T,) since the start."""

    name: str
    seconds: np.ndarray
    energy: np.ndarray  # (T,) NaN without a puppet
    tracked: int  # images with a puppet
    images: int
    switches: int
    errors: JointErrors  # pixels
    errors_cm: JointErrors  # centimetres at the person
    swapped: dict[str, tuple[int, int]]  # limb -> (swapped, comparable) frames
    part_names: tuple[str, ...]
    part_confidence: np.ndarray  # (P,T)


@dataclass(frozen=True, slots=True, eq=False)
class BodiesData:
    """The figures of the first body of each cloud; rows follow `seconds` (T,)."""

    seconds: np.ndarray
    energy: np.ndarray
    errors: JointErrors  # metres, against triangulated detections
    swapped: dict[str, tuple[int, int]]
    part_names: tuple[str, ...]
    part_confidence: np.ndarray  # (P,T)
    clouds: int
    frame: str


@dataclass(slots=True, eq=False)
class ReportData:
    """Everything on the page; empty lists and None stand for what the bags do not hold."""

    input_name: str
    output_name: str
    summary: Mapping[str, Any] = field(default_factory=dict)
    start: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    cameras: list[CameraData] = field(default_factory=list)
    shown_camera: str = ""
    strip: list[tuple[int, np.ndarray]] = field(default_factory=list)  # (stamp, picture)
    flow: list[FlowShot] = field(default_factory=list)
    bodies: BodiesData | None = None
    body_shots: list[BodyShot] = field(default_factory=list)

    def seconds(self, stamp: int) -> float:
        """Time since the first stamp."""
        return (stamp - self.start) * 1e-9

    def camera(self, name: str) -> CameraData | None:
        """The camera called `name`."""
        return next((camera for camera in self.cameras if camera.name == name), None)


def gather(input_bag: Path, output_bag: Path, summary: Mapping[str, Any] | None = None) -> ReportData:
    """Read both bags of a replay, also where they are cut off.

    Raises InputError when one is no bag or the output has neither puppets nor bodies.
    """
    with open_bag(input_bag, salvage=True) as given, open_bag(output_bag, salvage=True) as made:
        recording = read_recording(given, made)
        data = ReportData(input_bag.name, output_bag.name, summary or {}, recording.start, recording.counts)
        tracked = [camera for camera in recording.cameras.values() if camera.puppets]
        data.cameras = [_camera_data(camera, recording.start) for camera in tracked]
        if tracked:
            shown = max(tracked, key=lambda camera: frontality(camera.puppets))
            data.shown_camera = shown.name
            _add_track(data, shown, given)
        if recording.bodies:
            data.bodies = _bodies_data(recording)
            _add_bodies(data, recording, given, made)
    return data


def _camera_data(camera: CameraRecord, start: int) -> CameraData:
    stamps = sorted(camera.puppets)
    people = [camera.puppets[stamp] for stamp in stamps]
    frames, reference = track_and_detections(camera)
    frames = {stamp: frames[stamp] for stamp in stamps if stamp in frames}
    errors = joint_errors(frames, reference)
    scale = np.array([camera.puppets[stamp][0].scale for stamp in frames], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        centimetres = JointErrors(errors.names, errors.distance * 100 / np.where(scale > 0, scale, np.nan)[:, None])
    names, confidence = _confidence([persons[0] if persons else None for persons in people])
    return CameraData(
        name=camera.name,
        seconds=(np.array(stamps) - start) * 1e-9,
        energy=np.array([persons[0].energy if persons else np.nan for persons in people], float),
        tracked=sum(bool(persons) for persons in people),
        images=len(stamps),
        switches=id_switches([[person.id for person in persons] for persons in people]),
        errors=_all_rows(errors, list(frames), stamps),
        errors_cm=_all_rows(centimetres, list(frames), stamps),
        swapped=_swaps(frames, reference),
        part_names=names,
        part_confidence=confidence,
    )


def _all_rows(errors: JointErrors, have: list[int], stamps: list[int]) -> JointErrors:
    """Put the rows at `have` among rows of NaN for all `stamps`."""
    distance = np.full((len(stamps), len(errors.names)), np.nan)
    distance[np.searchsorted(stamps, have)] = errors.distance
    return JointErrors(errors.names, distance)


def _confidence(people: list[Any]) -> tuple[tuple[str, ...], np.ndarray]:
    """Names (P) and confidences (P,T) of the parts of one person (or None) a frame."""
    names: dict[str, None] = {}
    for person in people:
        names |= dict.fromkeys(part.name for part in person.parts) if person else {}
    values = np.full((len(names), len(people)), np.nan)
    rows = {name: row for row, name in enumerate(names)}
    for column, person in enumerate(people):
        for part in person.parts if person else ():
            values[rows[part.name], column] = part.confidence
    return tuple(names), values


def _swaps(frames: Mapping[int, Joints], reference: Mapping[int, Joints]) -> dict[str, tuple[int, int]]:
    limbs = {"arms": ARM_JOINTS, "legs": LEG_JOINTS}
    return {limb: swapped_share(frames, reference, joints) for limb, joints in limbs.items()}


def _bodies_data(recording: Recording) -> BodiesData:
    bodies = first_bodies(recording)
    stamps = sorted(bodies)
    frames = {stamp: body_joints(bodies[stamp]) for stamp in stamps}
    reference = triangulated(recording, frames)
    names, confidence = _confidence([bodies[stamp] for stamp in stamps])
    return BodiesData(
        seconds=(np.array(stamps, float) - recording.start) * 1e-9,
        energy=np.array([bodies[stamp].energy for stamp in stamps], float),
        errors=joint_errors(frames, reference),
        swapped=_swaps(frames, reference),
        part_names=names,
        part_confidence=confidence,
        clouds=len(recording.bodies),
        frame=recording.body_frame,
    )


def _add_track(data: ReportData, camera: CameraRecord, given: Bag) -> None:
    """Pictures of one camera: the strip of frames with puppets, and the flow at its liveliest frames."""
    stamps = sorted(camera.puppets)
    moving = moving_stamps(camera, FLOW_FRAMES)
    following = {stamp: stamps[stamps.index(stamp) + 1] for stamp in moving}
    seen = [stamp for stamp in stamps if camera.puppets[stamp]]
    strip = spread_over([stamp for stamp in stamps if seen and seen[0] <= stamp <= seen[-1]], STRIP_FRAMES)
    images = fetch(given, {camera.image_topic: {*strip, *following, *following.values()}})
    shown = {stamp: camera.puppets[stamp] for stamp in (*strip, *moving)}
    for stamp in strip:
        image = picture_of(images, camera.image_topic, stamp)
        if image is not None:
            data.strip.append((stamp, track_shot(image, shown[stamp], people_box(shown.values(), image.shape))))
    for stamp in moving:
        pair = [picture_of(images, camera.image_topic, s) for s in (stamp, following[stamp])]
        if pair[0] is not None and pair[1] is not None and pair[0].shape == pair[1].shape:
            box = people_box(shown.values(), pair[0].shape)
            data.flow.append(flow_shot(stamp, pair[0], pair[1], shown[stamp], box))


def _add_bodies(data: ReportData, recording: Recording, given: Bag, made: Bag) -> None:
    """Pictures of a few bodies, spread over those that were found."""
    bodies = first_bodies(recording)
    stamps = spread_over(list(bodies), BODY_FRAMES)
    topics = recording.cloud_topics
    clouds = fetch(made, dict.fromkeys(topics.values(), stamps))
    views = [c for c in recording.cameras.values() if c.camera is not None and c.image_topic][:MOST_VIEWS]
    images = fetch(given, {camera.image_topic: stamps for camera in views})
    for stamp in stamps:
        vertices = clouds.get((topics.get("body_vertices", ""), stamp))
        hull = clouds.get((topics.get("hull", ""), stamp))
        mesh = body_mesh(bodies[stamp], vertices, recording.triangles, hull)
        if mesh is None:
            continue
        shown = [(c, picture_of(images, c.image_topic, stamp)) for c in views]
        placed = [(c.name, c.camera, image) for c, image in shown if c.camera is not None and image is not None]
        data.body_shots.append(body_shot(stamp, bodies[stamp], mesh, placed))


def energy_series(data: ReportData) -> list[Series]:
    """Energy of the first puppet over time, a line per camera."""
    return [Series(camera.name, camera.seconds, camera.energy) for camera in data.cameras]


def error_series(data: ReportData) -> list[Series]:
    """Mean limb-joint error over time in pixels, a line per camera."""
    return [Series(camera.name, camera.seconds, camera.errors.per_frame()) for camera in data.cameras]
