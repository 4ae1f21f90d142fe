# SPDX-License-Identifier: Apache-2.0
"""The derivatives of a body's joints, which are weighted means of vertices, by the unknowns of the refinement.

Only the derivatives by a part's rotation depend on the pose, and they follow from the joint's share of the part's
points; those by coefficients are products of constants, which are formed once.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from flowing_puppet_ros.body.refine.normal_equations import NormalEquations
from flowing_puppet_ros.model.posing import PosedPoints
from flowing_puppet_ros.model.sp import StitchedPuppet


class JointRows:
    """The joints of one model and their derivatives by the unknowns of its `NormalEquations`."""

    def __init__(self, model: StitchedPuppet, equations: NormalEquations) -> None:
        """Apply the joints' weights to the basis of every part."""
        self._size = equations.size
        self._weights = np.zeros((len(model.joint_names), len(model.part_of_vertex)))
        for row, (index, weight) in enumerate(zip(model.joint_index, model.joint_weight, strict=True)):
            np.add.at(self._weights[row], index, weight)
        sizes = [len(rows) for rows in model.part_vertices]
        self._spans = list(pairwise(np.concatenate([[0], np.cumsum(sizes)]).tolist()))
        self._unknowns = [equations.unknowns(part) for part in range(len(sizes))]
        self._shares, self._constant = [], []
        for part, vertices in enumerate(model.part_vertices):
            share = self._weights[:, vertices] * equations.share[vertices]
            basis = np.concatenate([model.pose_basis[part], model.shape_basis[part]], axis=2)
            translation = share.sum(axis=1)[:, None, None] * np.eye(3)
            self._shares.append(share)
            self._constant.append(np.concatenate([translation, np.tensordot(share, basis, 1)], axis=2))

    def find_joints(self, chosen: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Return the joints `chosen` (C,) of body `vertices` (V, 3), as (C, 3) in metres."""
        return np.asarray(self._weights[chosen] @ vertices)

    def derive(self, chosen: np.ndarray, posed: PosedPoints, rotation: np.ndarray) -> np.ndarray:
        """Return the derivatives (C, 3, U) of the joints `chosen` (C,) of a body whose parts have `rotation` (N, 3, 3).

        A joint's share of a part turns about the part's origin like a single point.
        """
        rows = np.zeros((len(chosen), 3, self._size))
        for part, (start, end) in enumerate(self._spans):
            x, y, z = (self._shares[part][chosen] @ posed.local[start:end]).T
            own = np.zeros((len(chosen), 3, len(self._unknowns[part])))
            own[:, 0, 1], own[:, 0, 2] = z, -y
            own[:, 1, 0], own[:, 1, 2] = -z, x
            own[:, 2, 0], own[:, 2, 1] = y, -x
            own[:, :, 3:] = self._constant[part][chosen]
            rows[:, :, self._unknowns[part]] += rotation[part] @ own
        return rows
