# SPDX-License-Identifier: Apache-2.0
"""Inspect this machine: Python, packages, extras, weights, ROS."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re

from flowing_puppet_ros import __version__
from flowing_puppet_ros.doctor.finding import Inspection
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.files import FILES, find_file, is_right
from flowing_puppet_ros.model import weights

DISTRIBUTION = "flowing_puppet_ros"
PURPOSES = {
    "neural": "keypoint networks find people in images",
    "video": "H.264 and H.265 in recordings",
    "annotate": "the page of `annotate`",
    "cluster": "`--scheduler`, a Dask cluster",
    "rerun": "`--rerun`, recordings for the Rerun viewer",
    "learn": "`learn`, models from 3D bodies",
}
"""What the extras that are known by name are for."""
INTERFACES = ("flowing_puppet_msgs", "hri_msgs", "vision_msgs", "foxglove_msgs", "tf2_msgs")
_NAME = re.compile(r"^[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"extra\s*==\s*[\"']([\w.-]+)[\"']")


def inspect_machine() -> Inspection:
    """Return which parts of the package can run on this machine, and how to install what is absent."""
    found = Inspection("machine", "machine")
    found.add(
        "note", f"flowing_puppet_ros {__version__}, Python {platform.python_version()}, {os.cpu_count()} processors,"
        f" {platform.machine()}",
    )  # fmt: skip
    by_extra = read_requirements()
    absent = [name for name in by_extra.get("", []) if not _is_installed(name)]
    if absent:
        found.add("error", f"packages are missing: {', '.join(absent)}", f"pip install {' '.join(absent)}")
    else:
        versions = [f"{name} {importlib.metadata.version(name)}" for name in by_extra.get("", [])]
        found.add("ready", f"fit, pose, track and replay: {', '.join(versions) or 'all packages are there'}")
    for extra in sorted(set(by_extra) - {""}):
        _tell_extra(extra, by_extra[extra], found)
    _tell_weights(found)
    _tell_ros(found)
    return found


def read_requirements() -> dict[str, list[str]]:
    """Return extra -> its packages, with "" for what is always needed, as the installed package lists them."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    found: dict[str, list[str]] = {}
    for line in lines:
        name, extra = _NAME.match(line), _EXTRA.search(line)
        if name:
            found.setdefault(extra[1] if extra else "", []).append(name[0])
    return found


def _tell_extra(extra: str, packages: list[str], found: Inspection) -> None:
    purpose = PURPOSES.get(extra, extra)
    absent = [name for name in packages if not _is_installed(name)]
    if absent:
        found.add(
            "note", f"the extra {extra} ({purpose}) is not installed; missing: {', '.join(absent)}",
            f"pip install {' '.join(absent)}",
        )  # fmt: skip
    else:
        found.add("ready", f"the extra {extra}: {purpose}")


def _is_installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _tell_weights(found: Inspection) -> None:
    for gender in ("neutral", "female", "male"):
        try:
            weights.load("sp", gender)
        except (InputError, OSError) as error:
            found.add("error", f"the {gender} body model cannot be read: {error}", f"pip install {DISTRIBUTION}")
    for network in FILES:
        path = find_file(network)
        if path is not None and is_right(network, path.read_bytes()):
            found.add("ready", f"weights of {network.title}")
            continue
        why = "are not installed" if path is None else f"in {path} are not the right ones"
        found.add(
            "warning", f"the weights of {network.title} {why}: this package's own, weaker detector finds people",
            "flowing-puppet networks --install",
        )  # fmt: skip


def _tell_ros(found: Inspection) -> None:
    if importlib.util.find_spec("rclpy") is None:
        found.add(
            "note", "there is no rclpy: files and recordings work, nodes do not", "source /opt/ros/jazzy/setup.bash"
        )
        return
    absent = [name for name in INTERFACES if importlib.util.find_spec(name) is None]
    needed = [name for name in absent if name in ("flowing_puppet_msgs", "tf2_msgs")]
    if needed:
        found.add(
            "error", f"the nodes cannot run without the interfaces {', '.join(needed)}",
            "colcon build --base-paths . msg_defs",
        )  # fmt: skip
    else:
        found.add("ready", f"nodes: rclpy of ROS 2 {os.environ.get('ROS_DISTRO', 'from wheels')}")
    for name in sorted(set(absent) - set(needed)):
        package = f"ros-jazzy-{name.replace('_', '-')}"
        found.add("note", f"topics of {name} are not published, it is not installed", f"sudo apt install {package}")
