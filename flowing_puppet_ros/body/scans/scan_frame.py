# SPDX-License-Identifier: Apache-2.0
"""From a scan's own frame and unit to metres with z up, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model import rotation as so3

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres per unit."""
MIN_ADULT_AREA_M2, MEAN_ADULT_AREA_M2, MAX_ADULT_AREA_M2 = 1.2, 1.8, 3.0
"""Surface area of an adult's body."""
MIN_ADULT_EXTENT_M, MAX_ADULT_EXTENT_M = 0.6, 2.6
"""Longest side of the box around an adult in any pose."""
UP_AXES = ("z", "y", "-y", "-z", "x", "-x")
"""Axes that may point up, the likelier first; -y in optical frames (REP-103)."""
SAME_AXIS_COSINE = np.cos(np.radians(15.0))
"""Cosine of the angle to an axis from which on a direction counts as that axis."""
PROBES, PROBE_NEIGHBOURS = 1000, 5
"""Points at which layers are counted, and neighbours of each, the point itself among them."""
MIN_DENSE_POINTS = 2000  # clouds of fewer points are sparse
MAX_DENSE_LAYER_RATIO, MAX_SPARSE_LAYER_RATIO = 4.0, 2.3
"""Spread of the distance to the sensor among neighbours in direction, over that among neighbours in space, below which
a cloud has one layer, with at least and with fewer than `MIN_DENSE_POINTS` points. In whole bodies it is 2.4 and more
for 500 points and 7 and more for dense clouds, in single views 1.4 to 2.3."""


def parse_axis(name: str) -> np.ndarray:
    """Return the unit vector (3,) that one of `UP_AXES` names."""
    return (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])]


def rotation_to_z_up(up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that takes the direction `up` (3,) to z.

    The axis after the one nearest to `up`, in the order x y z x, becomes x: people in frames with y up face along z.
    """
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    k = int(np.abs(up).argmax())
    sign = 1.0 if up[k] >= 0 else -1.0
    axes = np.eye(3)
    named = np.stack([axes[(k + 1) % 3], sign * axes[(k + 2) % 3], sign * axes[k]])
    tilt = np.cross(up, sign * axes[k])
    sine, cosine = float(np.linalg.norm(tilt)), sign * float(up[k])
    correction = so3.exp(tilt / sine * np.arctan2(sine, cosine)) if sine > 1e-9 else np.eye(3)
    return np.asarray(named @ correction)


@dataclass(frozen=True, slots=True, eq=False)
class ScanFrame:
    """The map from a scan's coordinates to metres with z up: scale * rotation * coordinates.

    Attributes:
        scale: metres per unit.
        rotation: (3, 3).
    """

    scale: float
    rotation: np.ndarray

    @property
    def up(self) -> np.ndarray:
        """Direction (3,) in the scan's frame that points up."""
        return self.rotation[2]

    def to_body(self, points: np.ndarray) -> np.ndarray:
        """Return points (N, 3) of the scan in metres, z up."""
        return self.scale * points @ self.rotation.T

    def to_scan(self, points: np.ndarray) -> np.ndarray:
        """Return points (..., 3) in metres, z up, in the scan's frame and unit."""
        return points @ self.rotation / self.scale


def guess_scale(scan: Scan) -> float:
    """Guess the metres per unit from an adult's size.

    A closed surface is the best evidence, because its area does not depend on the pose: the unit among m, cm and mm
    that makes it 1.2 to 3 square metres, otherwise the factor that makes it 1.8. The longest side of a cloud must be
    0.6 to 2.6 m.

    Raises:
        InputError: when a cloud is not the size of an adult in any of the units.
    """
    if scan.area is not None and _is_closed(scan):
        for scale in UNITS.values():
            if MIN_ADULT_AREA_M2 <= scan.area * scale**2 <= MAX_ADULT_AREA_M2:
                return scale
        return float(np.sqrt(MEAN_ADULT_AREA_M2 / scan.area))
    longest = float(np.ptp(scan.points, axis=0).max())
    for scale in UNITS.values():
        if MIN_ADULT_EXTENT_M <= longest * scale <= MAX_ADULT_EXTENT_M:
            return scale
    raise InputError(
        f"the longest side is {longest:.3g} units, which is not the size of an adult in m, cm or mm;"
        " cut out one person or name --unit"
    )


def _is_closed(scan: Scan) -> bool:
    """Return whether nearly all edges have two faces."""
    if scan.faces is None:
        return False
    edges = np.sort(np.concatenate([scan.faces[:, [0, 1]], scan.faces[:, [1, 2]], scan.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool(np.mean(count == 2) > 0.97)


def propose_up_axes(points: np.ndarray, one_sided: bool) -> list[np.ndarray]:
    """Propose directions (3,) that may be up for a standing, sitting or crouching person, the likelier first.

    The longest side of a cloud (N, 3) of a standing person is up, which leaves one direction; with arms spread the
    sides are alike and only a fit can decide. A one-sided cloud may be in an optical frame, so -y is proposed as well.
    """
    extent = np.ptp(points, axis=0)
    order = ["y", "z"] if extent[1] > extent[2] else ["z", "y"]
    ratio = max(extent[1], extent[2]) / max(min(extent[1], extent[2]), 1e-9)
    if ratio > 1.35 and max(extent[1], extent[2]) > 0.9 * extent[0]:
        order = order[:1]
    if one_sided and "y" in order:
        order.append("-y")
    return [parse_axis(name) for name in order]


def propose_all_up_axes(points: np.ndarray) -> list[np.ndarray]:
    """Propose directions (3,) towards the head of a person in any orientation in a cloud (N, 3).

    All six axes and, unless it is one of them, the cloud's longest direction both ways.
    """
    proposed = [parse_axis(name) for name in UP_AXES]
    centred = points - points.mean(axis=0)
    longest = np.linalg.svd(centred.T @ centred)[0][:, 0]
    if np.abs(longest).max() < SAME_AXIS_COSINE:
        proposed += [longest, -longest]
    return proposed


def is_seen_from_origin(points: np.ndarray) -> bool:
    """Return whether a cloud (N, 3) in metres shows only what a sensor at the origin of its frame sees.

    Behind the front of a whole body, in the same direction, lies its back; behind what a sensor saw lies nothing.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    if np.all((low <= 0) & (high >= 0)):
        return False
    distance = np.linalg.norm(points, axis=1)
    probes = np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)
    spread = []
    for places in (points / distance[:, None], points):
        near = cKDTree(places).query(places[probes], k=min(PROBE_NEIGHBOURS, len(points)))[1]
        spread.append(np.median(np.ptp(distance[near], axis=1)))
    limit = MAX_SPARSE_LAYER_RATIO if len(points) < MIN_DENSE_POINTS else MAX_DENSE_LAYER_RATIO
    return bool(spread[0] < limit * spread[1])
