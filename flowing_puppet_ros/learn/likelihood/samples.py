# SPDX-License-Identifier: Apache-2.0
"""Right and wrong contours in annotated images: puppets on the annotated joints, and perturbed ones."""

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

MIN_WRONG_DISTANCE_M = 0.05
"""A contour is wrong if its points are displaced by more than this on average."""

MIN_CONFIDENCE = 0.4
"""Limbs with joints below this confidence are not learned from."""

_MIN_SHARE_IN_IMAGE = 0.6  # of a contour's points; parts with less in the image are not learned from


@dataclass(frozen=True, slots=True)
class ContourPerturbation:
    """How right contours are perturbed into wrong ones: standard deviations.

    Attributes:
        angle: radians, of the rotation about the proximal joint.
        shift: metres, along each axis.
        stretch: of the logarithm of the length.
        far: share of contours that are put anywhere near the person, at any angle, instead.
    """

    angle: float = np.deg2rad(35.0)
    shift: float = 0.07
    stretch: float = 0.2
    far: float = 0.0


FAR_DEVIATION_M = 0.4  # along each axis, of contours put anywhere


@dataclass(frozen=True, slots=True, eq=False)
class PosedPerson:
    """A person in an image.

    Attributes:
        file: where the image is from.
        image: (H, W, 3) uint8 RGB.
        puppet: the puppet on the annotated joints.
        confidence: (J,) of the joints.
        previous_image: the image before it in the video; None for first images, for stills, and if not asked for.
    """

    file: str
    image: U8
    puppet: PuppetShape
    confidence: Array
    previous_image: U8 | None = None

    def shows(self, model: DeformableStructures, part: int) -> bool:
        """Return whether a part is in the image and its joints are reliable enough to learn from."""
        height, width = self.image.shape[:2]
        inside = (self.puppet.contours[part] >= 0) & (self.puppet.contours[part] < (width, height))
        sure = part == 0 or self.confidence[list(model.part_joints[part][:2])].min() >= MIN_CONFIDENCE
        return bool(sure and inside.all(axis=1).mean() >= _MIN_SHARE_IN_IMAGE)


def pose_people(
    annotations: Annotations, model: DeformableStructures, every: int, with_previous: bool = False
) -> Iterator[PosedPerson]:
    """Yield the puppets of all people whose scale is known, in the order of the frames."""
    for frame in annotations.read_frames(every):
        for person in frame.people:
            posed = _pose(model, person)
            if posed is not None:
                yield PosedPerson(frame.file, frame.image, *posed, frame.previous if with_previous else None)


def _pose(model: DeformableStructures, person: AnnotatedPerson) -> tuple[PuppetShape, Array] | None:
    joints, confidence = joints_from_keypoints(model, person.keypoints)
    try:
        scale = model.estimate_scale(joints, confidence)
    except InputError:
        return None
    view = person.view or model.estimate_view(joints, confidence)
    joints = model.complete_joints(joints, confidence, scale, view)
    return model.puppet_from_joints(joints, scale, view), confidence


def perturb_contours(
    model: DeformableStructures,
    puppet: PuppetShape,
    part: int,
    count: int,
    perturbation: ContourPerturbation,
    rng: np.random.Generator,
) -> F64:
    """Rotate, shift and stretch a part until it is wrong by MIN_WRONG_DISTANCE_M; return (count, K, 2) px."""
    contour, scale = puppet.contours[part], puppet.scale
    proximal, distal = puppet.joints[list(model.part_joints[part][:2])]
    length = max(float(np.hypot(*(distal - proximal))), np.finfo(float).tiny)
    sine, cosine = (distal - proximal)[::-1] / length
    local = rotate(contour - proximal, -sine, cosine)
    found: list[Array] = []
    while len(found) < count:
        far = rng.random() < perturbation.far
        turn = rng.uniform(-np.pi, np.pi) if far else rng.normal(0.0, perturbation.angle)
        shift = scale * rng.normal(0.0, FAR_DEVIATION_M if far else perturbation.shift, 2)
        stretch = np.exp(rng.normal(0.0, perturbation.stretch))
        moved = rotate(rotate(local * (stretch, 1.0), sine, cosine), np.sin(turn), np.cos(turn)) + proximal + shift
        if np.hypot(*(moved - contour).T).mean() > MIN_WRONG_DISTANCE_M * scale:
            found.append(moved)
    return np.array(found)
