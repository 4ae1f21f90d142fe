# SPDX-License-Identifier: Apache-2.0
"""The report's tables: figures at a glance, errors by joint, settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flowing_puppet_ros.evaluate.joints import JointErrors
from flowing_puppet_ros.report.data import BodiesData, CameraData, ReportData
from flowing_puppet_ros.report.page import details, table

PUPPET_THRESHOLD_CM, BODY_THRESHOLD_CM = 10.0, 7.0  # of joint errors that count as correct
SOURCES = {
    "paired detections": "detections of the recording",
    "searches for everybody": "keypoint networks",
    "full frames with people": "the package's own detector",
}
"""What found the people, by the counter that tells it."""
DETECTION_NOTE = "a detector's shoulders and hips differ slightly from the puppet's, so that 0 cannot be reached"


def format_number(value: float, digits: int = 1, unit: str = "") -> str:
    """Return a number as text, a dash when it is not known."""
    if not math.isfinite(value):
        return "–"  # noqa: RUF001
    return f"{value:,.{digits}f}" + (f" {unit}" if unit else "")


def format_percent(part: float, whole: float = 1.0) -> str:
    """Return a share as text, a dash when there is no whole."""
    return format_number(100 * part / whole if whole else math.nan, 1, "%")


def make_figures_table(data: ReportData) -> str:
    """Make the table of figures at the top of the report."""
    rows = _make_run_rows(data)
    shown = data.camera(data.shown_camera)
    if shown is not None:
        rows += _make_camera_rows(shown, len(data.cameras))
    if data.flow:
        explained = float(np.mean([shot.explained for shot in data.flow]))
        note = f"share of the person's pixels where puppet flow and optical flow agree, {len(data.flow)} frames"
        rows.append(("Flow explained by the puppet", format_percent(explained), note))
    if data.bodies is not None:
        rows += _make_body_rows(data.bodies)
    return table(("", "value", "what it says"), rows, (1,), "Figures of this run.")


def _make_run_rows(data: ReportData) -> list[tuple[str, str, str]]:
    images = sum(camera.images for camera in data.cameras)
    rows = []
    if data.cameras:
        rows.append(("Images", f"{images:,}", f"from {len(data.cameras)} camera(s), every one of them processed"))
    ends = [camera.seconds[-1] for camera in data.cameras if camera.seconds.size]
    if ends:
        rows.append(("Length of the recording", format_number(float(max(ends)), 2, "s"), "first to last stamp"))
    for key, label, digits, unit, note in (
        ("frames_per_second", "Speed", 1, "images/s", "all of the replay, everything written"),
        ("seconds", "Time of the replay", 1, "s", "wall clock"),
    ):
        value = data.summary.get(key)
        if isinstance(value, (int, float)):
            rows.append((label, format_number(float(value), digits, unit), note))
    found = _name_sources(data.summary)
    if found:
        rows.append(("People found by", found, "what the trackers start from and are corrected by"))
    return rows


def _name_sources(summary: Mapping[str, Any]) -> str:
    """Return what found the people in the images of a replay, by what its components counted."""
    counted = [values for values in summary.get("counters", {}).values() if isinstance(values, Mapping)]
    names = [name for counter, name in SOURCES.items() if any(values.get(counter) for values in counted)]
    return ", ".join(names)


def _make_camera_rows(camera: CameraData, cameras: int) -> list[tuple[str, str, str]]:
    name = f"{camera.name}: " if cameras > 1 else ""
    rows = [
        (f"{name}images with a puppet", f"{camera.tracked} of {camera.images}", "the camera shown below"),
        (f"{name}id switches", str(camera.switches), "0: everyone kept one id"),
        (f"{name}puppet energy", format_number(_finite_median(camera.energy)), "median; lower is better"),
    ]
    if camera.errors.known.size:
        errors, cm = camera.errors, camera.errors_cm
        note = f"median and mean distance of the limb joints to the detections; {DETECTION_NOTE}"
        rows.append(
            (
                f"{name}joint error",
                f"{format_number(errors.percentile(50))} / {format_number(errors.mean, 1, 'px')}",
                note,
            )
        )
        mean = format_number(cm.mean, 1, "cm")
        note = f"share of the joints within {PUPPET_THRESHOLD_CM:g} cm at the person; mean {mean}"
        rows.append(
            (
                f"{name}joints within {PUPPET_THRESHOLD_CM:g} cm",
                format_percent(cm.fraction_within(PUPPET_THRESHOLD_CM)),
                note,
            )
        )
        rows.append((f"{name}left and right swapped", _format_swaps(camera.swapped), "frames, against the detections"))
    return rows


def _make_body_rows(bodies: BodiesData) -> list[tuple[str, str, str]]:
    rows = [
        ("Bodies", f"{len(bodies.seconds)} of {bodies.clouds}", "clouds in which a 3D body was found"),
        ("Body energy", _format_digits(_finite_median(bodies.energy)), "median; lower is better"),
    ]
    if bodies.errors.known.size:
        cm = JointErrors(bodies.errors.names, bodies.errors.distance * 100)
        note = "mean and 90th percentile of the limb joints' distance to those triangulated from the detections"
        rows.append(
            ("Body joint error", f"{format_number(cm.mean)} / {format_number(cm.percentile(90), 1, 'cm')}", note)
        )
        note = f"share of the bodies whose mean joint error is under {BODY_THRESHOLD_CM:g} cm"
        frames = cm.per_frame()
        frames = frames[np.isfinite(frames)]
        rows.append(
            (
                f"Bodies within {BODY_THRESHOLD_CM:g} cm",
                format_percent(float((frames < BODY_THRESHOLD_CM).sum()), frames.size),
                note,
            )
        )
        rows.append(
            ("Bodies with left and right swapped", _format_swaps(bodies.swapped), "bodies, against the detections")
        )
    return rows


def _format_digits(value: float) -> str:
    """Return two digits of a number however small, a dash when it is not known."""
    return f"{value:.2g}" if math.isfinite(value) else format_number(value)


def _finite_median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _format_swaps(counts: Mapping[str, tuple[int, int]]) -> str:
    return ", ".join(f"{limb} {wrong} of {total}" for limb, (wrong, total) in counts.items())


def make_cameras_table(data: ReportData) -> str:
    """Make the table of every camera's track, one row per camera."""
    rows = []
    for camera in data.cameras:
        errors, cm = camera.errors, camera.errors_cm
        rows.append(
            (
                camera.name,
                f"{camera.tracked} of {camera.images}",
                str(camera.switches),
                format_number(_finite_median(camera.energy)),
                format_number(errors.percentile(50)),
                format_number(errors.mean),
                format_number(cm.mean),
                format_percent(cm.fraction_within(PUPPET_THRESHOLD_CM)),
                _format_swaps(camera.swapped) if errors.known.size else "–",  # noqa: RUF001
            )
        )
    heads = ["camera", "with puppet", "id switches", "energy", "median px", "mean px", "mean cm"]
    heads += [f"within {PUPPET_THRESHOLD_CM:g} cm", "left-right swapped"]
    return table(heads, rows, range(1, 8), "All cameras: limb joints of the puppets against the detections.")


def make_joints_table(errors: JointErrors, unit: str, factor: float, caption: str) -> str:
    """Make the table of errors by joint; distances are multiplied by `factor` and shown in `unit`."""
    rows = []
    for name, figures in errors.per_joint().items():
        scaled = JointErrors(figures.names, figures.distance * factor)
        values = (scaled.mean, scaled.percentile(50), scaled.percentile(90), scaled.percentile(100))
        rows.append((name.replace("_", " "), *(format_number(value) for value in values), str(scaled.known.size)))
    heads = ("joint", f"mean {unit}", "median", "90 %", "largest", "frames")
    return table(heads, rows, range(1, 6), caption)


def make_settings_tables(summary: Mapping[str, Any]) -> str:
    """Make the folded tables of settings, counters and other entries of a replay's summary; empty without any."""
    plain = [
        (key, _format_value(value)) for key, value in summary.items() if not isinstance(value, (dict, list, tuple))
    ]
    html = table(("entry", "value"), plain, (), "The replay's own summary.") if plain else ""
    for group in ("settings", "counters", "seconds_of"):
        names_by_rows: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for name, values in summary.get(group, {}).items():
            pairs = values.items() if isinstance(values, dict) else [("seconds", values)]
            names_by_rows.setdefault(tuple((key, _format_value(value)) for key, value in pairs), []).append(name)
        title = group.replace("seconds_of", "time")
        for rows, names in names_by_rows.items():
            html += table(("name", "value"), rows, (1,), f"{', '.join(names)}: {title}")
    return details("Settings and counters of the replay", html) if html else ""


def _format_value(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
