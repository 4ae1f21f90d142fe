# SPDX-License-Identifier: Apache-2.0
"""Joints of the Stitched Puppet as sparse convex sums of template vertices, the same on both sides of the body."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.model.tree import mirrored_name

CANDIDATE_VERTICES = 120  # nearest vertices tried for a joint
MAX_TERMS = 24  # vertices that a joint may use
SUM_WEIGHT = 10.0  # metres: strength of the constraint that weights sum to 1, before they are normalised


def regress_joints(meshes: Array, joints: dict[str, Array], mirror: Array) -> tuple[tuple[str, ...], Array, Array]:
    """Regress joints {name: (n, 3)} from meshes (n, V, 3), with `mirror` (V,) the vertex on the other side.

    Return names, vertex ids (J, MAX_TERMS) and weights (J, MAX_TERMS). Weights are non-negative and sum to 1; unused
    terms are 0.
    """
    names, found = tuple(joints), {}
    for name in names:
        other = mirrored_name(name)
        if other == name:
            found[name] = _fit_joint(meshes, joints[name], mirror)
        elif name.startswith("left_"):
            ids, values = _fit_joint(meshes, joints[name], None)
            found[name], found[other] = (ids, values), (mirror[ids], values)
    index = np.stack([found[name][0] for name in names]).astype(np.int32)
    return names, index, np.stack([found[name][1] for name in names])


def _fit_joint(meshes: Array, joint: Array, mirror: Array | None) -> tuple[Array, Array]:
    # On the midline the unknowns are pairs of vertices, each with its mirror image.
    distance = np.linalg.norm(meshes - joint[:, None], axis=2).mean(axis=0)
    ids = np.argsort(distance, kind="stable")[:CANDIDATE_VERTICES]
    terms = MAX_TERMS
    if mirror is not None:
        ids = np.unique(np.minimum(ids, mirror[ids]))
        terms = MAX_TERMS // 2
    other = ids if mirror is None else mirror[ids]
    columns = ((meshes[:, ids] + meshes[:, other]) / 2).transpose(0, 2, 1).reshape((-1, len(ids)))
    # Relative to the mean of the nearest vertices, all bodies weigh the same whatever their posture.
    centre = np.broadcast_to(meshes[:, ids].mean(axis=1)[..., None], (*joint.shape, 1)).reshape((-1, 1))
    chosen = np.arange(len(ids))
    for _ in range(2):
        values = _solve_convex(columns[:, chosen] - centre, joint.ravel() - centre[:, 0])
        strongest = np.argsort(-values, kind="stable")[:terms]
        chosen, values = chosen[strongest], values[strongest]
    full_ids, full = np.zeros(terms, np.int64), np.zeros(terms)
    full_ids[: len(chosen)], full[: len(chosen)] = chosen, values / values.sum()
    if mirror is None:
        return ids[full_ids], full
    return np.concatenate([ids[full_ids], mirror[ids[full_ids]]]), np.concatenate([full, full]) / 2


def _solve_convex(columns: Array, target: Array) -> Array:
    sum_row = np.sqrt(len(target)) * SUM_WEIGHT * np.ones((1, columns.shape[1]))
    return np.asarray(nnls(np.vstack([columns, sum_row]), np.append(target, sum_row[0, 0]))[0])
