# SPDX-License-Identifier: Apache-2.0
"""Right and wrong contours on annotated images: puppets that stand on the joints, and the same ones moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64, U8, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.annotations import AnnotatedPerson, Annotations
from flowing_puppet_ros.image.formats.keypoints import joints_from_keypoints
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PuppetShape, rotate

WRONG_METRES = 0.05
"""A contour is wrong when its points are moved by more than this on average."""

SUREST = 0.4
"""Limbs whose joints have less confidence are not learned from."""

_IN_IMAGE = 0.6  # of a contour's points; parts that show less are not learned from


@dataclass(frozen=True, slots=True)
class Moves:
    """How right contours are moved to make wrong ones; standard deviations, metres and radians.

    angle: of the turn around the proximal joint. shift: along each axis. stretch: of the logarithm of the length.
    far: share that is put anywhere near the person at any angle instead.
    """

    angle: float = np.deg2rad(35.0)
    shift: float = 0.07
    stretch: float = 0.2
    far: float = 0.0


FAR_METRES = 0.4  # standard deviation, along each axis, of contours put anywhere


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """A person in an image (H,W,3) RGB uint8 of `file`: the puppet, and the confidence (J,) of its joints.

    `before` is the image before it in the video, None of the first, of still images and where it is not wanted.
    """

    file: str
    image: U8
    puppet: PuppetShape
    confidence: Array
    before: U8 | None = None

    def shows(self, model: DeformableStructures, part: int) -> bool:
        """Tell whether a part is in the image and its joints are known well enough to learn from it."""
        height, width = self.image.shape[:2]
        inside = (self.puppet.contours[part] >= 0) & (self.puppet.contours[part] < (width, height))
        sure = part == 0 or self.confidence[list(model.part_joints[part][:2])].min() >= SUREST
        return bool(sure and inside.all(axis=1).mean() >= _IN_IMAGE)


def posed_people(
    annotations: Annotations, model: DeformableStructures, every: int, with_before: bool = False
) -> Iterator[Posed]:
    """Yield the puppets of all people of whom a scale can be told, in the order of the frames."""
    for frame in annotations.frames(every):
        for person in frame.people:
            posed = _pose(model, person)
            if posed is not None:
                yield Posed(frame.file, frame.image, *posed, frame.before if with_before else None)


def _pose(model: DeformableStructures, person: AnnotatedPerson) -> tuple[PuppetShape, Array] | None:
    joints, confidence = joints_from_keypoints(model, person.keypoints)
    try:
        scale = model.estimate_scale(joints, confidence)
    except InputError:
        return None
    view = person.view or model.estimate_view(joints, confidence)
    joints = model.complete_joints(joints, confidence, scale, view)
    return model.puppet_from_joints(joints, scale, view), confidence


def wrong_contours(
    model: DeformableStructures, puppet: PuppetShape, part: int, count: int, moves: Moves, rng: np.random.Generator
) -> F64:
    """Contours (count,K,2) px of a part that is turned, moved and stretched until it is wrong by WRONG_METRES."""
    contour, scale = puppet.contours[part], puppet.scale
    proximal, distal = puppet.joints[list(model.part_joints[part][:2])]
    length = max(float(np.hypot(*(distal - proximal))), np.finfo(float).tiny)
    sine, cosine = (distal - proximal)[::-1] / length
    local = rotate(contour - proximal, -sine, cosine)
    found: list[Array] = []
    while len(found) < count:
        far = rng.random() < moves.far
        turn = rng.uniform(-np.pi, np.pi) if far else rng.normal(0.0, moves.angle)
        shift = scale * rng.normal(0.0, FAR_METRES if far else moves.shift, 2)
        stretch = np.exp(rng.normal(0.0, moves.stretch))
        moved = rotate(rotate(local * (stretch, 1.0), sine, cosine), np.sin(turn), np.cos(turn)) + proximal + shift
        if np.hypot(*(moved - contour).T).mean() > WRONG_METRES * scale:
            found.append(moved)
    return np.array(found)
