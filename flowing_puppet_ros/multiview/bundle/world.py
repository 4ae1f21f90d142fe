# SPDX-License-Identifier: Apache-2.0
"""The unit and the upright axis of a calibration, told or found by the height of people who stand."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.association.height import find_up, measure_height
from flowing_puppet_ros.multiview.bundle.diagnosis import (
    MAX_HEIGHT_M,
    MIN_AGREEMENT,
    MIN_HEIGHT_M,
    USUAL_HEIGHT_M,
    AgreementOfViews,
    People,
    explain_disagreement,
    find_size,
)
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rig.names import UNITS
from flowing_puppet_ros.multiview.rig.rig import CameraRig

AXES = {f"{sign}{name}": np.eye(3)[axis] * (-1 if sign else 1) for axis, name in enumerate("xyz") for sign in ("", "-")}
"""Directions by name."""
_MIN_ALIGNED = np.cos(np.radians(30.0))  # of the upright direction with an axis of the world
_MIN_TOLD = np.cos(np.radians(60.0))  # of the upright direction with the axis that was told


def settle_world(
    rig: CameraRig,
    names: Sequence[str],
    instants: Sequence[People],
    unit: str,
    up: str,
    height: float,
    note: Callable[[str], None],
) -> CameraRig:
    """Return a rig in metres with z up, as told or as the people at several `instants` have it.

    Args:
        rig: in the unit of its file.
        names: names of the joints.
        instants: people by camera at some instants; without any only what is told or in the file is used.
        unit: m, cm, mm or auto.
        up: x, -x, y, -y, z, -z or auto.
        height: of the people, m, which then fixes the scale; 0 if it does not.
        note: is told in one sentence what was found.

    Raises:
        InputError: in one sentence, when the people would be giants or dwarfs, lie where they should stand, or when the
            cameras do not agree on anybody.
    """
    cameras = {name: each.camera for name, each in rig.cameras.items()}
    told = unit if unit != "auto" else rig.unit
    if not any(sum(bool(group) for group in people.values()) >= 2 for people in instants):
        return _settle_without_people(rig, told, up, note)
    factor, seen = find_size(cameras, names, instants)
    _check_agreement(cameras, names, instants, seen, note)
    tall = measure_height(names, seen.joints) / factor  # in the unit of the file
    if not np.isfinite(tall):
        return _settle_without_people(rig, told, up, note)
    scaled = rig.rescale(height / tall if height else _choose_metres(tall, told, unit, note))
    return scaled.rotate_world(_choose_rotation(find_up(names, seen.joints), up, note))


def _settle_without_people(rig: CameraRig, told: str, up: str, note: Callable[[str], None]) -> CameraRig:
    note("nobody is seen by two cameras in the images that were looked at: unit and axes are not checked")
    if told not in ("m", ""):
        if told not in UNITS:
            raise InputError("the unit of this calibration is arbitrary and nobody shows it: give --unit")
        rig = rig.rescale(UNITS[told])
    return rig.rotate_world(_rotate_to_z(AXES[up])) if up != "auto" else rig


def _check_agreement(
    cameras: dict[str, Camera],
    names: Sequence[str],
    instants: Sequence[People],
    seen: AgreementOfViews,
    note: Callable[[str], None],
) -> None:
    alone = [name for name, share in seen.by_camera.items() if share < MIN_AGREEMENT / 2]
    if not alone and seen.share >= MIN_AGREEMENT:
        return
    reason = explain_disagreement(cameras, names, instants, seen.share)
    if reason:
        raise InputError(reason)
    if seen.share < MIN_AGREEMENT / 2:
        raise InputError(
            "the cameras do not agree on anybody: the calibration is not that of these videos, or their clocks differ"
        )
    if alone:
        note(
            f"{', '.join(alone)} shows nobody whom other cameras show: its calibration or its clock is off, or it "
            "looks elsewhere"
        )


def _choose_metres(tall: float, told: str, unit: str, note: Callable[[str], None]) -> float:
    """Return metres in the unit in which people are so `tall`; InputError if the unit that was told is wrong."""
    fitting = [name for name, metres in UNITS.items() if MIN_HEIGHT_M < tall * metres < MAX_HEIGHT_M]
    if told in UNITS and told in fitting:
        return UNITS[told]
    if unit != "auto":
        right = f"the calibration is in {fitting[0]}" if fitting else "give --person-height to fix the scale"
        raise InputError(f"with --unit {unit} people would be {tall * UNITS[unit]:.3g} m tall: {right}")
    if fitting:
        if fitting[0] != "m" or told in UNITS:
            note(f"people are {tall:.3g} units tall: the calibration is taken to be in {fitting[0]}")
        return UNITS[fitting[0]]
    if told in UNITS or not told:
        raise InputError(
            f"people would be {tall * UNITS[told or 'm']:.3g} m tall: the unit of the calibration is not m, cm or mm; "
            f"--person-height {USUAL_HEIGHT_M} fixes the scale"
        )
    note(f"the unit of the calibration is arbitrary: people are taken to be {USUAL_HEIGHT_M} m tall (--person-height)")
    return USUAL_HEIGHT_M / tall


def _choose_rotation(upward: F64, up: str, note: Callable[[str], None]) -> F64:
    """Return the rotation (3, 3) that turns the upright axis to z; InputError if people do not stand along it."""
    known = bool(np.isfinite(upward).all())
    if not known:
        return _rotate_to_z(AXES["z" if up == "auto" else up])
    nearest = max(AXES, key=lambda name: float(AXES[name] @ upward))
    if up != "auto":
        if float(AXES[up] @ upward) < _MIN_TOLD:
            raise InputError(f"with --up={up} people would not stand: in this calibration they stand along {nearest}")
        return _rotate_to_z(AXES[up])
    if float(AXES[nearest] @ upward) >= _MIN_ALIGNED:
        if nearest != "z":
            note(f"people stand along {nearest}: the world is turned so that z is up")
        return _rotate_to_z(AXES[nearest])
    note("people stand along no axis of the world: it is turned so that z is up")
    return _rotate_to_z(upward)


def _rotate_to_z(direction: F64) -> F64:
    """Return the smallest rotation (3, 3) that turns a unit `direction` (3,) to z; about x if it is -z."""
    axis, cosine = np.cross(direction, [0.0, 0.0, 1.0]), float(direction[2])
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))
