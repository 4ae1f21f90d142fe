# SPDX-License-Identifier: Apache-2.0
"""Segments the people in a scan of a scene whose up axis is not known, in the scan's own frame and unit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.segmentation.people import segment_people
from flowing_puppet_ros.body.segmentation.planes import find_wall
from flowing_puppet_ros.body.settings import SegmentationSettings

MAX_COMPARED = 3  # likeliest people of each direction by which directions are compared
MAX_SAME_SHARE = 0.5  # of the points of a person, found before with another direction up
FLOOR_CLEARANCE_M, MIN_FLOOR_SIZE_M, MIN_FLOOR_SHARE, MAX_BEYOND_SHARE = 0.03, (1.2, 1.0), 0.1, 0.02
"""Half thickness and size of a floor or wall in the scan of a person, its share of the points, and that of the points
beyond it."""
MAX_FLOOR_POINTS = 5000

ChooseUp = Callable[[Sequence[np.ndarray]], np.ndarray]
"""The direction (3,) that is up for clouds (N, 3) of people in the scan's frame and unit."""


def segment_people_unknown_up(
    points: np.ndarray,
    normals: np.ndarray | None,
    scale: float,
    ups: Sequence[np.ndarray],
    sensor: np.ndarray | None,
    settings: SegmentationSettings,
    choose_up: ChooseUp,
) -> tuple[np.ndarray, list[PersonCloud]]:
    """Segment the people with each direction taken as up, and keep the direction in which bodies explain them.

    Which points are a person hardly depends on what is up, so that what is found in a wrong direction tells the right
    one.

    Args:
        points: (N, 3) in the scan's frame and unit.
        normals: (N, 3) or None.
        scale: metres per unit.
        ups: candidate directions (3,) in the scan's frame.
        sensor: (3,) position in the scan's frame and unit, or None.
        settings: limits of the segmentation.
        choose_up: called with the likeliest people when there are several directions.

    Returns:
        The direction that is up, and the people with points in the scan's frame and unit, by falling score.
    """

    def segment(up: np.ndarray) -> list[PersonCloud]:
        frame = ScanFrame(scale, rotation_to_z_up(up))
        viewpoint = None if sensor is None else frame.to_body(sensor)
        return segment_people(frame.to_body(points), None, settings, viewpoint)

    up, found = ups[0], segment(ups[0])
    if len(ups) > 1:
        by_direction = [(ups[0], found), *((other, segment(other)) for other in ups[1:])]
        compared = _choose_compared([people for _, people in by_direction])
        if compared:
            up = choose_up([points[rows] for rows in compared])
            tried = [people for other, people in by_direction if np.allclose(other, up)]
            found = tried[0] if tried else segment(up)
    return up, [
        replace(person, points=points[person.rows], normals=None if normals is None else normals[person.rows])
        for person in found
    ]


def _choose_compared(found: Sequence[Sequence[PersonCloud]]) -> list[np.ndarray]:
    """Return the rows of the likeliest people of every direction, each person once."""
    chosen: list[np.ndarray] = []
    for people in found:
        for person in people[:MAX_COMPARED]:
            rows = person.rows
            assert rows is not None
            if all(len(np.intersect1d(rows, other)) < MAX_SAME_SHARE * min(len(rows), len(other)) for other in chosen):
                chosen.append(rows)
    return chosen


def has_floor(points: np.ndarray) -> bool:
    """Return whether a large part of a cloud (N, 3) in metres is a floor or a wall, in any direction, at its edge."""
    points = points[np.random.default_rng(0).permutation(len(points))[:MAX_FLOOR_POINTS]]
    plane = find_wall(points, FLOOR_CLEARANCE_M, np.random.default_rng(0), MIN_FLOOR_SIZE_M)
    if plane is None:
        return False
    height = plane.height(points)
    beyond = min((height > 2 * FLOOR_CLEARANCE_M).mean(), (height < -2 * FLOOR_CLEARANCE_M).mean())
    return bool((np.abs(height) < FLOOR_CLEARANCE_M).mean() > MIN_FLOOR_SHARE and beyond < MAX_BEYOND_SHARE)
