# SPDX-License-Identifier: Apache-2.0
"""What kind of input a file or folder is, and which verb reads it."""

from __future__ import annotations

import shlex
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.bag.storage.paths import is_bag
from flowing_puppet_ros.body.scans.names import SCAN_SUFFIXES, SUFFIXES
from flowing_puppet_ros.image.formats.video_reader import IMAGE_SUFFIXES


class Kind(StrEnum):
    """The kinds of inputs."""

    BAG = "bag"
    SCAN = "scan"
    FIT = "fitted body"
    DEPTH = "depth image"
    IMAGE = "image"
    VIDEO = "video"
    KEYPOINTS = "keypoints"
    BAGS = "folder of bags"
    SCANS = "folder of scans"
    IMAGES = "folder of images"
    OTHER = "unknown"


_READERS = {
    Kind.BAG: ("replay", "track"),
    Kind.BAGS: ("replay",),
    Kind.SCAN: ("fit",),
    Kind.SCANS: ("fit",),
    Kind.FIT: ("export",),
    Kind.DEPTH: ("fit",),
    Kind.IMAGE: ("pose", "track"),
    Kind.IMAGES: ("pose", "track"),
    Kind.VIDEO: ("track",),
}
"""Verbs that read a kind of input, the usual one first."""
_VERBS_WITH_INPUT = frozenset({"fit", "pose", "track", "replay", "export"})


def recognise(path: Path) -> Kind:
    """Return what a file or folder is, by its content where the name leaves it open."""
    if path.is_dir():
        return _recognise_folder(path)
    suffix = path.suffix.lower()
    if is_bag(path):
        return Kind.BAG
    if suffix == ".json":
        return Kind.KEYPOINTS
    if suffix in IMAGE_SUFFIXES:
        return Kind.DEPTH if _is_depth_image(path) else Kind.IMAGE
    if suffix == ".npz" and _is_fit(path):
        return Kind.FIT
    if suffix in SUFFIXES:
        return Kind.SCAN
    return Kind.VIDEO if _is_video(path) else Kind.OTHER


def make_command(kind: Kind, path: Path) -> str:
    """Return the usual command for an input of some kind, "" if no verb reads it by itself."""
    given, stem = shlex.quote(str(path)), shlex.quote(path.name.partition(".")[0] or "result")
    return {
        Kind.BAG: f"flowing-puppet replay {given} --out out/{stem}.mcap --report out/{stem}.html",
        Kind.BAGS: f"flowing-puppet replay {given} --out out",
        Kind.SCAN: f"flowing-puppet fit {given} --out fits",
        Kind.SCANS: f"flowing-puppet fit {given} --out fits",
        Kind.FIT: f"flowing-puppet export {given} --to glb --out out",
        Kind.DEPTH: f"flowing-puppet fit {given} --camera-info FX,FY,CX,CY --out fits",
        Kind.IMAGE: f"flowing-puppet pose {given} --out poses.json",
        Kind.IMAGES: f"flowing-puppet track {given} --out tracks.json",
        Kind.VIDEO: f"flowing-puppet track {given} --out tracks.json",
        Kind.KEYPOINTS: f"flowing-puppet track VIDEO --init {given} --out tracks.json",
    }.get(kind, "")


def suggest(verb: str, path: Path, error: str) -> str:
    """Return the end of the sentence in which `verb` refused a path: the command to run instead, "" if none helps.

    That is the one that reads the path. A recording that `verb` can read, but not this one, is one for the doctor
    unless the `error` names a flag that helps.
    """
    if verb not in _VERBS_WITH_INPUT or not path.exists():
        return ""
    kind = recognise(path)
    readers = _READERS.get(kind, ())
    if readers and verb not in readers:
        return f"; `{make_command(kind, path)}` reads it"
    if kind is Kind.BAG and " --" not in error:
        return f"; `flowing-puppet doctor {shlex.quote(str(path))}` says more"
    return ""


def _recognise_folder(path: Path) -> Kind:
    if is_bag(path):
        return Kind.BAG
    files = [file for file in path.iterdir() if file.is_file()]
    endings = {file.suffix.lower() for file in files}
    if any(is_bag(file) for file in files):
        return Kind.BAGS
    if endings & IMAGE_SUFFIXES:
        return Kind.IMAGES
    if endings & set(SCAN_SUFFIXES):
        return Kind.SCANS
    if ".json" in endings:
        return Kind.KEYPOINTS
    return Kind.BAGS if any(is_bag(each) for each in path.iterdir()) else Kind.OTHER


def _is_depth_image(path: Path) -> bool:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image is not None and image.ndim == 2 and image.dtype in (np.uint16, np.float32)


def _is_fit(path: Path) -> bool:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {"part_rotation", "shape_coefficients", "joints"} <= set(arrays.files)
    except (OSError, ValueError, EOFError):
        return False


def _is_video(path: Path) -> bool:
    capture = cv2.VideoCapture(str(path))
    try:
        return bool(capture.isOpened() and capture.read()[0])
    finally:
        capture.release()
