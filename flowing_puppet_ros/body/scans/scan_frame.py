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
ADULT_AREA = (1.2, 3.0)
USUAL_AREA = 1.8
ADULT_EXTENT = (0.6, 2.6)
UP_NAMES = ("z", "y", "-y", "-z", "x", "-x")
"""Axes that may point up, the likelier first; -y does in optical frames (REP-103)."""
SAME_AXIS = np.cos(np.radians(15.0))
PROBES, NEIGHBOURS = 1000, 5
SPARSE = 2000
LAYERED = {False: 4.0, True: 2.3}
"""Spread of the distance to the sensor among neighbours in direction, over that among neighbours in space, below which
a cloud has one layer, without and with fewer than `SPARSE` points; of whole bodies it is 2.4 and more in clouds of 500
points, 7 and more in dense ones, of views 1.4 to 2.3."""


def axis_of(name: str) -> np.ndarray:
    """The direction (3,) that one of `UP_NAMES` names."""
    return (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])]


def rotation_to_z_up(up: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that takes the direction `up` (3,) to z.

    Of the axis nearest to it the next one, in the order x y z x, becomes x: people in frames with y up look along z.
    """
    up = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    k = int(np.abs(up).argmax())
    sign = 1.0 if up[k] >= 0 else -1.0
    axes = np.eye(3)
    named = np.stack([axes[(k + 1) % 3], sign * axes[(k + 2) % 3], sign * axes[k]])
    tilt = np.cross(up, sign * axes[k])
    sine, cosine = float(np.linalg.norm(tilt)), sign * float(up[k])
    turn = so3.exp(tilt / sine * np.arctan2(sine, cosine)) if sine > 1e-9 else np.eye(3)
    return np.asarray(named @ turn)


@dataclass(frozen=True, slots=True, eq=False)
class ScanFrame:
    """metres with z up = scale * rotation * the scan's coordinates.

    Attributes:
        scale: metres a unit.
        rotation: (3, 3).
    """

    scale: float
    rotation: np.ndarray

    @property
    def up(self) -> np.ndarray:
        """The direction (3,) in the scan's frame that points up."""
        return self.rotation[2]

    def to_body(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the scan in metres, z up."""
        return self.scale * points @ self.rotation.T

    def to_scan(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in metres, z up, in the scan's frame and unit."""
        return points @ self.rotation / self.scale


def guess_scale(scan: Scan) -> float:
    """Metres a unit, from an adult's size.

    A closed surface tells best, because its area does not depend on the pose: the unit among m, cm and mm that makes
    it 1.2 to 3 square metres, otherwise the factor that makes it 1.8. A cloud must be 0.6 to 2.6 m at its longest.

    Raises:
        InputError: when a cloud is no adult in any of the units.
    """
    if scan.area is not None and _is_closed(scan):
        for scale in UNITS.values():
            if ADULT_AREA[0] <= scan.area * scale**2 <= ADULT_AREA[1]:
                return scale
        return float(np.sqrt(USUAL_AREA / scan.area))
    longest = float(np.ptp(scan.points, axis=0).max())
    for scale in UNITS.values():
        if ADULT_EXTENT[0] <= longest * scale <= ADULT_EXTENT[1]:
            return scale
    raise InputError(
        f"the longest side is {longest:.3g} units, which is no adult in m, cm or mm; cut out one person or name --unit"
    )


def _is_closed(scan: Scan) -> bool:
    """Whether nearly all edges have two faces."""
    if scan.faces is None:
        return False
    edges = np.sort(np.concatenate([scan.faces[:, [0, 1]], scan.faces[:, [1, 2]], scan.faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool(np.mean(count == 2) > 0.97)


def up_candidates(points: np.ndarray, one_sided: bool) -> list[np.ndarray]:
    """Directions (3,) that may be up for a person who stands, sits or crouches in a cloud (N, 3), the likelier first.

    A standing person is longest upwards, which leaves one; with arms spread the sides are alike and only a fit can
    tell. A cloud from one side may be in an optical frame, so that y the other way round is among them.
    """
    extent = np.ptp(points, axis=0)
    order = ["y", "z"] if extent[1] > extent[2] else ["z", "y"]
    ratio = max(extent[1], extent[2]) / max(min(extent[1], extent[2]), 1e-9)
    if ratio > 1.35 and max(extent[1], extent[2]) > 0.9 * extent[0]:
        order = order[:1]
    if one_sided and "y" in order:
        order.append("-y")
    return [axis_of(name) for name in order]


def all_candidates(points: np.ndarray) -> list[np.ndarray]:
    """Directions (3,) that may point to the head of a person who lies or hangs anyhow in a cloud (N, 3).

    All six axes and, where it is none of them, the cloud's longest direction either way.
    """
    found = [axis_of(name) for name in UP_NAMES]
    middle = points - points.mean(axis=0)
    longest = np.linalg.svd(middle.T @ middle)[0][:, 0]
    if np.abs(longest).max() < SAME_AXIS:
        found += [longest, -longest]
    return found


def seen_from_origin(points: np.ndarray) -> bool:
    """Whether a cloud (N, 3) in metres shows only what a sensor at the origin of its frame sees.

    Behind the surface of a whole body, in the same direction, is its other side; behind what a sensor saw is nothing.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    if np.all((low <= 0) & (high >= 0)):
        return False
    distance = np.linalg.norm(points, axis=1)
    probes = np.linspace(0, len(points) - 1, min(PROBES, len(points))).astype(np.int64)
    spread = []
    for places in (points / distance[:, None], points):
        near = cKDTree(places).query(places[probes], k=min(NEIGHBOURS, len(points)))[1]
        spread.append(np.median(np.ptp(distance[near], axis=1)))
    return bool(spread[0] < LAYERED[len(points) < SPARSE] * spread[1])
