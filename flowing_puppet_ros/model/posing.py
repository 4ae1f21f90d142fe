# SPDX-License-Identifier: Apache-2.0
"""The points of all parts of a Stitched Puppet in one array, posed by one compiled loop (Eqs. 45 to 47)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array


@dataclass(frozen=True, slots=True, eq=False)
class PosedPoints:
    """A body's points in metres.

    Attributes:
        local: (M, 3) points of all parts, one part after the other, in the parts' own frames.
        world: (M, 3) the same points in the common frame.
        vertices: (V, 3) of the body in the common frame, means of the copies in different parts.
    """

    local: Array
    world: Array
    vertices: Array


class BodyPoints:
    """The points of one model.

    Attributes:
        poses: (N,) numbers of pose coefficients of the parts.
        starts: (N + 1,) each part's first point.
        rows: (M,) the template's vertices that the points are.
        share: (V,) one over the number of parts that a vertex belongs to.
        mean: (M, 3) metres, of the average body in the parts' frames.
        basis: (M, 3, D + S) derivatives by the part's pose coefficients, then by the shape coefficients, then zeros.
    """

    def __init__(
        self, rows: Sequence[Array], mean: Sequence[Array], pose_basis: Sequence[Array], shape_basis: Sequence[Array]
    ) -> None:
        """Stack what each part has: vertices (K,), mean (K, 3), bases (K, 3, P) and (K, 3, S)."""
        self.poses = np.array([basis.shape[2] for basis in pose_basis])
        self.starts = np.concatenate([[0], np.cumsum([len(own) for own in rows])])
        self.rows = np.concatenate(rows).astype(np.int64)
        self.share = 1.0 / np.bincount(self.rows)
        self.mean = np.concatenate(mean)
        shapes = shape_basis[0].shape[2]
        self.basis = np.zeros((len(self.rows), 3, self.poses.max() + shapes))
        for part, count in enumerate(self.poses):
            own = self.basis[self.starts[part] : self.starts[part + 1]]
            own[:, :, :count], own[:, :, count : count + shapes] = pose_basis[part], shape_basis[part]

    def pose(self, center: Array, rotation: Array, pose: Array, shape: Array) -> PosedPoints:
        """Return the points of one body, of which `BodyState` has the arrays."""
        arrays = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in (center, rotation, pose, shape))
        layout = (self.mean, self.basis, self.poses, self.starts, self.rows, self.share)
        return PosedPoints(*_pose(arrays, layout))


# Sums may be taken in any order: those over the coefficients are most of the time.
@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _pose(body, layout):  # type: ignore[no-untyped-def]
    center, rotation, pose, shape = body
    mean, basis, poses, starts, rows, share = layout
    local, world = np.empty_like(mean), np.empty_like(mean)
    vertices = np.zeros((len(share), 3))
    amounts = np.zeros(basis.shape[2])
    for part in range(len(poses)):
        used = poses[part] + shape.shape[1]
        amounts[: poses[part]] = pose[part, : poses[part]]
        amounts[poses[part] : used] = shape[part]
        for k in range(starts[part], starts[part + 1]):
            for i in range(3):
                total = mean[k, i]
                for column in range(used):
                    total += basis[k, i, column] * amounts[column]
                local[k, i] = total
            row = rows[k]
            for i in range(3):
                world[k, i] = center[part, i] + (
                    rotation[part, i, 0] * local[k, 0]
                    + rotation[part, i, 1] * local[k, 1]
                    + rotation[part, i, 2] * local[k, 2]
                )
                vertices[row, i] += share[row] * world[k, i]
    return local, world, vertices
