# SPDX-License-Identifier: Apache-2.0
"""The surface of a fitted person in the template's pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


def to_standard_pose(model: StitchedPuppet, state: BodyState, vertices: Array | None = None) -> F64:
    """Return the vertices (V, 3) of a body in the template's pose: metres, z up, facing x.

    Args:
        model: of the body.
        state: the fitted variables.
        vertices: (V, 3) of the fitted surface in the axes of `state`; what it has beyond the model's own is kept, in
            the axes of the parts.
    """
    standard = _hang_parts(model, state.shape)
    own = model.vertices(standard)
    if vertices is None:
        return own
    beyond = np.asarray(vertices, np.float64) - model.vertices(state)
    return np.asarray(own + np.einsum("vji,vj->vi", state.rotation[model.part_of_vertex], beyond))


def _hang_parts(model: StitchedPuppet, shape: Array) -> BodyState:
    """Return a body of some `shape` (16, S) in the template's pose, each part hung on its parent without turning."""
    state = replace(model.rest_state(), shape=np.asarray(shape, np.float64))
    for parent, child in model.tree.edges:
        interface = model.interfaces[child - 1]
        above = model.local_vertices(parent, state.pose[parent], state.shape[parent])[interface.parent_index]
        below = model.local_vertices(child, state.pose[child], state.shape[child])[interface.child_index]
        step = np.average(above - below, axis=0, weights=interface.weight)
        state.center[child] = state.center[parent] + step
    return state
