# SPDX-License-Identifier: Apache-2.0
"""How far the joints of people in space, projected into each camera, are from the joints of their puppets there."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.bag.reader import Bag
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import Joints, Recording, body_joints, puppet_joints
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.message_types import SILHOUETTES

_AGREE_M = TriangulationSettings().max_ray_distance
SURE_CONFIDENCE = 0.5
"""Of a puppet's joint, from which it is rather right than wrong."""
_MAX_MEDIAN_M = 0.3  # of the distances of a puppet's joints, for it to show a person

type PeopleInSpace = dict[int, dict[str, Joints]]
"""Stamp (ns) -> id -> joint -> (3,) m, in the frame of the recording's cameras."""


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Distances of joints in one camera, or in all of them.

    Attributes:
        pixels: (N,) of all joints that are known in space and in the image.
        agrees: (N,) whether they are within 6 cm at the joint's depth: the image took part in placing the joint.
        sure: (N,) whether the puppet is rather sure of them, by the image alone: hidden limbs are guessed.
        people: (N,) whose they are.
    """

    pixels: np.ndarray
    agrees: np.ndarray
    sure: np.ndarray
    people: np.ndarray

    @property
    def mean_of_agreeing(self) -> float:
        """Mean distance of the joints that agree, px; NaN if there are none."""
        return float(self.pixels[self.agrees].mean()) if self.agrees.any() else float("nan")

    @classmethod
    def join(cls, parts: Mapping[str, Reprojection]) -> Reprojection:
        """Return the distances of several cameras as one."""
        return cls(
            *(
                np.concatenate([getattr(each, name) for each in parts.values()])
                for name in ("pixels", "agrees", "sure", "people")
            )
        )


def read_people_in_space(bag: Bag) -> PeopleInSpace:
    """Return the joints of the people in the SilhouetteSets of a replay's output; empty if it has none."""
    topics = [name for name, kind in bag.topics.items() if kind == SILHOUETTES]
    people: PeopleInSpace = {}
    for record in bag.messages(topics) if topics else ():
        with suppress(InputError):
            person = record.message.person
            people.setdefault(stamp_ns(record.message), {})[person.id] = body_joints(person)
    return people


def measure_reprojection(recording: Recording, people: PeopleInSpace) -> dict[str, Reprojection]:
    """Measure the joints of `people` in each calibrated camera that shows any of them, by the camera's name."""
    found: dict[str, Reprojection] = {}
    for record in recording.cameras.values():
        if record.camera is None:
            continue
        rows: list[tuple[float, bool, bool, str]] = []
        for stamp, group in people.items():
            seen = record.puppets.get(stamp, ())
            puppets = [puppet_joints(puppet) for puppet in seen]
            for identity, index in match_people(record.camera, group, puppets).items():
                sure = puppet_joints(seen[index], SURE_CONFIDENCE)
                for is_sure in (False, True):
                    chosen = {name: each for name, each in puppets[index].items() if (name in sure) == is_sure}
                    pixels, metres = compare_joints(record.camera, group[identity], chosen)
                    rows += [(p, m < _AGREE_M, is_sure, identity) for p, m in zip(pixels, metres, strict=True)]
        if rows:
            values, agrees, sures, names = zip(*rows, strict=True)
            found[record.name] = Reprojection(
                np.array(values), np.array(agrees, bool), np.array(sures, bool), np.array(names)
            )
    return found


def match_people(camera: Camera, people: Mapping[str, Joints], puppets: list[Joints]) -> dict[str, int]:
    """Return which of the `puppets` in an image shows each of `people`: the nearest ones first, each once."""
    costs = []
    for identity, joints in people.items():
        for index, puppet in enumerate(puppets):
            metres = compare_joints(camera, joints, puppet)[1]
            if len(metres) and (median := float(np.median(metres))) < _MAX_MEDIAN_M:
                costs.append((median, identity, index))
    matched: dict[str, int] = {}
    for _, identity, index in sorted(costs):
        if identity not in matched and index not in matched.values():
            matched[identity] = index
    return matched


def compare_joints(camera: Camera, joints: Joints, puppet: Joints) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (N,) in px, and in m at the joints' depth, of the joints that both have."""
    names = [name for name in joints if name in puppet]
    if not names:
        return np.zeros(0), np.zeros(0)
    projected, depth = camera.project(np.stack([joints[name] for name in names]))
    pixels = np.linalg.norm(projected - np.stack([puppet[name] for name in names]), axis=1)
    known = np.isfinite(pixels)
    return pixels[known], (pixels * depth / camera.focal)[known]


def summarise_reprojection(found: Mapping[str, Reprojection]) -> dict[str, float]:
    """Return the figures of all cameras, by name; empty if there are none."""
    if not found:
        return {}
    every = Reprojection.join(found)
    sure = every.pixels[every.sure]
    return {
        "joints in space to puppets, mean px where they agree": every.mean_of_agreeing,
        "joints in space that agree, %": 100 * float(every.agrees.mean()),
        "joints in space to puppets, mean px where the puppets are sure": float(sure.mean()) if len(sure) else np.nan,
        "joints of which the puppets are sure, %": 100 * float(every.sure.mean()),
        "joints in space to puppets, median px of all": float(np.median(every.pixels)),
        "joints in space to puppets, mean px of all": float(every.pixels.mean()),
    }
