# SPDX-License-Identifier: Apache-2.0
"""The part of the report that follows a slider: pictures, the 3D view, and marks in the plots over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from flowing_puppet_ros.report.page import figure, json_block

SCRIPTS = ("scene.js", "timeline.js")

type TimelineFrame = tuple[float, Sequence[tuple[np.ndarray, str]]]
"""Seconds, and the pictures that are shown side by side from then on, each with its caption."""

_SCENE_VIEW = (
    '<div class="space"><canvas tabindex="0" role="application" aria-label="3D view of the bodies: drag or arrow keys '
    'turn, plus and minus zoom, Home resets"></canvas><div class="controls">'
    '<label><input type="checkbox" checked data-shows="mesh"> bodies</label>'
    '<label><input type="checkbox" checked data-shows="points"> points</label>'
    '<button type="button" data-home>Reset view</button><span class="soft">drag: turn; two fingers, right button or '
    'Shift: move; wheel: zoom</span></div></div><p class="no-space soft" hidden>This browser has no WebGL 2, so there '
    "is no 3D view; the still pictures below show the bodies.</p>"
)


def make_timeline(frames: Sequence[TimelineFrame], scene: Mapping[str, Any] | None, plots: str, label: str) -> str:
    """Make the pictures of `frames` beside the 3D `scene`, plots below, and the slider for all of them.

    `scene` is what `scene_3d.make_scene_data` returns; `label` is that of the slider.
    """
    times = sorted({round(seconds, 6) for seconds, _ in frames} | {round(t, 6) for t in _scene_times(scene)})
    pictures = "".join(
        f'<div class="frame{" pair" if len(images) > 1 else ""}{"" if index else " on"}" data-t="{seconds:.6f}">'
        f"{''.join(figure(image, caption, caption) for image, caption in images)}</div>"
        for index, (seconds, images) in enumerate(frames)
    )
    panes = f'<div class="pictures">{pictures}</div>' if frames else ""
    if scene is not None:
        panes += json_block("scene", scene) + _SCENE_VIEW
    controls = (
        f'<div class="controls scrub"{"" if len(times) > 1 else " hidden"}>'
        '<button type="button" data-play>Play</button>'
        f'<input type="range" min="0" max="{len(times) - 1}" value="0" aria-label="{escape(label)}">'
        f"<output>{times[0]:.2f} s</output></div>"
    )
    panes = f'<div class="panes">{panes}</div>'
    return f'<div class="timeline">{json_block("times", times)}{panes}{plots}{controls}</div>'


def _scene_times(scene: Mapping[str, Any] | None) -> list[float]:
    return [] if scene is None else [float(frame["t"]) for frame in scene["frames"]]
