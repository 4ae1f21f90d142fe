# SPDX-License-Identifier: Apache-2.0
"""Fits that start from given 3D joints, for `flowing-puppet fit --joints`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, make_joint_targets
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit, measure_stature
from flowing_puppet_ros.body.scans.names import UP_AXES
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import GUESS
from flowing_puppet_ros.cli.scans.fit_people import FitOptions, ScanPerson
from flowing_puppet_ros.errors import InputError

GivenJoints = Mapping[str, tuple[float, float, float, float]]
"""Name -> x, y, z in the scan's frame and unit, and confidence 0 to 1."""
FORM = '{"frame": "scan", "joints": {"left_wrist": [x, y, z, confidence], ...}}'
MIN_UPRIGHT = 0.7
"""Cosine of the angle between trunk and an axis from which on that axis is up for certain."""
MAX_JOINT_ERROR_M = 0.25
"""Mean distance of given joints from those of the body that is nearest to them, above which they are no person's."""


def read_joints(path: Path) -> dict[str, tuple[float, float, float, float]]:
    """Read given joints; a joint without confidence has 1. InputError names the form."""
    try:
        data = json.loads(path.read_text("utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file; expected is {FORM}") from error
    if not isinstance(data, dict) or not isinstance(data.get("joints"), dict):
        raise InputError(f"{path} has no joints; expected is {FORM}")
    if data.get("frame", "scan") != "scan":
        raise InputError(f"{path} has joints in the frame {data['frame']!r}; give them in the scan's own and its unit")
    return {str(name): _parse(name, values, path) for name, values in data["joints"].items()}


def _parse(name: str, values: Any, path: Path) -> tuple[float, float, float, float]:
    try:
        x, y, z, *rest = (float("nan") if value is None else float(value) for value in values)
        confidence = rest[0] if rest else 1.0
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name} is {values!r}; expected is [x, y, z, confidence]") from None
    return x, y, z, confidence


def fit_from_joints(person: ScanPerson, joints: GivenJoints, fitter: BodyFitter, options: FitOptions) -> FrameFit:
    """Fit a body that starts from given joints, in the unit that makes them a person's.

    InputError when they determine no body, or are no person's in any unit.
    """
    up, clear = _find_up(joints, options)
    tried = []
    for unit in person.units:
        frame = ScanFrame(unit.fitted, rotation_to_z_up(up))
        tried.append((_measure_error(fitter, _move(joints, frame)) / frame.scale, unit, frame))
    error, unit, frame = min(tried, key=lambda each: each[0])
    if error * frame.scale > MAX_JOINT_ERROR_M:
        size = unit.metres * float(np.nanmax(np.ptp([values[:3] for values in joints.values()], axis=0)))
        raise InputError(
            f"the given joints are {error * frame.scale:.2g} m from those of any person, and span {size:.3g} m in"
            f" {unit.name}; give them in the scan's own frame and unit, or name --unit"
        )
    fit = fitter.fit(
        frame.to_body(person.points),
        None if person.normals is None else person.normals @ frame.rotation.T,
        initial=_move(joints, frame),
        viewpoint=None if person.sensor is None else frame.to_body(person.sensor),
    )
    stature = measure_stature(fitter.model, fit.joints) * unit.metres / unit.fitted
    return FrameFit(frame, unit, fit, clear, unit.name != GUESS, stature)


def _find_up(joints: GivenJoints, options: FitOptions) -> tuple[np.ndarray, bool]:
    """Return the axis that is up: the one that was named, or the nearest to the trunk; and whether that is clear."""
    if options.up != "auto":
        return parse_axis(options.up), True
    low = [values[:3] for name, values in joints.items() if name.endswith(("hip", "pelvis", "knee", "ankle"))]
    high = [values[:3] for name, values in joints.items() if name.endswith(("shoulder", "neck", "head_top", "nose"))]
    if not low or not high:
        return parse_axis("z"), False
    trunk = np.nanmean(high, axis=0) - np.nanmean(low, axis=0)
    trunk /= max(float(np.linalg.norm(trunk)), 1e-12)
    axes = [parse_axis(name) for name in UP_AXES]
    up = max(axes, key=lambda axis: float(axis @ trunk))
    return up, bool(up @ trunk > MIN_UPRIGHT)


def _move(joints: GivenJoints, frame: ScanFrame) -> dict[str, tuple[float, float, float, float]]:
    moved = {}
    for name, (x, y, z, confidence) in joints.items():
        place = frame.to_body(np.array([[x, y, z]]))[0]
        moved[name] = (float(place[0]), float(place[1]), float(place[2]), confidence)
    return moved


def _measure_error(fitter: BodyFitter, joints: GivenJoints) -> float:
    """Return the mean distance, metres, of joints from those of the body that is nearest to them."""
    targets = make_joint_targets(fitter.model, joints)
    body = body_from_joints(fitter.model, fitter.gauss_newton, targets)
    distance = np.linalg.norm(fitter.model.joints(fitter.model.vertices(body)) - targets.points, axis=1)
    return float(np.average(distance, weights=targets.weight))
