# SPDX-License-Identifier: Apache-2.0
"""Bodies of which the sensor could see a part only: how much is out of sight, and the priors that it then needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.fit.initialisation import FAR_JOINT
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

UNKNOWN_SHARES = (0.05, 0.3, 0.6)
"""Shares of a body out of sight between which the weights below hold: nearly all seen, without the legs below the
knees, only the chest and what is above it."""
POSE_WEIGHTS, SHAPE_WEIGHTS = (3e-8, 1e-7, 1e-6), (1e-6, 2e-6, 2e-5)
"""Weights of pose coefficients and joints, and of the shape: what is seen bends what is not less and less."""
MIN_UNSEEN_SHARE = 0.9
"""Share of a part's vertices out of sight from which on nothing tells its pose."""


def measure_unknown_share(model: StitchedPuppet, body: BodyState, cloud: Cloud) -> float:
    """Return the share of a body's vertices that the sensor of a cloud cannot know anything about."""
    return 0.0 if cloud.field is None else float(cloud.field.find_unknown(model.vertices(body)).mean())


def strengthen_priors(weights: RefineWeights, share: float) -> RefineWeights:
    """Return weights with the priors that a body needs of which a `share` of the vertices is out of sight."""
    if share <= UNKNOWN_SHARES[0]:
        return weights
    pose, shape = (
        float(np.exp(np.interp(share, UNKNOWN_SHARES, np.log(values)))) for values in (POSE_WEIGHTS, SHAPE_WEIGHTS)
    )
    return replace(
        weights,
        pose=max(weights.pose, pose),
        pairwise=max(weights.pairwise, pose),
        shape=max(weights.shape, shape),
    )


def hang_unseen_parts(
    model: StitchedPuppet, frames: tuple[BodyState, BodyState], cloud: Cloud, targets: JointTargets
) -> BodyState:
    """Return a body whose parts out of the sensor's sight have the pose that they had before, on parents that moved.

    Gauss-Newton leaves them to the priors alone, in which they drift from frame to frame, unless a target of their far
    joint places them. `frames` are the body in the last frame and in that of the cloud.
    """
    before, after = frames
    if cloud.field is None:
        return after
    unknown = cloud.field.find_unknown(model.vertices(after))
    owner, parts = model.part_of_vertex, len(model.tree)
    share = np.bincount(owner, unknown, parts) / np.bincount(owner, minlength=parts)
    state = BodyState(after.center.copy(), after.rotation.copy(), after.pose.copy(), after.shape)
    for part in range(1, parts):
        if share[part] < MIN_UNSEEN_SHARE or _is_placed(model, part, targets):
            continue
        parent, interface = model.tree.parents[part], model.interfaces[part - 1]
        state.pose[part] = before.pose[part]
        state.rotation[part] = state.rotation[parent] @ before.rotation[parent].T @ before.rotation[part]
        above, own = (
            model.local_vertices(each, state.pose[each], state.shape[each])[index].mean(axis=0)
            for each, index in ((parent, interface.parent_index), (part, interface.child_index))
        )
        state.center[part] = state.center[parent] + state.rotation[parent] @ above - state.rotation[part] @ own
    return state


def _is_placed(model: StitchedPuppet, part: int, targets: JointTargets) -> bool:
    """Return whether there is a target for the far joint of a part."""
    side, _, kind = model.tree.names[part].partition("_")
    joint = f"{side}_{FAR_JOINT[kind]}" if kind else "face"
    return joint in model.joint_names and bool(targets.weight[model.joint_names.index(joint)] > 0)
