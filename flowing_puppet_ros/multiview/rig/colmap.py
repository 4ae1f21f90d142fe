# SPDX-License-Identifier: Apache-2.0
"""Calibrations of COLMAP as text: cameras.txt and images.txt.

The unit of a reconstruction is arbitrary. The middle of the top-left pixel is (0.5, 0.5) in COLMAP and (0, 0) here. A
camera is called as the folder of its images, or else as its only image.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera, make_rig_camera

CAMERAS, IMAGES = "cameras.txt", "images.txt"
# Parameters of COLMAP's camera models: number of focal lengths, and which coefficients follow the principal point.
_MODELS = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
_LENS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_IMAGE_FIELDS = 10
UNKNOWN_UNIT = "unknown"


def read_colmap_rig(folder: Path) -> CameraRig:
    """Read cameras.txt and images.txt of a folder; of several images of one camera the first tells where it stands."""
    lens = {line[0]: line for line in _read_lines(folder / CAMERAS)}
    found: dict[str, RigCamera] = {}
    for line in _read_lines(folder / IMAGES):
        if len(line) < _IMAGE_FIELDS:  # the points of an image
            continue
        try:
            w, x, y, z, *moved = (float(value) for value in line[1:8])
        except ValueError:  # points again
            continue
        if line[8] not in lens:
            raise InputError(f"{folder / IMAGES} has an image of camera {line[8]}, which {CAMERAS} lacks")
        image = PurePosixPath(" ".join(line[9:]))
        name = image.parent.name or image.stem
        if name not in found:
            rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
            found[name] = _read_camera(folder, name, lens[line[8]], rotation.tolist(), moved)
    return CameraRig(found, UNKNOWN_UNIT)


def _read_lines(path: Path) -> list[list[str]]:
    try:
        lines = path.read_text("utf8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read; COLMAP's text model is {CAMERAS} and {IMAGES}") from error
    return [line.split() for line in lines if line.strip() and not line.startswith("#")]


def _read_camera(
    folder: Path, name: str, line: list[str], rotation: list[list[float]], moved: list[float]
) -> RigCamera:
    model = line[1] if len(line) > 1 else ""
    if model not in _MODELS:
        raise InputError(f"{folder / CAMERAS}: the camera model {model!r} is not one of {', '.join(_MODELS)}")
    focals, names = _MODELS[model]
    try:
        width, height, *values = (float(value) for value in line[2:])
        focal, (cx, cy), rest = values[:focals], values[focals : focals + 2], values[focals + 2 :]
        coefficients = dict(zip(names, rest, strict=True))
    except ValueError as error:
        raise InputError(f"{folder / CAMERAS}: the {model} camera of {name} has the wrong number of values") from error
    matrix = np.array([[focal[0], 0, cx - 0.5], [0, focal[-1], cy - 0.5], [0, 0, 1]])
    lens = [coefficients.get(key, 0.0) for key in _LENS]
    return make_rig_camera(f"{name} in {folder}", matrix, lens, (width, height), rotation, moved)


def write_colmap_rig(rig: CameraRig, folder: Path) -> None:
    """Write cameras.txt, images.txt and an empty points3D.txt into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras, images = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"]
    for number, (name, each) in enumerate(rig.cameras.items(), start=1):
        camera = each.camera
        k1, k2, p1, p2, k3 = camera.distortion
        (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
        full = bool(k3)
        values = [fx, fy, cx + 0.5, cy + 0.5, k1, k2, p1, p2, *((k3, 0, 0, 0) if full else ())]
        width, height = camera.size
        model = "FULL_OPENCV" if full else "OPENCV"
        cameras.append(f"{number} {model} {width} {height} {' '.join(repr(float(v)) for v in values)}")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = np.array([w, x, y, z, *camera.translation])
        images += [f"{number} {' '.join(repr(float(v)) for v in pose)} {number} {name}.png", ""]
    (folder / CAMERAS).write_text("\n".join([*cameras, ""]), "utf8")
    (folder / IMAGES).write_text("\n".join([*images, ""]), "utf8")
    (folder / "points3D.txt").write_text("# no points\n", "utf8")
