# SPDX-License-Identifier: Apache-2.0
"""The surface of a fitted person in the template's pose."""

from __future__ import annotations

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


def to_standard_pose(model: StitchedPuppet, state: BodyState, vertices: Array | None = None) -> F64:
    """Return the vertices (V, 3) of a body in the template's pose: metres, z up, facing x.

    Every part has the shape that the model learned in that pose (Eq. 45 without the pose's share) and hangs on its
    parent without turning.

    Args:
        model: of the body.
        state: the fitted variables.
        vertices: (V, 3) of the fitted surface in the axes of `state`; what a part has beyond the model's own is kept,
            in the axes of the part.
    """
    local = [model.mean_shape[i] + model.shape_basis[i] @ state.shape[i] for i in range(len(model.tree))]
    if vertices is not None:
        surface = np.asarray(vertices, np.float64)
        for i, ids in enumerate(model.part_vertices):
            posed = (surface[ids] - state.center[i]) @ state.rotation[i]
            local[i] = local[i] + posed - model.local_vertices(i, state.pose[i], state.shape[i])
    return _assemble(model, local)


def _assemble(model: StitchedPuppet, local: list[Array]) -> F64:
    """Return the vertices (V, 3) of a body of parts (N_i, 3) in their own axes, each hung on its parent."""
    center = np.array(model.rest_center)
    for parent, child in model.tree.edges:
        interface = model.interfaces[child - 1]
        gap = local[parent][interface.parent_index] - local[child][interface.child_index]
        center[child] = center[parent] + np.average(gap, axis=0, weights=interface.weight)
    total, copies = np.zeros((len(model.part_of_vertex), 3)), np.zeros(len(model.part_of_vertex))
    for i, ids in enumerate(model.part_vertices):
        total[ids] += local[i] + center[i]
        copies[ids] += 1
    return np.asarray(total / copies[:, None])
