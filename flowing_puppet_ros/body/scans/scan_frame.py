# SPDX-License-Identifier: Apache-2.0
"""From a scan's own frame and unit to metres with z up, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.scans.names import UP_AXES
from flowing_puppet_ros.model import rotation as so3

SAME_AXIS_COSINE = np.cos(np.radians(15.0))
"""Cosine of the angle to an axis from which on a direction counts as that axis."""


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


def propose_up_axes(points: np.ndarray, upright: bool) -> list[np.ndarray]:
    """Propose directions (3,) that may point towards the head of the person in a cloud (N, 3), the likelier first.

    All six axes; for people who may lie `upright` is false and the cloud's longest direction, both ways, is proposed as
    well unless it is one of them.
    """
    proposed = [parse_axis(name) for name in UP_AXES]
    if upright:
        return proposed
    centred = points - points.mean(axis=0)
    longest = np.linalg.svd(centred.T @ centred)[0][:, 0]
    if np.abs(longest).max() < SAME_AXIS_COSINE:
        proposed += [longest, -longest]
    return proposed
