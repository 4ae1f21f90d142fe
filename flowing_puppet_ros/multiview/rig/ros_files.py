# SPDX-License-Identifier: Apache-2.0
"""Calibrations of ROS: a camera_info YAML per camera, as `camera_calibration` writes it, and a file of transforms.

The transforms are those of /tf_static as `ros2 topic echo` prints them: header.frame_id, child_frame_id, and
transform.translation and rotation (a quaternion), in a list or under `transforms`, in one or more documents. A camera's
frame is called as its `frame_id`, its name, or its name with `_optical_frame` or the like behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML, YAMLError
from scipy.spatial.transform import Rotation

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.rig import CameraRig, make_rig_camera

_FRAME_ENDINGS = ("", "_optical_frame", "_color_optical_frame", "_rgb_optical_frame", "_optical", "_frame", "_link")
TRANSFORMS_FILE = "transforms.yaml"
WORLD = "world"

Pose = tuple[str, F64, F64]
"""Parent frame, position (3,) and rotation (3, 3) of a frame in it."""


def read_ros_rig(files: list[Path]) -> CameraRig:
    """Read the camera_info files and the transforms among YAML files; other files are ignored."""
    infos: dict[str, dict[str, Any]] = {}
    frames: dict[str, Pose] = {}
    for file in files:
        for document in _load(file):
            if isinstance(document, dict) and "camera_matrix" in document:
                infos[str(document.get("camera_name") or file.stem)] = document | {"file": file}
            else:
                frames |= _read_transforms(document, file)
    place = files[0].parent
    if not infos:
        raise InputError(f"{place} has no camera_info YAML with a camera_matrix")
    if not frames:
        raise InputError(f"{place} has no file of transforms beside the camera_info: put {TRANSFORMS_FILE} there")
    found = {}
    for name, info in infos.items():
        frame = _find_frame(name, info, frames, place)
        position, rotation = _pose_in_root(frame, frames)
        if info.get("distortion_model", "plumb_bob") not in ("plumb_bob", ""):
            raise InputError(f"{info['file']} has the distortion_model {info['distortion_model']!r}; use plumb_bob")
        lens = (info.get("distortion_coefficients") or {}).get("data", [])
        size = (info["image_width"], info["image_height"]) if "image_width" in info and "image_height" in info else None
        matrix = (info["camera_matrix"] or {}).get("data", [])
        found[name] = make_rig_camera(
            f"{name} in {info['file']}", matrix, lens, size, rotation.T, -rotation.T @ position
        )
    return CameraRig(found, "m")


def is_ros_file(path: Path) -> bool:
    """Return whether a YAML file is a camera_info or has transforms."""
    try:
        return any(
            isinstance(document, list | dict)
            and ("camera_matrix" in document or bool(_read_transforms(document, path)))
            for document in _load(path)
        )
    except InputError:
        return False


def _load(path: Path) -> list[Any]:
    try:
        return list(YAML(typ="safe").load_all(path.read_text("utf8")))
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise InputError(f"{path} cannot be read as YAML") from error


def _read_transforms(document: Any, file: Path) -> dict[str, Pose]:
    items = document.get("transforms", [document]) if isinstance(document, dict) else document
    found: dict[str, Pose] = {}
    for item in items if isinstance(items, list) else []:
        if not (isinstance(item, Mapping) and "child_frame_id" in item):
            continue
        try:
            moved, turned = item["transform"]["translation"], item["transform"]["rotation"]
            position = np.array([moved[key] for key in "xyz"], float)
            rotation = Rotation.from_quat([turned[key] for key in "xyzw"]).as_matrix()
            found[str(item["child_frame_id"]).lstrip("/")] = (
                str(item["header"]["frame_id"]).lstrip("/"),
                position,
                rotation,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file}: the transform to {item['child_frame_id']!r} cannot be used: {error}") from error
    return found


def _find_frame(name: str, info: Mapping[str, Any], frames: Mapping[str, Pose], place: Path) -> str:
    wanted = [str(info.get("frame_id", "")).lstrip("/"), *(name + ending for ending in _FRAME_ENDINGS)]
    for frame in wanted:
        if frame in frames:
            return frame
    raise InputError(
        f"{place}: no transform leads to {name} or {name}_optical_frame, only to {', '.join(sorted(frames))}"
    )


def _pose_in_root(frame: str, frames: Mapping[str, Pose]) -> tuple[F64, F64]:
    position, rotation, seen = np.zeros(3), np.eye(3), set[str]()
    while frame in frames:
        if frame in seen:
            raise InputError(f"the transforms form a loop through {frame!r}")
        seen.add(frame)
        frame, parent_position, parent_rotation = frames[frame]
        position, rotation = parent_rotation @ position + parent_position, parent_rotation @ rotation
    return position, rotation


def write_ros_rig(rig: CameraRig, folder: Path) -> None:
    """Write a camera_info YAML per camera and their transforms into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    transforms = []
    for name, each in rig.cameras.items():
        camera, frame = each.camera, f"{name}_optical_frame"
        projection = np.hstack([camera.matrix, np.zeros((3, 1))])
        matrices = {
            "camera_matrix": camera.matrix,
            "distortion_coefficients": camera.distortion.reshape(1, 5),
            "rectification_matrix": np.eye(3),
            "projection_matrix": projection,
        }
        info: dict[str, Any] = {"image_width": camera.size[0], "image_height": camera.size[1], "camera_name": name}
        info |= {"frame_id": frame, "distortion_model": "plumb_bob"}
        info |= {
            key: {"rows": value.shape[0], "cols": value.shape[1], "data": value.ravel().tolist()}
            for key, value in matrices.items()
        }
        _dump(info, folder / f"{name}.yaml")
        quaternion = Rotation.from_matrix(camera.rotation.T).as_quat().tolist()
        transforms.append(
            {
                "header": {"frame_id": WORLD},
                "child_frame_id": frame,
                "transform": {
                    "translation": dict(zip("xyz", camera.centre.tolist(), strict=True)),
                    "rotation": dict(zip("xyzw", quaternion, strict=True)),
                },
            }
        )
    _dump({"transforms": transforms}, folder / TRANSFORMS_FILE)


def _dump(content: Any, path: Path) -> None:
    with path.open("w", encoding="utf8") as stream:
        YAML().dump(content, stream)
