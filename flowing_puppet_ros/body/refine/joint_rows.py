# SPDX-License-Identifier: Apache-2.0
"""The derivatives of a body's joints, which are weighted means of vertices, by the unknowns of the refinement.

Only the derivatives by a part's rotation depend on the pose, and they follow from the joint's share of the part's
points; those by coefficients are products of constants, which are formed once. A joint depends on few parts, so that
its derivatives are zero but for a fifth of the unknowns.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flowing_puppet_ros.body.refine.normal_equations import NormalEquations, System
from flowing_puppet_ros.model.posing import PosedPoints
from flowing_puppet_ros.model.sp import StitchedPuppet

# For compiled loops: first piece of every joint (J + 1,), and of every piece, which is the joint's share of a part, the
# part (Q,), first point (Q + 1,), derivatives by translation and coefficients (Q, 3, W - 3), and first unknown and
# number of unknowns (Q, 2); of every point of a piece its number among the points of all parts and its weight.
PieceArrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class JointRows:
    """The joints of one model and their derivatives by the unknowns of its `NormalEquations`."""

    def __init__(self, model: StitchedPuppet, equations: NormalEquations) -> None:
        """Apply the joints' weights to the basis of every part."""
        self._size, self._shape_start = equations.size, int(equations.first[-1])
        self._weights = np.zeros((len(model.joint_names), len(model.part_of_vertex)))
        for row, (index, weight) in enumerate(zip(model.joint_index, model.joint_weight, strict=True)):
            np.add.at(self._weights[row], index, weight)
        self._means = (model.joint_index.astype(np.int64), np.asarray(model.joint_weight, dtype=np.float64))
        self._pieces = self._list_pieces(model, equations)

    def _list_pieces(self, model: StitchedPuppet, equations: NormalEquations) -> PieceArrays:
        starts = np.cumsum([0, *(len(rows) for rows in model.part_vertices)])
        joints, parts, ends, constants, spans = [0], [], [0], [], []
        points, weights = [], []
        width = int(np.diff(equations.first).max()) - 3 + model.shape_count
        for joint in range(len(self._weights)):
            for part, vertices in enumerate(model.part_vertices):
                share = self._weights[joint, vertices] * equations.share[vertices]
                used = np.flatnonzero(share)
                if not len(used):
                    continue
                basis = np.concatenate([model.pose_basis[part], model.shape_basis[part]], axis=2)[used]
                constant = np.zeros((3, width))
                constant[:, :3] = share.sum() * np.eye(3)
                constant[:, 3 : 3 + basis.shape[2]] = np.tensordot(share[used], basis, 1)
                parts.append(part)
                constants.append(constant)
                spans.append((equations.first[part], equations.first[part + 1] - equations.first[part]))
                points.append(starts[part] + used)
                weights.append(share[used])
                ends.append(ends[-1] + len(used))
            joints.append(len(parts))
        return (
            np.array(joints), np.array(parts), np.array(ends), np.stack(constants), np.array(spans, np.int64),
            np.concatenate(points), np.concatenate(weights),
        )  # fmt: skip

    def find_joints(self, chosen: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Return the joints `chosen` (C,) of body `vertices` (V, 3), as (C, 3) in metres."""
        return np.asarray(_find_joints(chosen, vertices, self._means))

    def derive(self, chosen: np.ndarray, posed: PosedPoints, rotation: np.ndarray) -> np.ndarray:
        """Return the derivatives (C, 3, U) of the joints `chosen` (C,) of a body whose parts have `rotation` (N, 3, 3).

        A joint's share of a part turns about the part's origin like a single point.
        """
        rows = np.zeros((len(chosen), 3, self._size))
        for row, joint in zip(rows, chosen.tolist(), strict=True):
            _fill_rows(row, joint, posed.local, np.ascontiguousarray(rotation), self._pieces, self._shape_start)
        return rows

    def add(
        self,
        chosen: np.ndarray,
        pull: tuple[np.ndarray, np.ndarray, np.ndarray],
        posed: PosedPoints,
        rotation: np.ndarray,
        system: System,
    ) -> None:
        """Add the squared gaps of the joints `chosen` (C,) to the normal equations.

        `pull` are the gaps (C, 3) in metres from the targets, their weights (C,), and what stays (C, 3, 3) of the
        derivatives, as the identity or without what is along a ray.
        """
        _add_joints(chosen, pull, posed.local, np.ascontiguousarray(rotation), self._pieces, self._shape_start, system)


@njit(cache=True, nogil=True)
def _find_joints(chosen, vertices, means):  # type: ignore[no-untyped-def]
    (index, weight), joints = means, np.zeros((len(chosen), 3))
    for row in range(len(chosen)):
        for k in range(index.shape[1]):
            vertex, share = index[chosen[row], k], weight[chosen[row], k]
            for axis in range(3):
                joints[row, axis] += share * vertices[vertex, axis]
    return joints


@njit(cache=True, nogil=True)
def _fill_rows(rows, joint, local, rotations, pieces, shape_start):  # type: ignore[no-untyped-def]
    """Add the derivatives (3, U) of a joint to `rows`."""
    joints, parts, ends, constants, spans, points, weights = pieces
    own = np.empty((3, 3 + constants.shape[2]))
    shapes = rows.shape[1] - shape_start
    for piece in range(joints[joint], joints[joint + 1]):
        rotation, first, count = rotations[parts[piece]], spans[piece, 0], spans[piece, 1]
        x = y = z = 0.0
        for k in range(ends[piece], ends[piece + 1]):
            x += weights[k] * local[points[k], 0]
            y += weights[k] * local[points[k], 1]
            z += weights[k] * local[points[k], 2]
        own[:, :3] = 0.0
        own[0, 1], own[0, 2] = z, -y
        own[1, 0], own[1, 2] = -z, x
        own[2, 0], own[2, 1] = y, -x
        own[:, 3:] = constants[piece]
        for column in range(count + shapes):
            unknown = first + column if column < count else shape_start + column - count
            for i in range(3):
                rows[i, unknown] += (
                    rotation[i, 0] * own[0, column] + rotation[i, 1] * own[1, column] + rotation[i, 2] * own[2, column]
                )


@njit(cache=True, nogil=True)
def _add_joints(chosen, pull, local, rotations, pieces, shape_start, system):  # type: ignore[no-untyped-def]
    """Add the weighted squares of the joints' gaps; only the unknowns on which each joint depends are visited."""
    (gaps, trust, stays), (hessian, gradient) = pull, system
    size = len(gradient)
    rows, columns = np.zeros((3, size)), np.empty(size, np.int64)
    used, squeezed = np.zeros(size, np.bool_), np.empty((3, size))
    for c in range(len(chosen)):
        joint, count = chosen[c], 0
        _fill_rows(rows, joint, local, rotations, pieces, shape_start)
        used[:] = False
        for piece in range(pieces[0][joint], pieces[0][joint + 1]):
            used[pieces[4][piece, 0] : pieces[4][piece, 0] + pieces[4][piece, 1]] = True
        used[shape_start:] = True
        for unknown in range(size):
            if used[unknown]:
                columns[count] = unknown
                for i in range(3):
                    squeezed[i, count] = (
                        stays[c, i, 0] * rows[0, unknown]
                        + stays[c, i, 1] * rows[1, unknown]
                        + stays[c, i, 2] * rows[2, unknown]
                    )
                count += 1
        for k in range(count):
            a, b, d = trust[c] * squeezed[0, k], trust[c] * squeezed[1, k], trust[c] * squeezed[2, k]
            gradient[columns[k]] += a * gaps[c, 0] + b * gaps[c, 1] + d * gaps[c, 2]
            for other in range(k + 1):
                hessian[columns[k], columns[other]] += (
                    a * squeezed[0, other] + b * squeezed[1, other] + d * squeezed[2, other]
                )
            for i in range(3):
                rows[i, columns[k]] = 0.0
