# SPDX-License-Identifier: Apache-2.0
"""Result of pose estimation for one person: the best puppet, its depth order, confidences and alternatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.modes import PoseMode
from flowing_puppet_ros.image.pose.particle_search import SearchTarget
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import PuppetShape, View

OUTSIDE_FACTOR = 0.1
"""Factor on the confidence of a joint that lies outside the image."""

GUESSED_CONFIDENCE = 0.05
"""Confidence, times the person's, of joints that the model alone placed."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedPuppet:
    """One person in one image, pixels of the image.

    Attributes:
        id: of the person.
        model: name of the model, which has the order of the joints.
        joints: (J, 2) px.
        confidence: (J,) in [0, 1].
        scale: px/m.
        view: front or back.
        energy: negative logarithm of the posterior in nats (Eq. 15, up to a constant).
        contours: (K_i, 2) px of each part.
        depth: (P,) paint order of each part, 0 is farthest.
        solutions: this puppet's pose first, then others that differ in the arms.
        gender_probability: of each of the models that were compared.
    """

    id: str
    model: str
    joints: Array
    confidence: Array
    scale: float
    view: View
    energy: float
    contours: tuple[Array, ...]
    depth: tuple[int, ...]
    solutions: tuple[PoseMode, ...]
    gender_probability: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class ViewHypothesis:
    """How a person is seen: the models of each gender, front or back, the heading in radians, the searched parts.

    The heading is that of the mirror image where the camera sees the back; `side` is the index of the view if one of
    the nine views is used, else None.
    """

    models: tuple[DeformableStructures, ...]
    view: View
    heading: float
    side: int | None
    parts: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PoseSearchResult:
    """The result of a search, in pixels of the searched image.

    Attributes:
        solutions: the poses, the best first.
        joint_confidence: (J,) in [0, 1], 0 where nothing was searched.
        target: the person.
        view_hypothesis: how the person is seen.
        size: (width, height) of the searched image.
        factor: size of the searched image in units of the given one, in whose pixels `draw` answers.
    """

    solutions: list[PoseMode]
    joint_confidence: Array
    target: SearchTarget
    view_hypothesis: ViewHypothesis
    size: tuple[int, int]
    factor: float

    def draw(self, identity: str, model: DeformableStructures, genders: dict[str, float]) -> PosedPuppet:
        """Draw the best solution with `model`, which may have more parts than the search had."""
        best = self.solutions[0]
        shape = self.make_puppet(model, best)
        depth = np.argsort(depth_order(model, self.view_hypothesis.view, self.view_hypothesis.heading))
        placed = _rescale(shape, self.factor)
        others = tuple(
            replace(
                one,
                joints=_to_given_image(self.make_puppet(model, one).joints, self.factor),
                scale=one.scale / self.factor,
            )
            for one in self.solutions
        )
        return PosedPuppet(
            identity, model.name, placed.joints, self._drawn_confidence(shape.joints), placed.scale,
            self.view_hypothesis.view, best.energy, placed.contours, tuple(int(rank) for rank in depth), others,
            genders,
        )  # fmt: skip

    def make_puppet(self, model: DeformableStructures, solution: PoseMode) -> PuppetShape:
        """Return the likely puppet of a model on the joints of a solution, in pixels of the searched image."""
        searched = (self.joint_confidence > 0).astype(float)
        return complete_puppet(model, solution.joints, searched, solution.scale, self.view_hypothesis.view)

    def _drawn_confidence(self, joints: Array) -> Array:
        """Return the confidence in [0, 1] of the joints (J, 2) of the drawing model."""
        confidence = np.full(len(joints), GUESSED_CONFIDENCE)
        own = self.joint_confidence
        confidence[: len(own)] = np.where(own > 0, own, GUESSED_CONFIDENCE)
        inside = ((joints >= -0.5) & (joints <= np.array(self.size) - 0.5)).all(axis=1)
        return np.clip(confidence * self.target.hypotheses.confidence * np.where(inside, 1.0, OUTSIDE_FACTOR), 0.0, 1.0)


def complete_puppet(
    model: DeformableStructures, joints: Array, confidence: Array, scale: float, view: View
) -> PuppetShape:
    """Return the likely puppet on `joints` (J, 2) px of which some are NaN or have no confidence.

    The joints may be those of a puppet with fewer parts, whose joint names come first in the model's.
    """
    every = np.full((len(model.joint_names), 2), np.nan)
    every[: len(joints)] = joints
    known = np.zeros(len(every))
    known[: len(joints)] = confidence
    return model.puppet_from_joints(model.complete_joints(every, known, scale, view), scale, view)


def _to_given_image(points: Array, factor: float) -> Array:
    return np.asarray((points + 0.5) / factor - 0.5) if factor < 1.0 else points


def _rescale(shape: PuppetShape, factor: float) -> PuppetShape:
    contours = tuple(_to_given_image(contour, factor) for contour in shape.contours)
    return replace(shape, joints=_to_given_image(shape.joints, factor), contours=contours, scale=shape.scale / factor)
