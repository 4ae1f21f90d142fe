# SPDX-License-Identifier: Apache-2.0
"""Tracked puppets and bodies to and from the messages of flowing_puppet_msgs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.stream.messages.geometry import make_point, make_pose, make_vector
from flowing_puppet_ros.stream.messages.message_types import BODIES, PUPPETS, MessageFactory

if TYPE_CHECKING:
    from flowing_puppet_ros.body.track.tracked_body import TrackedBody
    from flowing_puppet_ros.image.tracking.tracker import TrackedPuppet
    from flowing_puppet_ros.model.ds.puppet import DeformableStructures
    from flowing_puppet_ros.model.sp import StitchedPuppet

_MESSAGES = "flowing_puppet_msgs/msg/"

type JointPosition = tuple[float, float, float, float]
"""x, y, z in metres, and a confidence in [0, 1]."""


def decode_puppet_joints(puppet: Any) -> tuple[F64, F64]:
    """Return the joints (J, 2) in pixels and their confidences (J,) of a Puppet message; NaN where unknown."""
    joints = np.array([(joint.x, joint.y) for joint in puppet.joints], float).reshape(-1, 2)
    return joints, np.array([joint.confidence for joint in puppet.joints], float)


def make_puppets(
    factory: MessageFactory, header: Any, model: DeformableStructures, puppets: Sequence[TrackedPuppet]
) -> Any:
    """Return the PuppetArray of the tracked puppets of one image."""
    return factory.make(PUPPETS, header=header, puppets=[_make_puppet(factory, model, puppet) for puppet in puppets])


def _make_puppet(factory: MessageFactory, model: DeformableStructures, puppet: TrackedPuppet) -> Any:
    joints = [
        factory.make(_MESSAGES + "PuppetJoint", name=name, x=x, y=y, confidence=confidence)
        for name, (x, y), confidence in zip(model.joint_names, puppet.joints, puppet.confidence, strict=True)
    ]
    parts = [
        factory.make(
            _MESSAGES + "PuppetPart",
            name=name,
            label=index + 1,
            depth=puppet.depth[index],
            confidence=puppet.confidence[list(model.part_joints[index])].mean(),
            contour=puppet.contours[index],
        )
        for index, name in enumerate(model.tree.names)
    ]
    return factory.make(
        _MESSAGES + "Puppet",
        id=puppet.id,
        model=puppet.model,
        view=puppet.view,
        heading=puppet.heading,
        scale=puppet.scale,
        energy=puppet.energy,
        confidence=puppet.confidence.mean(),
        joints=joints,
        parts=parts,
    )


def make_joints(
    factory: MessageFactory, names: Sequence[str], joints: Array, confidence: Array, visibility: Sequence[int] | Array
) -> list[Any]:
    """Return the BodyJoints of `joints` (J, 3) in metres with `confidence` (J,) and `Visibility` (J,), without NaN."""
    return [
        factory.make(
            _MESSAGES + "BodyJoint", name=name, position=make_point(factory, xyz), confidence=c, visibility=int(v)
        )
        for name, xyz, c, v in zip(names, joints, confidence, visibility, strict=True)
        if np.isfinite(xyz).all()
    ]


def decode_body_joints(body: Any) -> dict[str, JointPosition]:
    """Return name -> (x, y, z, confidence) of a Body's joints."""
    return {
        joint.name: (joint.position.x, joint.position.y, joint.position.z, joint.confidence) for joint in body.joints
    }


def make_body(factory: MessageFactory, model: StitchedPuppet, body: TrackedBody) -> Any:
    """Return the Body message of a body of `model`, in the frame of the points that it was fitted to."""
    fit, state = body.fit, body.fit.state
    parts = []
    for index, name in enumerate(model.tree.names):
        used = model.pose_basis[index].shape[-1]
        parts.append(
            factory.make(
                _MESSAGES + "BodyPart",
                name=name,
                pose=make_pose(factory, state.center[index], state.rotation[index]),
                shape_coefficients=state.shape[index],
                pose_coefficients=state.pose[index, :used],
                confidence=fit.part_confidence[index],
                visibility=int(fit.visibility.parts[index]),
            )
        )
    visibility = fit.visibility.joints
    return factory.make(
        _MESSAGES + "Body",
        id=body.id,
        state=int(body.status),
        model=model.name,
        energy=fit.energy,
        confidence=fit.confidence,
        reliable=fit.reliable,
        height=model.measure_height(state.shape),
        velocity=make_vector(factory, body.velocity),
        joints=make_joints(factory, model.joint_names, fit.joints, fit.joint_confidence, visibility),
        parts=parts,
    )


def make_coarse_body(
    factory: MessageFactory, names: Sequence[str], identity: str, joints: Array, confidence: Array
) -> Any:
    """Return the Body message of a person of whom only joints (J, 3) m and their confidence (J,) are known, roughly."""
    inferred = [0] * len(joints)
    known = np.isfinite(joints).all(axis=1)
    return factory.make(
        _MESSAGES + "Body",
        id=identity,
        confidence=confidence[known].mean(),
        joints=make_joints(factory, names, joints, confidence, inferred),
    )


def make_bodies(factory: MessageFactory, header: Any, bodies: list[Any]) -> Any:
    """Return a BodyArray."""
    return factory.make(BODIES, header=header, bodies=bodies)
