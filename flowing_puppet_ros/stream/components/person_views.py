# SPDX-License-Identifier: Apache-2.0
"""People in several cameras: who is whom among the puppets, and what each camera observes of each person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.image.tracking.appearance import TORSO_CORNERS, torso_appearances
from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D, PersonInSpace
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.bundle.rig_check import RigCheck
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.hull_builder import CameraObservation, HullBuilder
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings
from flowing_puppet_ros.stream.messages.puppets import decode_puppet_joints


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """One camera's part of a set: its image (H, W, 3), its part labels (H, W), and the Puppet messages in it."""

    image: U8
    labels: U8
    puppets: Sequence[Any]


class PersonMatcher:
    """Finds who is whom among the puppets of calibrated cameras, set by set, and keeps people's ids.

    Puppets with other joints than most have (those of another model) are nobody's.
    """

    def __init__(self, settings: AssociationSettings, triangulation: TriangulationSettings) -> None:
        """Start without people."""
        self._settings = settings
        self._triangulation = triangulation
        self._tracker: PeopleTracker3D | None = None
        self._check: RigCheck | None = None
        self.problem = ""
        """What was found wrong with the calibration in the last set, in one sentence; empty if nothing."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of the people; none before the first puppet."""
        return self._tracker.names if self._tracker is not None else ()

    def reset(self) -> None:
        """Forget everybody; ids go on."""
        if self._tracker is not None:
            self._tracker.reset()

    def match(
        self, stamp: int, cameras: Mapping[str, Camera], frames: Mapping[str, CameraFrame]
    ) -> list[tuple[PersonInSpace, dict[str, Any]]]:
        """Return the people whom two or more cameras see at `stamp` (ns), each with its puppets by camera."""
        self.problem = ""
        kinds = Counter(_list_names(puppet) for frame in frames.values() for puppet in frame.puppets)
        if not kinds:
            return []
        names = kinds.most_common(1)[0][0]
        if self._tracker is None or (self._tracker.names != names and self._tracker.names not in kinds):
            self._tracker = PeopleTracker3D(names, self._settings, self._triangulation)
            self._check = RigCheck(names)
        wanted = self._tracker.names
        usable = {
            name: [puppet for puppet in frame.puppets if _list_names(puppet) == wanted]
            for name, frame in frames.items()
        }
        people = {name: _decode_people(wanted, frames[name].image, group) for name, group in usable.items()}
        found = self._tracker.step(stamp, cameras, people)
        assert self._check is not None
        self.problem = self._check.add(cameras, people, found)
        return [(person, {name: usable[name][k] for name, k in person.views.items()}) for person in found]


def _list_names(puppet: Any) -> tuple[str, ...]:
    return tuple(joint.name for joint in puppet.joints)


def _decode_people(names: Sequence[str], image: U8, puppets: Sequence[Any]) -> list[PersonInView]:
    """Return the puppets of one image with the colours of their torsos where there is more than one to tell apart."""
    decoded = [decode_puppet_joints(puppet) for puppet in puppets]
    colours: list[F64 | None] = [None] * len(puppets)
    if set(TORSO_CORNERS) <= set(names):
        found = torso_appearances(names, image, [joints for joints, _ in decoded])
        colours = [each.colours if each is not None and each.isolated else None for each in found]
    return [
        PersonInView(puppet.id or f"p{number}", joints, confidence, torso)
        for number, (puppet, (joints, confidence), torso) in enumerate(zip(puppets, decoded, colours, strict=True))
    ]


def learn_background(builder: HullBuilder, name: str, frame: CameraFrame) -> None:
    """Learn camera `name`'s background where no puppet is; InputError when the image is not that of its calibration."""
    if frame.puppets:
        builder.update_background(name, frame.image, frame.labels, _choose_scale(frame.puppets))


def _choose_scale(puppets: Sequence[Any]) -> float:
    """Return the scale of the most confident puppet, px/m."""
    return float(max(puppets, key=lambda puppet: puppet.confidence).scale)


def observe_person(
    builder: HullBuilder, name: str, frame: CameraFrame, puppet: Any, person: PersonInSpace
) -> CameraObservation:
    """Observe the person that `puppet` shows in an image with the part labels of all people."""
    region = np.zeros(frame.labels.shape, np.uint8)
    for part in puppet.parts:
        contour = np.asarray(part.contour, float).reshape(-1, 2)
        cv2.fillPoly(region, [np.rint(contour).astype(np.int32)], 1)
    observation = builder.observe(name, frame.image, frame.labels, float(puppet.scale), frame.labels * region)
    return CameraObservation(observation, person.seen[name].joints, person.weights[name])
