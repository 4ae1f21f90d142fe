# SPDX-License-Identifier: Apache-2.0
"""What pose estimation says of a person: the puppet of the best pose, its depth order, confidences and alternatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.image.pose.modes import PoseMode
from flowing_puppet_ros.image.pose.particle_search import SearchTarget
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order
from flowing_puppet_ros.model.ds.shape import PuppetShape, View

OUTSIDE = 0.1
"""Factor of a joint's confidence where the joint lies outside of the image."""

GUESSED = 0.05
"""Confidence, times the person's, of joints that nothing but the model placed."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedPuppet:
    """One person in one image, pixels of the image.

    `joints` (J, 2) in the order of the joint_names of `model`, `confidence` (J,) in [0, 1], `scale` px/m, `view` front
    or back, `contours` one (K_i, 2) a part, `depth` (P,) paint order of each part, 0 farthest, `energy` the negative
    log of the posterior (Eq. 15, up to a constant). Of `solutions` the first is this puppet and the others differ in
    the arms; `gender_probability` says how likely each of the models is that were to be compared.
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
    """How a person is seen: the models of each gender, front or back, the heading in radians, the parts in search.

    The heading is that of the mirror image where the camera sees the back; `side` is the index of the view where one
    of the nine views is used.
    """

    models: tuple[DeformableStructures, ...]
    view: View
    heading: float
    side: int | None
    parts: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """What a search found.

    `solutions` are in pixels of the image that was searched, the best first; `sure` (J,) is the confidence of the
    joints, 0 where nothing was searched; `size` (width, height) that of the image and `factor` its size in units of the
    given image, in whose pixels the answer is.
    """

    solutions: list[PoseMode]
    sure: Array
    person: SearchTarget
    seen: ViewHypothesis
    size: tuple[int, int]
    factor: float

    def drawn(self, identity: str, model: DeformableStructures, genders: dict[str, float]) -> PosedPuppet:
        """The puppet that `model`, which may have more parts than the search had, draws for the best solution."""
        best = self.solutions[0]
        shape = self.puppet(model, best)
        depth = np.argsort(depth_order(model, self.seen.view, self.seen.heading))
        placed = _rescaled(shape, self.factor)
        others = tuple(
            replace(
                one,
                joints=_unshrunk(self.puppet(model, one).joints, self.factor),
                scale=one.scale / self.factor,
            )
            for one in self.solutions
        )
        return PosedPuppet(
            identity, model.name, placed.joints, self._confidence(shape.joints), placed.scale, self.seen.view,
            best.energy, placed.contours, tuple(int(rank) for rank in depth), others, genders,
        )  # fmt: skip

    def puppet(self, model: DeformableStructures, solution: PoseMode) -> PuppetShape:
        """The likely puppet of a model on the joints of a solution, in pixels of the image that was searched."""
        return completed(model, solution.joints, (self.sure > 0).astype(float), solution.scale, self.seen.view)

    def _confidence(self, joints: Array) -> Array:
        """Confidence of the joints (J,2) of the model that draws, in [0, 1]."""
        confidence = np.full(len(joints), GUESSED)
        confidence[: len(self.sure)] = np.where(self.sure > 0, self.sure, GUESSED)
        inside = ((joints >= -0.5) & (joints <= np.array(self.size) - 0.5)).all(axis=1)
        return np.clip(confidence * self.person.found.confidence * np.where(inside, 1.0, OUTSIDE), 0.0, 1.0)


def completed(model: DeformableStructures, joints: Array, confidence: Array, scale: float, view: View) -> PuppetShape:
    """The likely puppet on joints (J,2) px of which some are NaN or have no confidence.

    The joints may be those of a puppet with fewer parts, whose names come first in this one's.
    """
    every = np.full((len(model.joint_names), 2), np.nan)
    every[: len(joints)] = joints
    known = np.zeros(len(every))
    known[: len(joints)] = confidence
    return model.puppet_from_joints(model.complete_joints(every, known, scale, view), scale, view)


def _unshrunk(points: Array, factor: float) -> Array:
    return np.asarray((points + 0.5) / factor - 0.5) if factor < 1.0 else points


def _rescaled(shape: PuppetShape, factor: float) -> PuppetShape:
    contours = tuple(_unshrunk(contour, factor) for contour in shape.contours)
    return replace(shape, joints=_unshrunk(shape.joints, factor), contours=contours, scale=shape.scale / factor)
