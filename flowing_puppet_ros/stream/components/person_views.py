# SPDX-License-Identifier: Apache-2.0
"""One person in several cameras: which puppets are the same person, and what each camera contributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import CameraObservation, HullBuilder
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings, triangulate

_LEAST_JOINTS = 4
"""Joints that must agree in two cameras before their puppets are taken for one person."""


@dataclass(frozen=True, slots=True, eq=False)
class PersonView:
    """The puppet of one camera as the hull needs it, and the names of its joints."""

    joint_names: tuple[str, ...]
    hull_view: CameraObservation


def joint_table(puppet: Any) -> tuple[F64, F64]:
    """Return the joints (J,2) in pixels and the confidences (J,) of a Puppet message."""
    joints = np.array([(joint.x, joint.y) for joint in puppet.joints], float).reshape(-1, 2)
    return joints, np.array([joint.confidence for joint in puppet.joints], float)


def same_person(
    cameras: Mapping[str, Camera], people: Mapping[str, Sequence[Any]], settings: TriangulationSettings
) -> dict[str, Any]:
    """Return the puppet of the main person in every camera that sees it, camera name -> Puppet message.

    The most confident puppet of all leads; in every other camera its partner is the one with which most joints can be
    triangulated. Puppets whose joints differ in number (another model) are no partners.
    """
    seen = [(float(puppet.confidence), name, k) for name, group in people.items() for k, puppet in enumerate(group)]
    if not seen:
        return {}
    _, leader, index = max(seen, key=lambda entry: entry[0])
    first = people[leader][index]
    chosen = {leader: first}
    for name, group in people.items():
        if name == leader:
            continue
        agreement = [_agreement((cameras[leader], cameras[name]), (first, puppet), settings) for puppet in group]
        if agreement and max(agreement)[0] >= _LEAST_JOINTS:
            chosen[name] = group[agreement.index(max(agreement))]
    return {name: chosen[name] for name in people if name in chosen}


def _agreement(
    cameras: tuple[Camera, Camera], puppets: tuple[Any, Any], settings: TriangulationSettings
) -> tuple[int, float]:
    tables = [joint_table(puppet) for puppet in puppets]
    if len(tables[0][0]) != len(tables[1][0]):
        return 0, 0.0
    points, confidence = (np.stack(column) for column in zip(*tables, strict=True))
    joints, certain = triangulate(cameras, points, confidence, settings)
    return int(np.isfinite(joints).all(axis=1).sum()), float(certain.sum())


def view_of(builder: HullBuilder, name: str, image: U8, labels: U8, puppet: Any) -> PersonView:
    """Observe one camera's image (H,W,3) with the part labels (H,W) of all people; cut out the one that `puppet` is."""
    region = np.zeros(labels.shape, np.uint8)
    for part in puppet.parts:
        contour = np.asarray(part.contour, float).reshape(-1, 2)
        cv2.fillPoly(region, [np.rint(contour).astype(np.int32)], 1)
    observation = builder.update_background(name, image, labels, float(puppet.scale), person=labels * region)
    joints, confidence = joint_table(puppet)
    names = tuple(joint.name for joint in puppet.joints)
    return PersonView(names, CameraObservation(observation, joints, confidence))
