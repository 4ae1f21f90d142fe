# SPDX-License-Identifier: Apache-2.0
"""Inspect files and folders that are no recordings: scans, images, videos, keypoints."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.bag.storage.paths import is_bag
from flowing_puppet_ros.body.scans.names import SCAN_SUFFIXES, SUFFIXES, UNITS
from flowing_puppet_ros.body.scans.scan import Scan, read_scan
from flowing_puppet_ros.body.scans.unit import (
    GUESS,
    MAX_ADULT_EXTENT_M,
    MAX_SCENE_EXTENT_M,
    METRIC_UNITS,
    is_closed,
    propose_units,
)
from flowing_puppet_ros.body.scans.viewpoint import find_viewpoint
from flowing_puppet_ros.body.segmentation.pieces import split_pieces
from flowing_puppet_ros.body.segmentation.up_axis import has_floor
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.doctor.recognise import Kind, make_command
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoint_files import read_labelled
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES, open_frames

SAMPLED_POINTS = 20_000
MIN_POINTS = 25
"""Points of a person from which a body can be fitted at all."""
MIN_IMAGE_SIDE_PX = 100
"""Height in pixels below which no person in an image is large enough to be posed."""
MIN_FRAME_RATE = 10.0
"""Frames a second below which people move too far between frames to be followed by optical flow alone."""


def inspect_file(path: Path, kind: Kind, found: Inspection) -> None:
    """Add what can be computed from a file or folder of some kind, and what is wrong, to the findings."""
    try:
        _INSPECTORS[kind](path, kind, found)
    except InputError as error:
        found.add("error", str(error))


def _inspect_scan(path: Path, kind: Kind, found: Inspection) -> None:
    scan = read_scan(path)
    size = np.ptp(scan.points, axis=0)
    what = "cloud" if scan.faces is None else f"mesh of {len(scan.faces)} faces and"
    shown = " x ".join(f"{side:.3g}" for side in size)
    found.add("note", f"a {what} of {len(scan.points)} points, {shown} units" + (", closed" if is_closed(scan) else ""))
    if len(scan.points) < MIN_POINTS:
        found.add("error", f"{len(scan.points)} points show no person; a body needs {MIN_POINTS} at least")
        return
    command = make_command(kind, path)
    longest = float(size.max())
    scene = [name for name in METRIC_UNITS if MAX_ADULT_EXTENT_M < longest * UNITS[name] <= MAX_SCENE_EXTENT_M]
    unit = propose_units(scan)[0]
    points = scan.sample_surface(SAMPLED_POINTS, np.random.default_rng(0))[0]
    if scene and unit.name not in METRIC_UNITS:
        person = "" if unit.name == GUESS else f" (or one person in {unit.name}: `{command} --unit {unit.name}`)"
        found.add(
            "ready", f"the longest side is {longest:.3g} units, a room or a street in {scene[0]}{person}: people are"
            " found in it and fitted", f"{command} --scene",
        )  # fmt: skip
        return
    if unit.name == GUESS:
        found.add(
            "warning", f"the longest side is {longest:.3g} units, an adult's in no unit; {unit.metres:.3g} metres per"
            " unit would make it one", f"{command} --unit m",
        )  # fmt: skip
    else:
        found.add("note", f"the unit is taken for {unit.name}")
    _tell_people(scan, points * unit.metres, found, command)


def _tell_people(scan: Scan, points: np.ndarray, found: Inspection, command: str) -> None:
    """Add how many people a scan shows and from which sides; `points` (N, 3) are metres."""
    pieces = split_pieces(scan)
    if has_floor(points):
        found.add("ready", "a floor or a wall is in the scan: people are found on it and fitted", f"{command} --scene")
        return
    if pieces.are_people:
        found.add("note", f"{len(pieces.large)} pieces stand apart: one body each, if each is a person")
    sides = "all sides"
    if not is_closed(scan) and find_viewpoint(scan.points, scan.viewpoint) is not None:
        sides = "the one side that a sensor sees"
    found.add("ready", f"a body can be fitted to {sides}", command)


def _inspect_scans(path: Path, kind: Kind, found: Inspection) -> None:
    files = [file for file in path.iterdir() if file.suffix.lower() in SCAN_SUFFIXES]
    found.add("ready", f"{len(files)} scans, each gets a body of its own", make_command(kind, path))


def _inspect_fit(path: Path, kind: Kind, found: Inspection) -> None:
    with np.load(path, allow_pickle=False) as arrays:
        reliable = bool(arrays["reliable"]) if "reliable" in arrays.files else True
    if not reliable:
        found.add("warning", "the fit is not reliable: a limb may be wrong, or it is no person")
    found.add(
        "ready", "a body fitted by `fit`, which other programs read when it is exported", make_command(kind, path)
    )


def _inspect_depth(path: Path, kind: Kind, found: Inspection) -> None:
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if depth is None:
        raise InputError(f"{path} is not a readable image; remove or replace it")
    known = depth[np.isfinite(depth) & (depth > 0)]
    if not len(known):
        found.add("error", "a depth image of zeros: nothing was measured")
        return
    near, far = np.percentile(known, [1, 99])
    found.add(
        "note", f"a depth image of {depth.shape[1]}x{depth.shape[0]}, {near:.4g} to {far:.4g} units, which are"
        " millimetres unless --unit names another",
    )  # fmt: skip
    found.add(
        "ready", "given the camera's calibration, a file of its CameraInfo or four numbers in pixels, people are found"
        " in it and fitted", make_command(kind, path),
    )  # fmt: skip


def _inspect_image(path: Path, kind: Kind, found: Inspection) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path} is not a readable image; remove or replace it")
    _tell_size(image.shape, found)
    found.add("ready", "people are found and posed", make_command(kind, path))


def _inspect_images(path: Path, kind: Kind, found: Inspection) -> None:
    source = open_frames(path, lambda sentence: found.add("warning", sentence))
    sizes = {frame.image.shape for frame in source}
    if len(sizes) > 1:
        found.add(
            "ready", f"{source.count} images of {len(sizes)} sizes, so no video: people are posed in each",
            f"flowing-puppet pose {path} --out poses.json",
        )  # fmt: skip
        return
    _tell_size(sizes.pop(), found)
    found.add("ready", f"{source.count} images, tracked in the order of their names", make_command(kind, path))


def _inspect_video(path: Path, kind: Kind, found: Inspection) -> None:
    source = open_frames(path)
    size = source.read_size(0)
    if size is None:
        raise InputError(f"{path} has no frame that can be decoded; it is broken or its codec is unknown")
    _tell_size(size[::-1], found)
    if source.fps < MIN_FRAME_RATE:
        found.add("warning", f"{source.fps:.3g} frames a second: fast limbs are lost between frames")
    found.add("ready", f"about {source.count} frames at {source.fps:.4g} Hz are tracked", make_command(kind, path))


def _tell_size(shape: tuple[int, ...], found: Inspection) -> None:
    height, width = shape[:2]
    if height < MIN_IMAGE_SIDE_PX:
        found.add("warning", f"images of {width}x{height} pixels are too small for most people in them")
    else:
        found.add("note", f"images of {width}x{height} pixels")


def _inspect_keypoints(path: Path, kind: Kind, found: Inspection) -> None:
    people = read_labelled(path).people
    persons = [person for each in people.values() for person in each]
    if not persons:
        found.add("error", f"{path} has no person in any frame")
        return
    joints = sum(len(person.names) for person in persons) / len(persons)
    found.add("note", f"{len(persons)} people in {len(people)} frames, {joints:.0f} joints each")
    found.add("ready", "the keypoints of the people in a video or in images", make_command(kind, path))


def _inspect_bags(path: Path, kind: Kind, found: Inspection) -> None:
    count = sum(is_bag(each) for each in path.iterdir())
    found.add("ready", f"{count} recordings, each is replayed by itself", make_command(kind, path))


def _inspect_other(path: Path, _: Kind, found: Inspection) -> None:
    found.add(
        "error", f"{path} is nothing that is read: bags (.mcap .db3 .bag), meshes and clouds ({' '.join(SUFFIXES)}),"
        f" images ({' '.join(sorted(IMAGE_SUFFIXES))}), videos, keypoints (.json)",
    )  # fmt: skip


_INSPECTORS = {
    Kind.SCAN: _inspect_scan,
    Kind.SCANS: _inspect_scans,
    Kind.FIT: _inspect_fit,
    Kind.DEPTH: _inspect_depth,
    Kind.IMAGE: _inspect_image,
    Kind.IMAGES: _inspect_images,
    Kind.VIDEO: _inspect_video,
    Kind.KEYPOINTS: _inspect_keypoints,
    Kind.BAGS: _inspect_bags,
    Kind.OTHER: _inspect_other,
}
