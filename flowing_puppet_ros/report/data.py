# SPDX-License-Identifier: Apache-2.0
"""The data of a report, gathered from the two bags of a replay: figures, series over time, and pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.bag.replay.replay import METADATA_NAME
from flowing_puppet_ros.draw.pictures import shrink
from flowing_puppet_ros.draw.plots import Series
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import (
    CameraRecord,
    Joints,
    Recording,
    body_joints,
    frontality,
    match_track_to_detections,
    read_recording,
    select_first_bodies,
    sensor_cloud_topics,
    to_cloud,
    triangulate_detections,
)
from flowing_puppet_ros.evaluate.joints import (
    ARM_JOINTS,
    LEG_JOINTS,
    JointErrors,
    count_id_switches,
    count_swapped,
    measure_joint_errors,
)
from flowing_puppet_ros.report.people_in_space import SpaceData, gather_space
from flowing_puppet_ros.report.pictures.bag_pictures import (
    STRIP_HEIGHT,
    BodyShot,
    FlowShot,
    ImageBox,
    body_axes,
    decode_picture,
    draw_body_shot,
    draw_flow_shot,
    draw_track,
    fetch_messages,
    find_moving_stamps,
    find_people_box,
    list_meshed,
    pick_evenly,
    read_body_meshes,
    read_messages,
)
from flowing_puppet_ros.report.pictures.bodies_over_colour import (
    PAIR_HEIGHT,
    BodiesAtStamp,
    draw_bodies,
    find_everybody_box,
    find_nearest_stamp,
)
from flowing_puppet_ros.report.pictures.scene_3d import SceneFrame, count_affordable_frames, make_scene_data
from flowing_puppet_ros.report.scene_above import AboveData, gather_above
from flowing_puppet_ros.stream.messages.images import decode_image

MAX_STRIP_FRAMES, MAX_FLOW_FRAMES, MAX_BODY_FRAMES, MAX_VIEWS = 120, 4, 3, 6
"""Maximum numbers of pictures: of the track, of the flow, of bodies, and of cameras per body."""


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
    part_confidence: np.ndarray  # (P, T)


@dataclass(frozen=True, slots=True, eq=False)
class BodiesData:
    """The figures of the first body of each cloud; rows follow `seconds` (T,)."""

    seconds: np.ndarray
    energy: np.ndarray
    errors: JointErrors  # metres, against triangulated detections
    swapped: dict[str, tuple[int, int]]
    part_names: tuple[str, ...]
    part_confidence: np.ndarray  # (P, T)
    clouds: int
    frame: str


@dataclass(slots=True, eq=False)
class ReportData:
    """Everything on the page; empty lists and None stand for what the bags do not contain."""

    input_name: str
    output_name: str
    summary: Mapping[str, Any] = field(default_factory=dict)
    start: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    cameras: list[CameraData] = field(default_factory=list)
    shown_camera: str = ""
    strip: list[tuple[int, np.ndarray]] = field(default_factory=list)  # (stamp, picture)
    overlaid: dict[int, tuple[np.ndarray, int | None]] = field(default_factory=dict)
    """By stamps of the strip: the bodies over the image, and the stamp of their cloud, None where nobody has one."""
    flow: list[FlowShot] = field(default_factory=list)
    bodies: BodiesData | None = None
    body_shots: list[BodyShot] = field(default_factory=list)
    scene: Mapping[str, Any] | None = None
    space: SpaceData | None = None
    above: AboveData | None = None

    def seconds(self, stamp: int) -> float:
        """Return the seconds from the first stamp to `stamp` (ns)."""
        return (stamp - self.start) * 1e-9

    def camera(self, name: str) -> CameraData | None:
        """Return the camera called `name`, or None."""
        return next((camera for camera in self.cameras if camera.name == name), None)


def gather_data(input_bag: Path, output_bag: Path, summary: Mapping[str, Any] | None = None) -> ReportData:
    """Gather the data from both bags of a replay, even if they are cut off.

    InputError if one is not a bag or the output has neither puppets nor bodies.
    """
    with open_bag(input_bag, salvage=True) as given, open_bag(output_bag, salvage=True) as made:
        recording = read_recording(given, made)
        summary = _read_summary(made) | dict(summary or {})
        data = ReportData(input_bag.name, output_bag.name, summary, recording.start, recording.counts)
        tracked = [camera for camera in recording.cameras.values() if camera.puppets]
        data.cameras = [_make_camera_data(camera, recording.start) for camera in tracked]
        if tracked:
            shown = max(tracked, key=lambda camera: frontality(camera.puppets))
            data.shown_camera = shown.name
            _add_track(data, recording, shown, given, made)
            if not data.strip:
                _add_overlays(data, shown, made)
        data.space = gather_space(recording, given, made)
        data.above = gather_above(recording, given, summary)
        if recording.bodies:
            data.bodies = _make_bodies_data(recording)
            _add_bodies(data, recording, given, made)
            _add_scene(data, recording, given, made)
    return data


def _read_summary(made: Bag) -> dict[str, Any]:
    """Return the summary that the replay stored in its bag; empty if there is none."""
    try:
        return dict(json.loads(made.read_metadata(METADATA_NAME).get("replay", "{}")))
    except (ValueError, TypeError):
        return {}


def _make_camera_data(camera: CameraRecord, start: int) -> CameraData:
    stamps = sorted(camera.puppets)
    people = [camera.puppets[stamp] for stamp in stamps]
    frames, reference = match_track_to_detections(camera)
    frames = {stamp: frames[stamp] for stamp in stamps if stamp in frames}
    errors = measure_joint_errors(frames, reference)
    scale = np.array([camera.puppets[stamp][0].scale for stamp in frames], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        centimetres = JointErrors(errors.names, errors.distance * 100 / np.where(scale > 0, scale, np.nan)[:, None])
    names, confidence = _collect_confidence([persons[0] if persons else None for persons in people])
    return CameraData(
        name=camera.name,
        seconds=(np.array(stamps) - start) * 1e-9,
        energy=np.array([persons[0].energy if persons else np.nan for persons in people], float),
        tracked=sum(bool(persons) for persons in people),
        images=len(stamps),
        switches=count_id_switches([[person.id for person in persons] for persons in people]),
        errors=_spread_rows(errors, list(frames), stamps),
        errors_cm=_spread_rows(centimetres, list(frames), stamps),
        swapped=_count_swaps(frames, reference),
        part_names=names,
        part_confidence=confidence,
    )


def _spread_rows(errors: JointErrors, known: list[int], stamps: list[int]) -> JointErrors:
    """Return the errors with one row for each of `stamps`, NaN for those without errors."""
    distance = np.full((len(stamps), len(errors.names)), np.nan)
    distance[np.searchsorted(stamps, known)] = errors.distance
    return JointErrors(errors.names, distance)


def _collect_confidence(people: list[Any]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return names (P) and confidences (P, T) of the parts of one person (or None) per frame."""
    names: dict[str, None] = {}
    for person in people:
        names |= dict.fromkeys(part.name for part in person.parts) if person else {}
    values = np.full((len(names), len(people)), np.nan)
    rows = {name: row for row, name in enumerate(names)}
    for column, person in enumerate(people):
        for part in person.parts if person else ():
            values[rows[part.name], column] = part.confidence
    return tuple(names), values


def _count_swaps(frames: Mapping[int, Joints], reference: Mapping[int, Joints]) -> dict[str, tuple[int, int]]:
    limbs = {"arms": ARM_JOINTS, "legs": LEG_JOINTS}
    return {limb: count_swapped(frames, reference, joints) for limb, joints in limbs.items()}


def _make_bodies_data(recording: Recording) -> BodiesData:
    bodies = select_first_bodies(recording)
    stamps = sorted(bodies)
    frames = {stamp: body_joints(bodies[stamp]) for stamp in stamps}
    reference = triangulate_detections(recording, frames)
    names, confidence = _collect_confidence([bodies[stamp] for stamp in stamps])
    return BodiesData(
        seconds=(np.array(stamps, float) - recording.start) * 1e-9,
        energy=np.array([bodies[stamp].energy for stamp in stamps], float),
        errors=measure_joint_errors(frames, reference),
        swapped=_count_swaps(frames, reference),
        part_names=names,
        part_confidence=confidence,
        clouds=len(recording.bodies),
        frame=recording.body_frame,
    )


def _add_track(data: ReportData, recording: Recording, camera: CameraRecord, given: Bag, made: Bag) -> None:
    """Add the pictures of one camera: frames with puppets and bodies, and the flow at the frames with most motion."""
    stamps = sorted(camera.puppets)
    moving = find_moving_stamps(camera, MAX_FLOW_FRAMES)
    following = {stamp: stamps[stamps.index(stamp) + 1] for stamp in moving}
    tracked = [stamp for stamp in stamps if camera.puppets[stamp]]
    strip = pick_evenly([stamp for stamp in stamps if tracked and tracked[0] <= stamp <= tracked[-1]], MAX_STRIP_FRAMES)
    _add_strip(data, camera, given, strip, _read_bodies_at(recording, camera, made, strip))
    people = [camera.puppets[stamp] for stamp in (*strip, *moving)]
    images = fetch_messages(given, {camera.image_topic: {*following, *following.values()}})
    for stamp in moving:
        pair = [decode_picture(images, camera.image_topic, s) for s in (stamp, following[stamp])]
        if pair[0] is not None and pair[1] is not None and pair[0].shape == pair[1].shape:
            box = find_people_box(people, pair[0].shape)
            data.flow.append(draw_flow_shot(stamp, pair[0], pair[1], camera.puppets[stamp], box))


def _add_strip(
    data: ReportData, camera: CameraRecord, given: Bag, strip: list[int], bodies: Mapping[int, BodiesAtStamp]
) -> None:
    """Add the images at the stamps `strip` with puppets, and beside them with the `bodies` of their clouds."""
    people = [camera.puppets[stamp] for stamp in strip]
    boxes: dict[tuple[int, ...], ImageBox] = {}
    seen_by = camera.camera if bodies else None
    for (_, stamp), message in read_messages(given, {camera.image_topic: strip}):
        with suppress(InputError):
            image = decode_image(message)
            shape = image.shape
            if shape not in boxes:
                everybody = seen_by and find_everybody_box(seen_by, bodies.values(), people, shape)
                boxes[shape] = everybody or find_people_box(people, shape)
            box = boxes[shape]
            if seen_by is None:
                picture = draw_track(image, camera.puppets[stamp], box)
            else:
                picture = draw_track(image, camera.puppets[stamp], box, PAIR_HEIGHT)
                there = bodies.get(stamp)
                drawn = draw_bodies(image, seen_by, there, box)
                data.overlaid[stamp] = (drawn, there.stamp if there else None)
            data.strip.append((stamp, picture))


def _read_bodies_at(
    recording: Recording, camera: CameraRecord, made: Bag, strip: list[int]
) -> dict[int, BodiesAtStamp]:
    """Return the bodies of the nearest cloud for each stamp of an image that has some, if the camera is calibrated."""
    if camera.camera is None:
        return {}
    there = {stamp: find_nearest_stamp(list(recording.bodies), stamp) for stamp in strip}
    topic = recording.cloud_topics.get("body_vertices", "")
    wanted = {stamp for stamp in there.values() if stamp is not None}
    clouds = {stamp: one for (_, stamp), one in fetch_messages(made, {topic: wanted}).items()}
    found: dict[int, BodiesAtStamp] = {}
    for stamp, cloud in there.items():
        bodies = [] if cloud is None else list_meshed(recording.bodies[cloud])
        meshes = read_body_meshes(bodies, clouds.get(cloud or 0), recording.triangles, None)
        if cloud is not None and meshes:
            found[stamp] = BodiesAtStamp(cloud, [body.id for body in bodies], meshes)
    return found


def _add_overlays(data: ReportData, camera: CameraRecord, made: Bag) -> None:
    """Add the overlays that the replay made, if the input's images are missing."""
    for topic in (f"{camera.namespace}/overlay/compressed", f"{camera.namespace}/overlay"):
        for (_, stamp), message in read_messages(made, {topic: pick_evenly(list(camera.puppets), MAX_STRIP_FRAMES)}):
            with suppress(InputError):
                data.strip.append((stamp, shrink(decode_image(message), STRIP_HEIGHT)))
        if data.strip:
            return


def _add_bodies(data: ReportData, recording: Recording, given: Bag, made: Bag) -> None:
    """Add pictures of a few bodies, spread evenly over all."""
    bodies = select_first_bodies(recording)
    stamps = pick_evenly(list(bodies), MAX_BODY_FRAMES)
    clouds = _fetch_clouds(recording, given, made, stamps)
    views = [c for c in recording.cameras.values() if c.camera is not None and c.image_topic][:MAX_VIEWS]
    at = {(c.name, stamp): find_nearest_stamp(list(c.puppets), stamp) for c in views for stamp in stamps}
    wanted = {c.image_topic: [at[c.name, stamp] or stamp for stamp in stamps] for c in views}
    images = fetch_messages(given, wanted)
    for stamp in stamps:
        meshes = read_body_meshes(
            [bodies[stamp]], clouds.vertices.get(stamp), recording.triangles, clouds.points.get(stamp)
        )
        if not meshes:
            continue
        shown = [(c, decode_picture(images, c.image_topic, at[c.name, stamp] or stamp)) for c in views]
        images_of = [(c.name, c.camera, image) for c, image in shown if c.camera is not None and image is not None]
        data.body_shots.append(draw_body_shot(stamp, bodies[stamp], meshes[0], images_of))


def _add_scene(data: ReportData, recording: Recording, given: Bag, made: Bag) -> None:
    """Add the meshes of as many stamps as fit on one page."""
    found = [stamp for stamp, bodies in recording.bodies.items() if bodies]
    if not found or not len(recording.triangles):
        return
    max_bodies = max(len(recording.bodies[stamp]) for stamp in found)
    stamps = pick_evenly(found, count_affordable_frames(max_bodies, int(recording.triangles.max()) + 1))
    clouds = _fetch_clouds(recording, given, made, stamps)
    frames = []
    for stamp in stamps:
        vertices, points = clouds.vertices.get(stamp), clouds.points.get(stamp)
        meshes = read_body_meshes(list_meshed(recording.bodies[stamp]), vertices, recording.triangles, points)
        if meshes:
            frames.append(SceneFrame(data.seconds(stamp), meshes))
    if frames:
        forward, _, up = body_axes(body_joints(recording.bodies[stamps[0]][0]))
        data.scene = make_scene_data(frames, forward, up)


@dataclass(frozen=True, slots=True, eq=False)
class _Clouds:
    """Messages by stamp: vertices of the bodies, and the points that they were fitted to."""

    vertices: dict[int, Any]
    points: dict[int, Any]


def _fetch_clouds(recording: Recording, given: Bag, made: Bag, stamps: list[int]) -> _Clouds:
    topics = recording.cloud_topics
    vertices = fetch_messages(made, {topics.get("body_vertices", ""): stamps})
    points = {stamp: one for (_, stamp), one in fetch_messages(made, {topics.get("hull", ""): stamps}).items()}
    for topic in () if points else sensor_cloud_topics(recording):
        for (_, stamp), message in read_messages(given, {topic: stamps}):
            with suppress(InputError):
                points[stamp] = to_cloud(recording, topic, message)
    return _Clouds({stamp: one for (_, stamp), one in vertices.items()}, points)


def make_energy_series(data: ReportData) -> list[Series]:
    """Return the energy of the first puppet over time, one line per camera."""
    return [Series(camera.name, camera.seconds, camera.energy) for camera in data.cameras]


def make_error_series(data: ReportData) -> list[Series]:
    """Return the mean limb-joint error over time in pixels, one line per camera."""
    return [Series(camera.name, camera.seconds, camera.errors.per_frame()) for camera in data.cameras]
