# SPDX-License-Identifier: Apache-2.0
"""The points of all parts of a Stitched Puppet in one array, posed by one compiled loop (Eqs. 45 to 47)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import Array

if TYPE_CHECKING:
    from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


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

    def __init__(self, model: StitchedPuppet) -> None:
        parts = range(len(model.tree))
        self.poses = np.array([model.pose_count(part) for part in parts])
        self.starts = np.concatenate([[0], np.cumsum([len(rows) for rows in model.part_vertices])])
        self.rows = np.concatenate(model.part_vertices).astype(np.int64)
        self.share = 1.0 / np.bincount(self.rows, minlength=len(model.part_of_vertex))
        self.mean = np.concatenate([model.mean_shape[i] + model.mean_pose[i] for i in parts])
        self.basis = np.zeros((len(self.rows), 3, self.poses.max() + model.shape_count))
        for part, count in enumerate(self.poses):
            own = self.basis[self.starts[part] : self.starts[part + 1]]
            own[:, :, :count] = model.pose_basis[part]
            own[:, :, count : count + model.shape_count] = model.shape_basis[part]

    def pose(self, state: BodyState) -> PosedPoints:
        """Return the points of one body."""
        body = (state.center, state.rotation, state.pose, state.shape)
        arrays = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in body)
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
