# SPDX-License-Identifier: Apache-2.0
"""Segments the people in a scan of a scene whose up axis is not known, in the scan's own frame and unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.segmentation.people import SegmentationSettings, segment_people


def segment_people_unknown_up(
    points: np.ndarray,
    normals: np.ndarray | None,
    scale: float,
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None,
    settings: SegmentationSettings,
) -> tuple[np.ndarray, list[PersonCloud]]:
    """Segment the people with each direction taken as up, and keep the direction with the highest person score.

    Args:
        points: (N, 3) in the scan's frame and unit.
        normals: (N, 3) or None.
        scale: metres per unit.
        ups: candidate directions (3,) in the scan's frame.
        sensor: (3,) position in the scan's frame and unit, or None.
        settings: limits of the segmentation.

    Returns:
        The direction that is up, and the people with points in the scan's frame and unit, by falling score.
    """
    best: tuple[float, np.ndarray, list[PersonCloud]] = (-1.0, ups[0], [])
    for up in ups:
        frame = ScanFrame(scale, rotation_to_z_up(up))
        viewpoint = None if sensor is None else frame.to_body(sensor)
        found = segment_people(frame.to_body(points), None, settings, viewpoint)
        score = max((person.score for person in found), default=0.0)
        if score > best[0]:
            best = (score, up, found)
    _, up, found = best
    return up, [
        replace(person, points=points[person.rows], normals=None if normals is None else normals[person.rows])
        for person in found
    ]
