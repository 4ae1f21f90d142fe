# SPDX-License-Identifier: Apache-2.0
"""Calibrations of Qualisys Track Manager: `.qca.txt`, which is XML.

Millimetres. `transform` has the camera's place and its axes in the world; a Qualisys camera looks along -z with y up.
`intrinsic` is in 64ths of a pixel. The lens coefficients are those of Brown's model, as in OpenCV.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera, make_rig_camera

_SUBPIXELS = 64.0
_TO_OPTICAL = np.diag([1.0, -1.0, -1.0])  # from a camera that looks along -z to one that looks along z
_LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3")
_AXES = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))


def read_qualisys_rig(path: Path) -> CameraRig:
    """Read the active video cameras of a Qualisys calibration."""
    try:
        text = path.read_text("utf8", errors="replace")
        if "<!ENTITY" in text:
            raise InputError(f"{path} defines entities, which no calibration needs")
        root = ElementTree.fromstring(text)
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path} cannot be read as a Qualisys calibration: {error}") from error
    nodes = [node for node in root.iter("camera") if node.get("active", "1") != "0"]
    if not nodes:
        raise InputError(f"{path} has no active camera")
    return CameraRig({node.get("serial", f"cam{i}"): _read_camera(path, node) for i, node in enumerate(nodes, 1)}, "mm")


def _read_camera(path: Path, node: ElementTree.Element) -> RigCamera:
    name = f"{node.get('serial', '?')} in {path}"
    transform, intrinsic = node.find("transform"), node.find("intrinsic")
    video = node.find("fov_video_max")
    video = node.find("fov_video") if video is None else video
    if transform is None or intrinsic is None:
        raise InputError(f"{name} has no transform or no intrinsic entry: it is not calibrated")
    if float(node.get("viewrotation", "0")) % 360:
        raise InputError(f"{name} has viewrotation {node.get('viewrotation')}, which is not read: export it unturned")
    try:
        axes = np.array([float(transform.attrib[key]) for key in _AXES]).reshape(3, 3)
        centre = np.array([float(transform.attrib[key]) for key in "xyz"])
        fu, fv, cu, cv = (
            float(intrinsic.attrib[key]) / _SUBPIXELS
            for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        )
        size, left, top = None, 0.0, 0.0
        if video is not None:
            left, top, right, bottom = (float(video.attrib[key]) for key in ("left", "top", "right", "bottom"))
            size = right - left + 1, bottom - top + 1
        lens = [float(intrinsic.get(key, "0")) for key in _LENS]
    except (KeyError, ValueError) as error:
        raise InputError(f"{name} has an entry that is missing or not a number: {error}") from error
    rotation = _TO_OPTICAL @ axes
    return make_rig_camera(
        name, np.array([[fu, 0, cu - left], [0, fv, cv - top], [0, 0, 1]]), lens, size, rotation, -rotation @ centre
    )


def write_qualisys_rig(rig: CameraRig, path: Path) -> None:
    """Write a Qualisys calibration, in millimetres."""
    root = ElementTree.Element("calibration", {"source": path.name, "type": "regular"})
    cameras = ElementTree.SubElement(root, "cameras")
    for name, each in rig.cameras.items():
        camera = each.camera
        node = ElementTree.SubElement(cameras, "camera", {"active": "1", "serial": name, "viewrotation": "0"})
        edges = {"left": 0, "top": 0, "right": camera.size[0] - 1, "bottom": camera.size[1] - 1}
        for tag in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ElementTree.SubElement(node, tag, {key: str(value) for key, value in edges.items()})
        axes, centre = _TO_OPTICAL @ camera.rotation, 1000 * camera.centre
        values = dict(zip(_AXES, axes.ravel(), strict=True)) | dict(zip("xyz", centre, strict=True))
        ElementTree.SubElement(node, "transform", {key: repr(float(value)) for key, value in values.items()})
        k1, k2, p1, p2, k3 = camera.distortion
        lens = dict(zip(_LENS, (k1, k2, p1, p2, k3), strict=True))
        focal = {"focalLengthU": camera.matrix[0, 0], "focalLengthV": camera.matrix[1, 1]}
        centre_px = {"centerPointU": camera.matrix[0, 2], "centerPointV": camera.matrix[1, 2]}
        sensor = {"sensorMinU": 0, "sensorMaxU": camera.size[0] - 1, "sensorMinV": 0, "sensorMaxV": camera.size[1] - 1}
        scaled = {key: _SUBPIXELS * float(value) for key, value in (focal | centre_px | sensor).items()}
        ElementTree.SubElement(node, "intrinsic", {key: repr(float(v)) for key, v in (scaled | lens).items()})
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="ascii", xml_declaration=True)
