# SPDX-License-Identifier: Apache-2.0
"""Calibrations in OpenCV's YAML: EasyMocap's intri.yml and extri.yml, or one file per camera.

intri.yml, extri.yml   names; K_NAME, dist_NAME, H_NAME, W_NAME; R_NAME (vector), Rot_NAME (matrix), T_NAME
NAME.yml               camera_matrix, distortion_coefficients, image_width, image_height; R, T (world to camera)
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera, make_rig_camera

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
_MATRIX, _DISTORTION = ("camera_matrix", "K", "M"), ("distortion_coefficients", "dist_coeffs", "dist", "D")
_ROTATION, _TRANSLATION = ("R", "Rot", "rotation", "rvec"), ("T", "t", "translation", "tvec")


class _Yaml:
    """The numbers in an OpenCV file by key."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        except cv2.error as error:
            raise InputError(f"{path} cannot be read as OpenCV's YAML") from error
        if not self._file.isOpened():
            raise InputError(f"{path} cannot be read as OpenCV's YAML")

    def find(self, *keys: str) -> F64 | None:
        """Return the matrix, vector or number of the first key that is there."""
        for key in keys:
            node = self._file.getNode(key)
            if node.empty():
                continue
            if node.isReal() or node.isInt():
                return np.array([node.real()])
            if node.isSeq():
                return np.array([node.at(i).real() for i in range(node.size())])
            value = node.mat()
            if value is not None:
                return np.asarray(value, np.float64)
        return None

    def get(self, *keys: str) -> F64:
        """Return the same; InputError if none is there."""
        found = self.find(*keys)
        if found is None:
            raise InputError(f"{self.path} has no {keys[0]}")
        return found

    def list_names(self) -> list[str]:
        """Return the texts under `names`; InputError without them."""
        node = self._file.getNode("names")
        names = [node.at(i).string() for i in range(node.size())] if node.isSeq() else []
        if not names:
            raise InputError(f"{self.path} has no names of cameras")
        return names


def read_easymocap_rig(folder: Path) -> CameraRig:
    """Read intri.yml and extri.yml of a folder; metres, unless the user chose another board unit."""
    for name in (INTRINSICS, EXTRINSICS):
        if not (folder / name).is_file():
            raise InputError(f"{folder} has no {name}; EasyMocap's calibration is {INTRINSICS} and {EXTRINSICS}")
    intrinsics, extrinsics = _Yaml(folder / INTRINSICS), _Yaml(folder / EXTRINSICS)
    found: dict[str, RigCamera] = {}
    for number, name in enumerate(extrinsics.list_names(), start=1):
        # Some converters number the entries instead of naming them.
        key = name if intrinsics.find(f"K_{name}") is not None else str(number)
        height, width = intrinsics.find(f"H_{key}"), intrinsics.find(f"W_{key}")
        found[name] = make_rig_camera(
            f"{name} in {folder}",
            intrinsics.get(f"K_{key}"),
            np.zeros(0) if (dist := intrinsics.find(f"dist_{key}", f"D_{key}")) is None else dist,
            (float(width[0]), float(height[0])) if width is not None and height is not None and width[0] else None,
            _choose_rotation(extrinsics, key),
            extrinsics.get(f"T_{key}"),
        )
    return CameraRig(found)


def _choose_rotation(extrinsics: _Yaml, key: str) -> F64:
    """Return the rotation matrix, else R, which is a vector in EasyMocap's files and a matrix in others."""
    matrix = extrinsics.find(f"Rot_{key}")
    return matrix if matrix is not None and matrix.size == 9 else extrinsics.get(f"R_{key}", f"Rot_{key}")


def read_opencv_rig(files: list[Path]) -> CameraRig:
    """Read one OpenCV YAML file per camera, which is called as the file."""
    found = {}
    for file in files:
        values = _Yaml(file)
        width, height = values.find("image_width", "width"), values.find("image_height", "height")
        found[file.stem] = make_rig_camera(
            f"{file}",
            values.get(*_MATRIX),
            np.zeros(0) if (dist := values.find(*_DISTORTION)) is None else dist,
            (float(width[0]), float(height[0])) if width is not None and height is not None else None,
            values.get(*_ROTATION),
            values.get(*_TRANSLATION),
        )
    return CameraRig(found)


def write_easymocap_rig(rig: CameraRig, folder: Path) -> None:
    """Write intri.yml and extri.yml into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics = cv2.FileStorage(str(folder / INTRINSICS), cv2.FILE_STORAGE_WRITE)
    extrinsics = cv2.FileStorage(str(folder / EXTRINSICS), cv2.FILE_STORAGE_WRITE)
    for file in (intrinsics, extrinsics):
        file.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in rig.cameras:
            file.write("", name)
        file.endWriteStruct()
    for name, each in rig.cameras.items():
        camera = each.camera
        intrinsics.write(f"K_{name}", camera.matrix)
        intrinsics.write(f"dist_{name}", camera.distortion.reshape(1, 5))
        intrinsics.write(f"H_{name}", float(camera.size[1]))
        intrinsics.write(f"W_{name}", float(camera.size[0]))
        extrinsics.write(f"R_{name}", cv2.Rodrigues(camera.rotation)[0])
        extrinsics.write(f"Rot_{name}", camera.rotation)
        extrinsics.write(f"T_{name}", camera.translation.reshape(3, 1))
    intrinsics.release()
    extrinsics.release()
