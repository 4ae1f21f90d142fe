# SPDX-License-Identifier: Apache-2.0
"""Tells the forms of calibration files apart and reads or writes them."""

from __future__ import annotations

from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig import colmap, opencv_yaml, qualisys, ros_files, toml_file
from flowing_puppet_ros.multiview.rig.names import FORMS
from flowing_puppet_ros.multiview.rig.rig import CameraRig, check_rig

_YAML = (".yml", ".yaml")


def read_rig(path: Path) -> CameraRig:
    """Read a calibration of two or more cameras, in its own unit; its form is told by its content.

    InputError in one sentence for any other file or folder, and for one camera only.
    """
    if not path.exists():
        raise InputError(f"the calibration {path} does not exist")
    return check_rig(_read_folder(path) if path.is_dir() else _read_file(path), path)


def _read_file(path: Path) -> CameraRig:
    if path.suffix == ".toml":
        return toml_file.read_toml_rig(path)
    if path.name in (opencv_yaml.INTRINSICS, opencv_yaml.EXTRINSICS):
        return opencv_yaml.read_easymocap_rig(path.parent)
    if path.name in (colmap.CAMERAS, colmap.IMAGES):
        return colmap.read_colmap_rig(path.parent)
    if path.suffix in _YAML:
        return _read_folder(path.parent)
    if path.suffix == ".xml" or path.name.endswith(".qca.txt") or _begin(path).startswith("<"):
        return qualisys.read_qualisys_rig(path)
    raise InputError(f"{path} is no calibration that is read: {_list_forms()}")


def _read_folder(folder: Path) -> CameraRig:
    files = sorted(file for file in folder.iterdir() if file.is_file())
    names = {file.name for file in files}
    if {opencv_yaml.INTRINSICS, opencv_yaml.EXTRINSICS} & names:
        return opencv_yaml.read_easymocap_rig(folder)
    if colmap.CAMERAS in names:
        return colmap.read_colmap_rig(folder)
    yaml = [file for file in files if file.suffix in _YAML]
    opencv = [file for file in yaml if _begin(file).startswith("%YAML:")]
    if opencv:
        return opencv_yaml.read_opencv_rig(opencv)
    ros = [file for file in yaml if ros_files.is_ros_file(file)]
    if ros:
        return ros_files.read_ros_rig(ros)
    others = [file for file in files if file.suffix == ".toml" or file.name.endswith(".qca.txt")]
    if len(others) == 1:
        return _read_file(others[0])
    raise InputError(f"the folder {folder} has no calibration that is read: {_list_forms()}")


def write_rig(rig: CameraRig, path: Path, form: str = "") -> None:
    """Write a calibration in metres; without a `form` the name of `path` decides (.toml, .qca.txt, else EasyMocap's).

    InputError for an unknown form.
    """
    if not form:
        form = "pose2sim" if path.suffix == ".toml" else "easymocap"
        form = "qualisys" if path.suffix == ".xml" or path.name.endswith(".qca.txt") else form
    if form not in FORMS:
        raise InputError(f"there is no form {form!r} of calibrations; there are {', '.join(FORMS)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if form in ("pose2sim", "qualisys") and path.is_dir():
        raise InputError(f"{path} is a folder, and a calibration of {form} is a file: name one")
    writers = {
        "pose2sim": toml_file.write_toml_rig,
        "easymocap": opencv_yaml.write_easymocap_rig,
        "qualisys": qualisys.write_qualisys_rig,
        "ros": ros_files.write_ros_rig,
        "colmap": colmap.write_colmap_rig,
    }
    writers[form](rig, path)


def _begin(path: Path) -> str:
    with path.open("rb") as stream:
        return stream.read(64).decode("utf8", "replace").lstrip("\ufeff \r\n")


def _list_forms() -> str:
    return "; ".join(f"{name} ({what})" for name, what in FORMS.items())
