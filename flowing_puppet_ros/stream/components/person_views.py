# SPDX-License-Identifier: Apache-2.0
"""One person in several cameras: which puppets show the same person, and what each camera observes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import CameraObservation, HullBuilder
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings, triangulate
from flowing_puppet_ros.stream.messages.puppets import decode_puppet_joints

_MIN_COMMON_JOINTS = 4
"""Minimum joints that must triangulate between two cameras for their puppets to be one person."""


@dataclass(frozen=True, slots=True, eq=False)
class PersonView:
    """What one camera observes of the person, and the names of the joints in it."""

    joint_names: tuple[str, ...]
    observation: CameraObservation


def match_person(
    cameras: Mapping[str, Camera], people: Mapping[str, Sequence[Any]], settings: TriangulationSettings
) -> dict[str, Any]:
    """Return the puppet of the main person in every camera that sees it, camera name -> Puppet message.

    The most confident puppet of all leads. Its partner in every other camera is the puppet with which most joints
    can be triangulated. Puppets with another number of joints (another model) are never partners.
    """
    candidates = [
        (float(puppet.confidence), name, k) for name, group in people.items() for k, puppet in enumerate(group)
    ]
    if not candidates:
        return {}
    _, leader, index = max(candidates, key=lambda entry: entry[0])
    first = people[leader][index]
    chosen = {leader: first}
    for name, group in people.items():
        if name == leader:
            continue
        agreement = [
            _count_common_joints((cameras[leader], cameras[name]), (first, puppet), settings) for puppet in group
        ]
        if agreement and max(agreement)[0] >= _MIN_COMMON_JOINTS:
            chosen[name] = group[agreement.index(max(agreement))]
    return {name: chosen[name] for name in people if name in chosen}


def _count_common_joints(
    cameras: tuple[Camera, Camera], puppets: tuple[Any, Any], settings: TriangulationSettings
) -> tuple[int, float]:
    decoded = [decode_puppet_joints(puppet) for puppet in puppets]
    if len(decoded[0][0]) != len(decoded[1][0]):
        return 0, 0.0
    points, confidence = (np.stack(column) for column in zip(*decoded, strict=True))
    joints, joint_confidence = triangulate(cameras, points, confidence, settings)
    return int(np.isfinite(joints).all(axis=1).sum()), float(joint_confidence.sum())


def observe_person(builder: HullBuilder, name: str, image: U8, labels: U8, puppet: Any) -> PersonView:
    """Observe the person that `puppet` shows in an image (H, W, 3) with the part labels (H, W) of all people."""
    region = np.zeros(labels.shape, np.uint8)
    for part in puppet.parts:
        contour = np.asarray(part.contour, float).reshape(-1, 2)
        cv2.fillPoly(region, [np.rint(contour).astype(np.int32)], 1)
    observation = builder.update_background(name, image, labels, float(puppet.scale), person=labels * region)
    joints, confidence = decode_puppet_joints(puppet)
    names = tuple(joint.name for joint in puppet.joints)
    return PersonView(names, CameraObservation(observation, joints, confidence))
