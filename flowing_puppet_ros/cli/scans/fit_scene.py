# SPDX-License-Identifier: Apache-2.0
"""Find the people in a scan of a scene from one side for `flowing-puppet fit --scene`, whichever axis is up."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.settings import SegmentationSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.reporting import Report


class FittedScene(NamedTuple):
    """The `fits` in metres with z up, the likeliest person first, their `frame`, and `notes` for the user."""

    frame: ScanFrame
    fits: list[BodyFit]
    notes: tuple[str, ...]


def fit_one_sided_scene(
    fitter: BodyFitter,
    points: np.ndarray,
    scale: float,
    ups: Sequence[np.ndarray],
    view: str,
    segmentation: SegmentationSettings,
) -> FittedScene | None:
    """Find and fit the people that a sensor at the scan's origin sees.

    Args:
        fitter: fitter of the model.
        points: (N, 3) in the scan's frame and unit.
        scale: metres per unit.
        ups: directions (3,) that may be up; the one in which the people found are likeliest is taken.
        view: full, single or auto.
        segmentation: limits.

    Returns:
        What was fitted; None where people are seen from all sides or nobody is found.
    """
    tried = []
    for up in ups:
        frame = ScanFrame(scale, rotation_to_z_up(up))
        report = Report()
        tracker = SceneTracker(fitter, SceneSettings(view=view, segmentation=segmentation), report)
        cloud = SceneCloud(frame.to_body(points), None, 0)
        found = tracker.find_once(cloud) if tracker.is_one_sided_scene(cloud) else []
        if found:
            tried.append((sum(body.person.score for body in found), frame, tracker, report, found))
    if not tried:
        return None
    _, frame, tracker, report, found = max(tried, key=lambda each: each[0])
    fits = tracker.fit_found(found, fitter.settings.seed)
    return FittedScene(frame, fits, tuple(report.drain_warnings())) if fits else None
