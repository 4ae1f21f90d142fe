# SPDX-License-Identifier: Apache-2.0
"""Why nobody can be found in a scan, in a sentence: it is upside down, tilted, or no more than one ring of rays."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.segmentation.floor_grid import MIN_FLOOR_SHARE, looks_upside_down
from flowing_puppet_ros.body.segmentation.planes import find_floor, subsample

UPSIDE_DOWN = "the floor seems to be above everything else: is the sensor upside down, or `up` set wrongly?"
TILTED = (
    "the floor seems to be tilted by {:.0f} degrees, so people are missed or lean: publish how the sensor is mounted on"
    " /tf_static, or set fixed_frame; level the points of a file"
)
ONE_RING = "the cloud is a flat scan, of one ring of rays: people are found from several rings on only"
CLEARANCE_M, MAX_FLOOR_RANGE_M = 0.1, 8.0  # half thickness of a floor, and how far from the sensor it is looked for
MIN_TOLD_TILT_RAD, MAX_TOLD_TILT_RAD = np.radians(8.0), np.radians(60.0)  # steeper planes are walls
MAX_RING_RAD, MIN_RING_POINTS = np.radians(0.7), 50  # extent of one ring across it


def describe_problem(points: F64, viewpoint: F64, nobody: bool) -> str:
    """Return why people are missed in a scan with points (N, 3) m, z up, seen from `viewpoint` (3,) m; or "".

    Where somebody is found the scan is neither flat nor upside down: of a room, the ceiling may be all that is level.
    """
    if not len(points):
        return ""
    if nobody and _is_one_ring(points - viewpoint):
        return ONE_RING
    if nobody and looks_upside_down(points):
        return UPSIDE_DOWN
    tilt = _measure_tilt(points, viewpoint)
    return TILTED.format(np.degrees(tilt)) if tilt > MIN_TOLD_TILT_RAD else ""


def _is_one_ring(rays: F64) -> bool:
    """Return whether rays (N, 3) m from the sensor make one cone or plane about z."""
    far = rays[np.linalg.norm(rays, axis=1) > CLEARANCE_M]  # nearer is the sensor itself
    elevation = np.arctan2(far[:, 2], np.hypot(far[:, 0], far[:, 1]))
    return len(far) >= MIN_RING_POINTS and bool(np.ptp(elevation) < MAX_RING_RAD)


def _measure_tilt(points: F64, viewpoint: F64) -> float:
    """Return how far the floor is from level, radians; 0 where it is not clear which plane is the floor."""
    thin = subsample(points[np.linalg.norm(points - viewpoint, axis=1) < MAX_FLOOR_RANGE_M])
    if len(thin) < MIN_RING_POINTS:
        return 0.0
    floor = find_floor(thin, CLEARANCE_M, np.random.default_rng(0), viewpoint, MAX_TOLD_TILT_RAD)
    if floor is None or (np.abs(floor.height(thin)) < CLEARANCE_M).mean() < MIN_FLOOR_SHARE:
        return 0.0
    return float(np.arccos(np.clip(floor.normal[2], -1.0, 1.0)))
