# SPDX-License-Identifier: Apache-2.0
"""Calibrations in TOML: Pose2Sim, Anipose, FreeMoCap and Caliscope write one table per camera.

Metres in Pose2Sim's files; Anipose and Caliscope use the unit of their calibration board. Entries of one camera: name,
size [width, height], matrix, distortions, rotation (vector, world to camera), translation, and our own time_offset.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera, make_rig_camera

_OTHER_TABLES = frozenset({"metadata"})
_NEEDED = ("matrix", "rotation", "translation")


def read_toml_rig(path: Path) -> CameraRig:
    """Read the cameras of a TOML file; InputError names what is missing."""
    try:
        content = tomllib.loads(path.read_text("utf8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path} cannot be read as TOML: {error}") from error
    tables = _find_tables(content)
    if not tables:
        raise InputError(f"{path} has no table of a camera with {', '.join(_NEEDED)}")
    return CameraRig({_name(key, table): _read_camera(path, key, table) for key, table in tables.items()})


def _find_tables(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the tables of cameras, at the top or under `cameras`, without those that Caliscope ignores."""
    nested = content.get("cameras")
    found = nested if isinstance(nested, dict) else content
    return {
        key: table
        for key, table in found.items()
        if isinstance(table, dict) and "matrix" in table and key not in _OTHER_TABLES and not table.get("ignore")
    }


def _name(key: str, table: dict[str, Any]) -> str:
    return str(table.get("name") or key)


def _read_camera(path: Path, key: str, table: dict[str, Any]) -> RigCamera:
    missing = [name for name in _NEEDED if name not in table]
    if missing:
        raise InputError(f"{path}: the table [{key}] has no {missing[0]}")
    if table.get("fisheye"):
        raise InputError(f"{path}: {key} is a fisheye camera, which is not understood; undistort its video first")
    size = table.get("size")
    return make_rig_camera(
        f"{key} in {path}",
        table["matrix"],
        table.get("distortions", table.get("distortion", [])),
        (size[0], size[1]) if isinstance(size, list) and len(size) == 2 else None,
        table["rotation"],
        table["translation"],
        table.get("time_offset", 0.0),
    )


def write_toml_rig(rig: CameraRig, path: Path) -> None:
    """Write Pose2Sim's TOML; `time_offset` is there where it is not zero."""
    lines = []
    for name, each in rig.cameras.items():
        camera = each.camera
        values: dict[str, Any] = {
            "name": name,
            "size": [float(side) for side in camera.size],
            "matrix": camera.matrix.tolist(),
            "distortions": camera.distortion[: 5 if camera.distortion[4] else 4].tolist(),
            "rotation": cv2.Rodrigues(camera.rotation)[0].ravel().tolist(),
            "translation": camera.translation.tolist(),
        }
        lines.append(f"[{name if name.replace('_', '').isalnum() else repr(name)}]")
        lines += [f"{key} = {_to_toml(value)}" for key, value in values.items()]
        lines += ["fisheye = false"] + ([f"time_offset = {each.time_offset!r}"] if each.time_offset else []) + [""]
    path.write_text("\n".join([*lines, "[metadata]", "adjusted = false", "error = 0.0", ""]), "utf8")


def _to_toml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_to_toml(item) for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(float(value))
