# SPDX-License-Identifier: Apache-2.0
"""What a report shows, gathered from the two bags of a replay: figures, series over time, and pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.bag.replay import NOTE
from flowing_puppet_ros.draw.pictures import shrink
from flowing_puppet_ros.draw.plots import Series
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import (
    CameraRecord,
    Joints,
    Recording,
    as_cloud,
    body_joints,
    first_bodies,
    frontality,
    read_recording,
    sensed_clouds,
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
from flowing_puppet_ros.report.bag_pictures import (
    STRIP_HEIGHT,
    BodyShot,
    FlowShot,
    body_meshes,
    body_shot,
    each,
    facing,
    fetch,
    flow_shot,
    moving_stamps,
    people_box,
    picture_of,
    spread_over,
    track_shot,
)
from flowing_puppet_ros.report.scene_3d import SceneFrame, frames_in_budget, scene_data
from flowing_puppet_ros.stream.messages.images import decode_image

STRIP_FRAMES, FLOW_FRAMES, BODY_FRAMES, MOST_VIEWS = 120, 4, 3, 6


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
    scene: Mapping[str, Any] | None = None

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
        told = _recorded(made) | dict(summary or {})
        data = ReportData(input_bag.name, output_bag.name, told, recording.start, recording.counts)
        tracked = [camera for camera in recording.cameras.values() if camera.puppets]
        data.cameras = [_camera_data(camera, recording.start) for camera in tracked]
        if tracked:
            shown = max(tracked, key=lambda camera: frontality(camera.puppets))
            data.shown_camera = shown.name
            _add_track(data, shown, given)
            if not data.strip:
                _add_overlays(data, shown, made)
        if recording.bodies:
            data.bodies = _bodies_data(recording)
            _add_bodies(data, recording, given, made)
            _add_scene(data, recording, given, made)
    return data


def _recorded(made: Bag) -> dict[str, Any]:
    """What the replay wrote into its bag about itself."""
    try:
        return dict(json.loads(made.note(NOTE).get("replay", "{}")))
    except (ValueError, TypeError):
        return {}


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
    """Pictures of one camera: the frames with puppets, and the flow at its liveliest frames."""
    stamps = sorted(camera.puppets)
    moving = moving_stamps(camera, FLOW_FRAMES)
    following = {stamp: stamps[stamps.index(stamp) + 1] for stamp in moving}
    seen = [stamp for stamp in stamps if camera.puppets[stamp]]
    strip = spread_over([stamp for stamp in stamps if seen and seen[0] <= stamp <= seen[-1]], STRIP_FRAMES)
    people = [camera.puppets[stamp] for stamp in (*strip, *moving)]
    for (_, stamp), message in each(given, {camera.image_topic: strip}):
        with suppress(InputError):
            image = decode_image(message)
            picture = track_shot(image, camera.puppets[stamp], people_box(people, image.shape))
            data.strip.append((stamp, picture))
    images = fetch(given, {camera.image_topic: {*following, *following.values()}})
    for stamp in moving:
        pair = [picture_of(images, camera.image_topic, s) for s in (stamp, following[stamp])]
        if pair[0] is not None and pair[1] is not None and pair[0].shape == pair[1].shape:
            box = people_box(people, pair[0].shape)
            data.flow.append(flow_shot(stamp, pair[0], pair[1], camera.puppets[stamp], box))


def _add_overlays(data: ReportData, camera: CameraRecord, made: Bag) -> None:
    """The overlays that the replay made, for want of the input's images."""
    for topic in (f"{camera.namespace}/overlay/compressed", f"{camera.namespace}/overlay"):
        for (_, stamp), message in each(made, {topic: spread_over(list(camera.puppets), STRIP_FRAMES)}):
            with suppress(InputError):
                data.strip.append((stamp, shrink(decode_image(message), STRIP_HEIGHT)))
        if data.strip:
            return


def _add_bodies(data: ReportData, recording: Recording, given: Bag, made: Bag) -> None:
    """Pictures of a few bodies, spread over those that were found."""
    bodies = first_bodies(recording)
    stamps = spread_over(list(bodies), BODY_FRAMES)
    clouds = _clouds(recording, given, made, stamps)
    views = [c for c in recording.cameras.values() if c.camera is not None and c.image_topic][:MOST_VIEWS]
    images = fetch(given, {camera.image_topic: stamps for camera in views})
    for stamp in stamps:
        meshes = body_meshes([bodies[stamp]], clouds.vertices.get(stamp), recording.triangles, clouds.points.get(stamp))
        if not meshes:
            continue
        shown = [(c, picture_of(images, c.image_topic, stamp)) for c in views]
        placed = [(c.name, c.camera, image) for c, image in shown if c.camera is not None and image is not None]
        data.body_shots.append(body_shot(stamp, bodies[stamp], meshes[0], placed))


def _add_scene(data: ReportData, recording: Recording, given: Bag, made: Bag) -> None:
    """The meshes of as many stamps as one page can hold."""
    found = [stamp for stamp, bodies in recording.bodies.items() if bodies]
    if not found or not len(recording.triangles):
        return
    most = max(len(recording.bodies[stamp]) for stamp in found)
    stamps = spread_over(found, frames_in_budget(most, int(recording.triangles.max()) + 1))
    clouds = _clouds(recording, given, made, stamps)
    frames = []
    for stamp in stamps:
        vertices, points = clouds.vertices.get(stamp), clouds.points.get(stamp)
        meshes = body_meshes(recording.bodies[stamp], vertices, recording.triangles, points)
        if meshes:
            frames.append(SceneFrame(data.seconds(stamp), meshes))
    if frames:
        forward, _, up = facing(body_joints(recording.bodies[stamps[0]][0]))
        data.scene = scene_data(frames, forward, up)


@dataclass(frozen=True, slots=True, eq=False)
class _Clouds:
    """Messages by stamp: the vertices of the bodies, and the points that they were fitted to."""

    vertices: dict[int, Any]
    points: dict[int, Any]


def _clouds(recording: Recording, given: Bag, made: Bag, stamps: list[int]) -> _Clouds:
    topics = recording.cloud_topics
    vertices = fetch(made, {topics.get("body_vertices", ""): stamps})
    points = {stamp: one for (_, stamp), one in fetch(made, {topics.get("hull", ""): stamps}).items()}
    for topic in () if points else sensed_clouds(recording):
        for (_, stamp), message in each(given, {topic: stamps}):
            with suppress(InputError):
                points[stamp] = as_cloud(recording, topic, message)
    return _Clouds({stamp: one for (_, stamp), one in vertices.items()}, points)


def energy_series(data: ReportData) -> list[Series]:
    """Energy of the first puppet over time, a line per camera."""
    return [Series(camera.name, camera.seconds, camera.energy) for camera in data.cameras]


def error_series(data: ReportData) -> list[Series]:
    """Mean limb-joint error over time in pixels, a line per camera."""
    return [Series(camera.name, camera.seconds, camera.errors.per_frame()) for camera in data.cameras]
