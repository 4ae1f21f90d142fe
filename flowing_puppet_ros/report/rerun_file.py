# SPDX-License-Identifier: Apache-2.0
"""Recordings for the Rerun viewer (.rrd): images, joints, outlines, clouds and meshes of a replay or of fits.

Needs the package rerun-sdk, which is imported only here: pip install 'flowing_puppet_ros[rerun]'.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.bag.reader import Bag, open_bag
from flowing_puppet_ros.draw.overlay import DrawnPuppet
from flowing_puppet_ros.draw.palette import joint_colour, part_colours
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import (
    CameraRecord,
    Recording,
    body_joints,
    puppet_joints,
    read_recording,
    sensor_cloud_topics,
    to_cloud,
)
from flowing_puppet_ros.extras import import_extra
from flowing_puppet_ros.report.pictures.bag_pictures import read_body_meshes
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image

WORLD = "world"
TIMELINE = "stamp"
POINT_COLOUR = (31, 111, 208)
POINT_RADIUS_M = 0.004  # joints are four times as large


def import_rerun() -> Any:
    """Return the package rerun-sdk; InputError says how to install it if it is missing."""
    return import_extra("rerun", "rerun", "--rerun")


def write_replay(input_bag: Path, output_bag: Path, path: Path) -> None:
    """Write the input and the results of a replay as one recording, in the time of the stamps.

    InputError if a bag cannot be used, the file cannot be written, or rerun-sdk is missing.
    """
    with open_bag(input_bag, salvage=True) as given, open_bag(output_bag, salvage=True) as made:
        recording = read_recording(given, made)
        log = _Log(path)
        for camera in recording.cameras.values():
            _log_camera(log, camera)
            _log_images(log, camera, given)
            _log_puppets(log, camera)
        _log_bodies(log, recording, made)
        _log_points(log, recording, given, made)
        log.close()


def write_fits(fits: Iterable[tuple[str, np.ndarray, Path]], path: Path) -> None:
    """Write fits, each as (name, points (N, 3) of the scan, the .npz that `fit` wrote), as one recording."""
    log = _Log(path)
    for name, points, archive in fits:
        place = f"{WORLD}/{name}"
        with np.load(archive) as fit:
            colours = part_colours(fit["part_names"].tolist())[fit["part_of_vertex"]]
            log.log_mesh(f"{place}/body", fit["vertices"], fit["faces"], colours)
            log.log_points(f"{place}/body/joints", fit["joints"], fit["joint_names"].tolist())
        log.log_points(f"{place}/scan", points)
    log.close()


class _Log:
    """A recording being written; everything is logged at the stamp that was set last, or at all times."""

    def __init__(self, path: Path) -> None:
        self._rerun = import_rerun()
        self._stream = self._rerun.RecordingStream("flowing_puppet_ros")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}; choose another path") from error
        self._stream.save(str(path))
        self._static = True
        self.log(WORLD, self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP)

    def set_stamp(self, stamp: int) -> None:
        """Log at a stamp in nanoseconds from here on."""
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(stamp, "ns"))
        self._static = False

    def set_static(self) -> None:
        """Log at all times from here on."""
        self._static = True

    def log(self, place: str, what: Any) -> None:
        self._stream.log(place, what, static=self._static)

    def log_mesh(self, place: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> None:
        self.log(
            place,
            self._rerun.Mesh3D(
                vertex_positions=vertices.astype(np.float32),
                triangle_indices=faces.astype(np.uint32),
                vertex_colors=np.rint(colours).astype(np.uint8),
            ),
        )

    def log_points(self, place: str, points: np.ndarray, names: Sequence[str] = ()) -> None:
        """Log points of one colour, or named joints in the colours of their sides."""
        colours = [joint_colour(name) for name in names] or [POINT_COLOUR]
        known = np.isfinite(points).all(axis=1)
        if names:
            names = [name for name, there in zip(names, known, strict=True) if there]
            colours = [colour for colour, there in zip(colours, known, strict=True) if there]
        found = self._rerun.Points3D(
            positions=points[known].astype(np.float32),
            radii=[4 * POINT_RADIUS_M if names else POINT_RADIUS_M],
            colors=np.array(colours, np.uint8),
            labels=list(names) or None,
            show_labels=False,
        )
        self.log(place, found)

    def log_pixels(self, place: str, points: np.ndarray, names: Sequence[str]) -> None:
        colours = np.array([joint_colour(name) for name in names], np.uint8)
        found = self._rerun.Points2D(
            positions=points.astype(np.float32), radii=[4.0], colors=colours, labels=list(names), show_labels=False
        )
        self.log(place, found)

    def log_outlines(self, place: str, strips: Sequence[np.ndarray], colours: np.ndarray) -> None:
        closed = [np.concatenate([strip, strip[:1]]).astype(np.float32) for strip in strips]
        self.log(place, self._rerun.LineStrips2D(strips=closed, colors=colours))

    def log_image(self, place: str, message: Any) -> None:
        """Log an image message; compressed data stays as it is."""
        kind = str(getattr(message, "format", ""))
        if "jpeg" in kind or "jpg" in kind or "png" in kind:
            media = "image/png" if "png" in kind else "image/jpeg"
            encoded = self._rerun.EncodedImage(contents=bytes(message.data), media_type=media)
            self.log(place, encoded)
        else:
            self.log(place, self._rerun.Image(decode_image(message)))

    def log_camera(self, place: str, record: CameraRecord) -> None:
        assert record.camera is not None
        camera = record.camera
        self.log(place, self._rerun.Transform3D(translation=camera.centre, mat3x3=camera.rotation.T))
        self.log(place, self._rerun.Pinhole(image_from_camera=camera.matrix, resolution=list(camera.size)))

    def clear(self, place: str) -> None:
        self.log(place, self._rerun.Clear(recursive=True))

    def close(self) -> None:
        self._stream.flush()
        self._stream.disconnect()


def _entity_path(camera: CameraRecord) -> str:
    return f"{WORLD}/cameras/{camera.name}" if camera.camera is not None else f"cameras/{camera.name}"


def _log_camera(log: _Log, camera: CameraRecord) -> None:
    log.set_static()
    if camera.camera is not None:
        log.log_camera(_entity_path(camera), camera)


def _log_images(log: _Log, camera: CameraRecord, given: Bag) -> None:
    for record in given.messages([camera.image_topic] if camera.image_topic else []):
        with suppress(InputError):
            log.set_stamp(stamp_ns(record.message))
            log.log_image(f"{_entity_path(camera)}/image", record.message)


def _log_puppets(log: _Log, camera: CameraRecord) -> None:
    shown: set[str] = set()
    for stamp in sorted(camera.puppets):
        log.set_stamp(stamp)
        places = {f"{_entity_path(camera)}/image/puppets/{person.id}": person for person in camera.puppets[stamp]}
        for place in sorted(shown - places.keys()):
            log.clear(place)
        for place, person in places.items():
            joints = puppet_joints(person)
            if joints:
                log.log_pixels(f"{place}/joints", np.stack(list(joints.values())), list(joints))
            drawn = DrawnPuppet.from_message(person)
            if drawn.contours:
                log.log_outlines(f"{place}/outlines", drawn.contours, part_colours(drawn.part_names))
        shown = set(places)


def _log_bodies(log: _Log, recording: Recording, made: Bag) -> None:
    """Log meshes, or joints alone if a bag has no vertices; clear a body that is gone."""
    topic = recording.cloud_topics.get("body_vertices")
    vertices = {}
    for record in made.messages([topic]) if topic else ():
        with suppress(InputError):
            vertices[stamp_ns(record.message)] = record.message
    shown: set[str] = set()
    for stamp in sorted(recording.bodies):
        bodies = recording.bodies[stamp]
        log.set_stamp(stamp)
        places = [f"{WORLD}/bodies/{body.id}" for body in bodies]
        for place in sorted(shown - set(places)):
            log.clear(place)
        meshes = read_body_meshes(bodies, vertices.get(stamp), recording.triangles, None)
        for place, mesh in zip(places, meshes, strict=False):
            log.log_mesh(place, mesh.vertices, mesh.faces, mesh.colours)
        for place, body in zip(places, bodies, strict=True):
            joints = body_joints(body)
            if joints:
                log.log_points(f"{place}/joints", np.stack(list(joints.values())), list(joints))
        shown = set(places)


def _log_points(log: _Log, recording: Recording, given: Bag, made: Bag) -> None:
    hull = recording.cloud_topics.get("hull")
    for bag, name, topics in (
        (made, "hull", [hull] if hull else []),
        (given, "points", sensor_cloud_topics(recording)),
    ):
        for record in bag.messages(topics) if topics else ():
            with suppress(InputError):
                points = decode_cloud(to_cloud(recording, record.topic, record.message))[0]
                log.set_stamp(stamp_ns(record.message))
                log.log_points(f"{WORLD}/{name}", points)
