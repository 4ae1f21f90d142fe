# SPDX-License-Identifier: Apache-2.0
"""The HTML report of a replay in one self-contained file."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.draw.pictures import add_caption, save, scale_to_height
from flowing_puppet_ros.draw.pictures import join_row as joined
from flowing_puppet_ros.draw.plots import Series, draw_heat_strip, draw_line_plot
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.report.data import BodiesData, ReportData, gather_data, make_energy_series, make_error_series
from flowing_puppet_ros.report.page import SCRIPTS, build_page, details, figure, make_timeline, paragraph, row
from flowing_puppet_ros.report.people_in_space import make_space_section
from flowing_puppet_ros.report.scene_above import make_above_section
from flowing_puppet_ros.report.tables import (
    format_percent,
    make_cameras_table,
    make_figures_table,
    make_joints_table,
    make_settings_tables,
)

PICTURE_HEIGHT = 440  # of the collage, px


def write_report(
    input_bag: Path,
    output_bag: Path,
    path: Path,
    summary: Mapping[str, Any] | None = None,
    picture: Path | None = None,
) -> None:
    """Write the report of the replay of `input_bag` into `output_bag` as one HTML file.

    `summary` is that of the replay: "frames_per_second", "seconds", "settings" {component: {name: value}}, "counters"
    likewise, "warnings" [text]; other plain entries are listed. `picture` is an image file for a collage of the main
    pictures. InputError if a bag cannot be used or a file cannot be written.
    """
    data = gather_data(input_bag, output_bag, summary)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(build_report_page(data), "utf8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose another path") from error
    if picture is not None:
        save(make_collage(data), picture)


def build_report_page(data: ReportData) -> str:
    """Build the page from the gathered data."""
    sections = [
        ("Figures", make_figures_table(data) + _list_warnings(data) + make_settings_tables(data.summary)),
        ("Over time", _make_time_section(data)),
        ("Tracked puppets", _make_track_section(data)),
        *([("People in all cameras", make_space_section(data.space, data.start))] if data.space is not None else []),
        *([("People from above", make_above_section(data.above))] if data.above is not None else []),
        ("Optical flow and puppet flow", _make_flow_section(data)),
        ("Bodies", _make_body_section(data)),
        ("Joint by joint", _make_joints_section(data)),
    ]
    topics = ", ".join(f"{name} ({count})" for name, count in sorted(data.counts.items()))
    sections.append(("What the output bag holds", paragraph(topics or "Nothing.")))
    lead = (
        f"<p>Replay of <code>{escape(data.input_name)}</code> into <code>{escape(data.output_name)}</code> through the "
        "algorithms of the nodes: people as 2D flowing puppets in every image, and as 3D stitched puppets where there "
        "are clouds. Left and right are the person's; warm colours are left, cool ones right.</p>"
    )
    return build_page("Flowing puppet report", lead, sections, SCRIPTS)


def _list_warnings(data: ReportData) -> str:
    warnings = [str(text) for text in data.summary.get("warnings", ())]
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in warnings[:200])
    return details(f"{len(warnings)} warning(s) of the replay", f"<ul>{items}</ul>")


def _make_track_section(data: ReportData) -> str:
    if not data.cameras:
        return paragraph("The output bag has no puppets, so there is no track to show.")
    return make_cameras_table(data)


def _make_flow_section(data: ReportData) -> str:
    if not data.flow:
        return paragraph("No two consecutive images have a puppet, so there is no flow to show.")
    html = paragraph(
        "Motion to the next image. Hue is the direction, saturation the speed (wheel in the corner: the colour of the "
        "motion away from its centre). The puppet flow is the part of it that the puppet explains: one affine motion "
        "per part, and one for the background."
    )
    for shot in data.flow:
        when = f"{data.seconds(shot.stamp):.2f} s"
        figures = [
            figure(shot.image, f"Image with the outlines of the puppet at {when}", f"Image at {when}"),
            figure(shot.flow, "Colour-coded optical flow", f"Optical flow; full colour is {shot.full_scale:.1f} px"),
            figure(
                shot.puppet_flow, "Colour-coded puppet flow", f"Puppet flow; explains {format_percent(shot.explained)}"
            ),
        ]
        html += row(figures, "three")
    return html


def _make_body_section(data: ReportData) -> str:
    if data.bodies is None:
        return paragraph("The output bag has no 3D bodies: the replay had neither clouds nor calibrated cameras.")
    if not len(data.bodies.seconds):
        return paragraph(f"No 3D body was found in the {data.bodies.clouds} cloud(s).")
    if not data.body_shots:
        return paragraph("The output bag has bodies but no mesh vertices, so there is no mesh to show.")
    html = paragraph(
        "The fitted mesh from the front and from the person's left, with the points that it was fitted to in blue "
        "(points inside the mesh are hidden), then over the images of the cameras."
    )
    for shot in data.body_shots:
        when = f"{data.seconds(shot.stamp):.2f} s"
        html += f"<h3>{when}</h3>"
        sides = [figure(shot.front, f"Mesh from the front at {when}", "front")]
        sides.append(figure(shot.side, f"Mesh from the left at {when}", "left side"))
        html += row(sides)
        html += row([figure(image, f"Mesh over {name} at {when}", name) for name, image in shot.views], "views")
    return html


def _make_time_section(data: ReportData) -> str:
    """Make the section of pictures, 3D view and plots, which one slider moves."""
    notes, frames = [], []
    if data.strip:
        notes.append(
            f"Camera {data.shown_camera}, the one that sees the person most frontally. Filled outlines are the parts "
            "of the puppet, nearer parts over farther ones; dots are joints: larger is more confident, hollow is "
            "below one half."
        )
        frames = [(data.seconds(stamp), _list_pictures(data, stamp, image)) for stamp, image in data.strip]
        if data.overlaid:
            notes.append(
                "Beside it, the bodies of the nearest cloud over the same image, as its lens shows them; what the "
                "sensor did not see of them is pale."
            )
    elif data.cameras:
        notes.append("The input bag has no images at the stamps of the puppets, so the track cannot be drawn.")
    if data.scene is not None:
        notes.append(
            "The 3D view has the fitted meshes and, in blue, the points that they were fitted to at the stamps that "
            "have some. A click in a plot goes to its time."
        )
    plots = _make_plots(data)
    if not plots and not frames and data.scene is None:
        return paragraph("There is nothing that changes over time in this bag.")
    shown = make_timeline(frames, data.scene, plots, "Time") if frames or data.scene is not None else plots
    return "".join(map(paragraph, notes)) + shown


def _list_pictures(data: ReportData, stamp: int, image: np.ndarray) -> list[tuple[np.ndarray, str]]:
    """Return the pictures of one moment with captions: the puppets, and the bodies over the same image if any."""
    pictures = [(image, f"{data.shown_camera}, {data.seconds(stamp):.2f} s")]
    if stamp in data.overlaid:
        drawn, cloud = data.overlaid[stamp]
        when = "no body" if cloud is None else f"bodies of the cloud at {data.seconds(cloud):.2f} s"
        pictures.append((drawn, when))
    return pictures


def _make_plots(data: ReportData) -> str:
    html = ""
    axis = "time [s]"
    errors = draw_line_plot(make_error_series(data), "Joint error of the puppets", axis, "mean error [px]")
    energies = draw_line_plot(make_energy_series(data), "Energy of the puppets", axis, "energy", from_zero=False)
    if errors:
        html += "<h3>Joint error of the puppets against the detections</h3>" + errors
    if energies:
        html += "<h3>Energy of the puppets</h3>" + energies
    shown = data.camera(data.shown_camera)
    if shown is not None:
        strip_plot = draw_heat_strip(
            shown.part_names, shown.part_confidence, shown.seconds, f"Confidence of the parts, {shown.name}", axis
        )
        html += f"<h3>Confidence of the parts, {escape(shown.name)}</h3>{strip_plot}" if strip_plot else ""
    if data.bodies is not None:
        html += _make_body_plots(data.bodies, axis)
    return html


def _make_body_plots(bodies: BodiesData, axis: str) -> str:
    errors = Series("mean over the limb joints", bodies.seconds, 100 * bodies.errors.per_frame())
    html = ""
    for title, series, label in (
        ("Joint error of the bodies", errors, "mean error [cm]"),
        ("Energy of the bodies", Series("energy", bodies.seconds, bodies.energy), "energy"),
    ):
        plot = draw_line_plot([series], title, axis, label)
        html += f"<h3>{title}</h3>{plot}" if plot else ""
    plot = draw_heat_strip(
        bodies.part_names, bodies.part_confidence, bodies.seconds, "Confidence of the body parts", axis
    )
    return html + (f"<h3>Confidence of the body parts</h3>{plot}" if plot else "")


def _make_joints_section(data: ReportData) -> str:
    html = ""
    shown = data.camera(data.shown_camera)
    if shown is not None and shown.errors.known.size:
        text = f"Puppets of {shown.name} against the detections, pixels of the image."
        html += make_joints_table(shown.errors, "px", 1.0, text)
    if data.bodies is not None and data.bodies.errors.known.size:
        text = "Bodies against the joints triangulated from the detections of all cameras, centimetres."
        html += make_joints_table(data.bodies.errors, "cm", 100.0, text)
    return html or paragraph("The input bag has no detections, so there is nothing to compare the joints with.")


def make_collage(data: ReportData) -> np.ndarray:
    """Join pictures of about one moment in a row: puppet, optical flow, puppet flow, body; RGB (440, W, 3).

    InputError if there are no pictures.
    """
    body = data.body_shots[len(data.body_shots) // 2] if data.body_shots else None
    if body:
        flow = min(data.flow, key=lambda shot: abs(shot.stamp - body.stamp), default=None)
    else:
        flow = max(data.flow, key=lambda shot: shot.full_scale, default=None)
    moment = flow.stamp if flow else body.stamp if body else data.start
    pictures = []
    if data.strip:
        pictures.append((min(data.strip, key=lambda frame: abs(frame[0] - moment))[1], "flowing puppet"))
    if flow:
        pictures += [(flow.flow, "optical flow"), (flow.puppet_flow, "puppet flow")]
    if body:
        pictures.append((body.front, "stitched puppet"))
        pictures += [(image, f"seen by {name}") for name, image in body.views if name == data.shown_camera]
    if not pictures:
        raise InputError(
            f"there is no picture to make of {data.output_name}: it has neither puppets over images nor meshes"
        )
    return joined(
        [add_caption(scale_to_height(image, PICTURE_HEIGHT), text) for image, text in pictures], PICTURE_HEIGHT, 4, 190
    )
