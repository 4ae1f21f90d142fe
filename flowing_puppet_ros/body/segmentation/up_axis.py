# SPDX-License-Identifier: Apache-2.0
"""People in a cloud of a scene whose up axis is not sure, in the scan's own frame and unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.segmentation.people import PersonCloud, SegmentationSettings, segment_people


def segment_people_unknown_up(
    points: np.ndarray,
    normals: np.ndarray | None,
    scale: float,
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None,
    settings: SegmentationSettings,
) -> tuple[np.ndarray, list[PersonCloud]]:
    """Extract the people with every direction taken for up, and keep the direction that leaves the likeliest.

    Args:
        points: (N, 3) in the scan's frame and unit.
        normals: (N, 3) or None.
        scale: metres a unit.
        ups: directions (3,) of the scan's frame.
        sensor: (3,) in the scan's frame and unit, or None.
        settings: limits of the extraction.

    Returns:
        The direction that is up, and the people with points in the scan's frame and unit, the likeliest first.
    """
    best: tuple[float, np.ndarray, list[PersonCloud]] = (-1.0, ups[0], [])
    for up in ups:
        frame = ScanFrame(scale, rotation_to_z_up(up))
        viewpoint = None if sensor is None else frame.to_body(sensor)
        found = segment_people(frame.to_body(points), None, settings, viewpoint)
        likeness = max((person.score for person in found), default=0.0)
        if likeness > best[0]:
            best = (likeness, up, found)
    _, up, found = best
    return up, [
        replace(person, points=points[person.rows], normals=None if normals is None else normals[person.rows])
        for person in found
    ]
