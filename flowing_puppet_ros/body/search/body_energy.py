# SPDX-License-Identifier: Apache-2.0
"""The energy of one whole body (Eq. 50), as the search has it for particles, in a few operations on all parts."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.body.search.energy import MIN_CENTRE_DISTANCE_M
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.schedule import four_stages
from flowing_puppet_ros.evidence.cloud.data_term import DataCost
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet, body_points, pose_points


class BodyEnergy:
    """The energy of bodies of one model, with every weight as in the last stage of the search.

    `stitch` and `mismatch` are those of `SearchWeights`.
    """

    def __init__(self, model: StitchedPuppet, points: tuple[PartPoints, ...], stitch: float, mismatch: float) -> None:
        self._model, self._stitch, self._mismatch = model, stitch, mismatch
        starts, edges = body_points(model).starts, model.tree.edges
        self._surface = np.concatenate([start + part.rows for start, part in zip(starts, points, strict=False)])
        self._normals = np.concatenate([part.normals for part in points])
        self._owner = np.repeat(np.arange(len(points)), [len(part.rows) for part in points])
        stage, faces = four_stages(model.tree)[-1], model.interfaces
        self._data = (stage.data / np.bincount(self._owner))[self._owner]
        self._edges = np.array(edges)
        above = [starts[parent] + face.parent_index for (parent, _), face in zip(edges, faces, strict=True)]
        below = [starts[child] + face.child_index for (_, child), face in zip(edges, faces, strict=True)]
        self._pairs = np.concatenate(above), np.concatenate(below)
        self._alpha = stage.stitch
        self._weight = np.concatenate(
            [alpha * face.weight / face.weight.sum() for alpha, face in zip(stage.stitch, faces, strict=True)]
        )

    def measure(self, state: BodyState, cloud: DataCost) -> float:
        """Return the energy of a body, metres being its unit of length."""
        world = pose_points(self._model, state).world
        normals = (state.rotation[self._owner] @ self._normals[:, :, None])[:, None, :, 0]
        distance, mismatch = cloud.data_cost(world[self._surface][:, None], normals)
        gaps = ((world[self._pairs[0]] - world[self._pairs[1]]) ** 2).sum(axis=1)
        apart = np.linalg.norm(state.center[self._edges[:, 0]] - state.center[self._edges[:, 1]], axis=1)
        data = self._data @ (distance + self._mismatch * mismatch)
        return float(data + self._stitch * (self._weight @ gaps) + self._alpha @ (apart < MIN_CENTRE_DISTANCE_M))
