# SPDX-License-Identifier: Apache-2.0
"""From a scan's own frame and unit to metres with z up, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.io import Scan
from flowing_puppet_ros.errors import InputError

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
ADULT_AREA = (1.2, 3.0)
USUAL_AREA = 1.8
ADULT_EXTENT = (0.6, 2.6)
# Columns are the images of x, y and z: y up becomes z up and z, where such people look, becomes x.
Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
Z_UP = np.eye(3)
# Optical frames have y down, z away from the camera (REP-103); the people in them look along -z or so.
Y_DOWN = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
UP_NAMES = {"y": Y_UP, "z": Z_UP, "-y": Y_DOWN}


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """metres with z up = scale * rotation * the scan's coordinates.

    Attributes:
        scale: metres a unit.
        rotation: (3, 3).
    """

    scale: float
    rotation: np.ndarray

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


def up_candidates(scan: Scan, scale: float, one_sided: bool) -> list[str]:
    """Names of the up axes to try, see `UP_NAMES`, the likelier first; one when the longest side leaves no doubt.

    A standing person is longest upwards; with arms spread the sides are alike and only a fit can tell. A cloud from one
    side may be in an optical frame, so that with y the other way round is tried too.
    """
    extent = np.ptp(scan.points, axis=0) * scale
    order = ["y", "z"] if extent[1] > extent[2] else ["z", "y"]
    ratio = max(extent[1], extent[2]) / max(min(extent[1], extent[2]), 1e-9)
    if ratio > 1.35 and max(extent[1], extent[2]) > 0.9 * extent[0]:
        order = order[:1]
    return [*order, "-y"] if one_sided and "y" in order else order
