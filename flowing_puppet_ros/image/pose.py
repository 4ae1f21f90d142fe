# SPDX-License-Identifier: Apache-2.0
"""Pose of the people in one image: joints, part contours and diverse hypotheses of the arms.

Thesis, chapter "Human Pose Estimation from Single Images with the Deformable Structures Model". The detector, or
keypoints that the user has, say where people are; the particle search does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.pose_evidence import Found, GivenPerson, Likelihood, Window
from flowing_puppet_ros.image.pose_parts import Particles, limited, particles_of
from flowing_puppet_ros.image.pose_search import Person, PoseSearch
from flowing_puppet_ros.image.pose_settings import PoseSettings
from flowing_puppet_ros.image.pose_solutions import Solution, joint_confidence, searched_parts, solutions_of
from flowing_puppet_ros.image.tracker import letters
from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_multiview import VIEW_HEADINGS, MultiViewStructures
from flowing_puppet_ros.model.ds_render import depth_order
from flowing_puppet_ros.model.ds_shape import PuppetShape, View

Array = np.ndarray[Any, Any]

OUTSIDE = 0.1
"""Factor of a joint's confidence where the joint lies outside of the image."""

GUESSED = 0.05
"""Confidence, times the person's, of joints that nothing but the model placed."""

SURELY_SIDEWAYS = 0.97
"""Probability of not facing the camera from which a model of another view is taken."""

DETECTION_TRUST = 0.3
"""Factor of the confidence of detected joints when they tell the view: detectors err more than the model's noise."""

LEAST_KEYPOINTS = 3


class Detector(Protocol):
    """What finds people in an image (H,W,3) RGB uint8, the surest first."""

    def detect(self, image: Array) -> Sequence[Found]:
        """The people."""
        ...


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
    solutions: tuple[Solution, ...]
    gender_probability: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """How a person is seen: the models of each gender, front or back, the heading in radians, the parts in search.

    The heading is that of the mirror image where the camera sees the back.
    """

    models: tuple[DeformableStructures, ...]
    view: View
    heading: float
    parts: tuple[int, ...]


class PoseEstimator:
    """Finds the people of an image and their poses; one instance serves any number of images."""

    def __init__(
        self,
        models: Sequence[DeformableStructures],
        detector: Detector | None,
        likelihood: Likelihood | None,
        settings: PoseSettings | None = None,
        sides: Sequence[MultiViewStructures] = (),
    ) -> None:
        """Prepare the search.

        Args:
            models: puppets of one number of parts; the search uses the first and the answer is the most probable one.
            detector: needed for images without keypoints.
            likelihood: contour and colour; None judges by the detector and the body model alone.
            settings: the defaults when None.
            sides: for each of `models` the one of nine views, which takes its place for people seen from the side.
        """
        self._front = tuple(models)
        self._sides = tuple(sides)
        self._detector = detector
        self._likelihood = likelihood
        self._settings = settings or PoseSettings()
        self._searches: dict[tuple[int, tuple[int, ...]], PoseSearch] = {}

    def estimate(self, image: Array, keypoints: Sequence[Keypoints] | None = None) -> list[PosedPuppet]:
        """The people in an image (H,W,3) RGB or (H,W) grey uint8, in its pixels.

        `keypoints` of people, where they are known, stand in for the detector. An empty list when nobody is found.
        InputError when the array is no image, or without both keypoints and detector.
        """
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or 0 in image.shape or image.shape[2:] not in ((), (3,)):
            raise InputError(f"an image must be (H,W) or (H,W,3) uint8, this one is {image.shape} {image.dtype}")
        if keypoints is None and self._detector is None:
            raise InputError("without a detector the pose needs keypoints of the people")
        factor = min(1.0, self._settings.longest_side / max(image.shape[:2]))
        if factor < 1.0:
            height, width = np.maximum(np.rint(np.array(image.shape[:2]) * factor), 1).astype(int)
            image = cv2.resize(image, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        colour = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
        # Sums of several BLAS threads would differ in their last bits.
        with threadpool_limits(1):
            found = self._found(colour, keypoints, factor)
            posed = [self._pose(colour, one, index, factor) for index, one in enumerate(found)]
        return [one for one in posed if one is not None]

    def _found(self, image: Array, keypoints: Sequence[Keypoints] | None, factor: float) -> Sequence[Found]:
        if keypoints is None:
            assert self._detector is not None
            return self._detector.detect(np.ascontiguousarray(image))
        model = self._front[0]
        width = np.ptp(model.mean_joints()[[model.joint_names.index(f"{s}_shoulder") for s in ("left", "right")], 0])
        people: list[Found] = []
        for one in keypoints:
            placed = replace(one, xy=(one.xy + 0.5) * factor - 0.5)
            joints, confidence = joints_from_keypoints(model, placed)
            if np.isfinite(joints).all(axis=1).sum() < LEAST_KEYPOINTS:
                continue
            try:
                scale = model.estimate_scale(joints, confidence)
            except InputError:
                continue
            people.append(GivenPerson(Keypoints(model.joint_names, joints, confidence), width * scale))
        return people

    def _pose(self, image: Array, found: Found, index: int, factor: float) -> PosedPuppet | None:
        """The pose of one person, or None when the detection tells no scale; `factor` is that of the shrunk image."""
        rng = np.random.default_rng([self._settings.seed, index])
        try:
            joints, confidence = joints_from_keypoints(self._front[0], found.keypoints)
            view = self._front[0].estimate_view(joints, confidence)
            models, heading = self._turned(joints, confidence, view)
            scale = models[0].estimate_scale(joints, confidence)
        except InputError:
            return None
        model = models[0]
        scene = None if self._likelihood is None else Window.around(self._likelihood, image, joints, scale)
        person = Person(scene, found, scale, np.array([1.0 if view == "front" else -1.0, 1.0]))
        seen = Seen(models, view, heading, searched_parts(model, np.isfinite(joints).all(axis=1)))
        search = self._search(model, seen.parts)
        start = self._start(model, search, person, view, rng)
        person = self._coloured(search, start, person)
        judged, result = search.run(start, person, rng)
        solutions = solutions_of(model, search, judged, person, self._settings.solutions)
        best = solutions[0].joints
        sure = joint_confidence(model, search, judged, result, person, best)
        return self._answer(image, solutions, sure, person, seen, index, factor)

    def _turned(self, joints: Array, confidence: Array, view: View) -> tuple[tuple[DeformableStructures, ...], float]:
        """The models for the side from which a person is seen, and the person's heading in radians.

        The models near the front, unless the joints (J,2) are far more probable from a side.
        """
        if not self._sides:
            return self._front, 0.0
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        probability = self._sides[0].posterior(joints * mirror, confidence * DETECTION_TRUST)
        best = int(probability.argmax())
        middle = len(probability) // 2
        if probability[middle - 1 : middle + 2].sum() > 1.0 - SURELY_SIDEWAYS:
            return self._front, 0.0
        return tuple(side.views[best] for side in self._sides), VIEW_HEADINGS[best]

    def _search(self, model: DeformableStructures, parts: tuple[int, ...]) -> PoseSearch:
        key = id(model), parts
        if key not in self._searches:
            self._searches[key] = PoseSearch(model, parts, self._settings)
        return self._searches[key]

    def _start(
        self, model: DeformableStructures, search: PoseSearch, person: Person, view: View, rng: np.random.Generator
    ) -> list[Particles]:
        """First particles: the detector's poses with their likely shapes, and copies of them with random shapes."""
        puppets = []
        for keypoints, _ in person.found.modes(self._settings.modes):
            joints, confidence = joints_from_keypoints(model, keypoints)
            puppets.append(completed(model, joints, confidence, person.scale, view))
        everything = particles_of(puppets, model.bone, person.mirror)
        groups = []
        for part in search.parts:
            likely = everything[part]
            likely = Particles(likely.center, likely.angle, likely.scale, limited(likely.shape))
            copies = likely.take(rng.integers(len(likely), size=self._settings.particles))
            drawn = limited(copies.shape + 0.5 * rng.standard_normal(copies.shape.shape))
            groups.append(Particles.join([likely, Particles(copies.center, copies.angle, copies.scale, drawn)]))
        return groups

    def _coloured(self, search: PoseSearch, start: list[Particles], person: Person) -> Person:
        """The person whose evidence also knows the colours of the torso and the head that a first max-product finds."""
        if person.scene is None or "head" not in search.tree.names or not self._settings.likelihood:
            return person
        torso, head = search.best_contours(start, person, ("torso", "head"))
        return replace(person, scene=person.scene.with_torso(torso, head))

    def _answer(
        self,
        image: Array,
        solutions: list[Solution],
        sure: Array,
        person: Person,
        seen: Seen,
        index: int,
        factor: float,
    ) -> PosedPuppet:
        best = solutions[0]
        known = (sure > 0).astype(float)
        shapes = [completed(model, best.joints, known, best.scale, seen.view) for model in seen.models]
        energies = np.array(
            [
                self._search(model, seen.parts).energy(particles_of([shape], model.bone, person.mirror), person)
                for model, shape in zip(seen.models, shapes, strict=True)
            ]
        )
        probability = np.exp(energies.min() - energies) / np.exp(energies.min() - energies).sum()
        chosen = int(probability.argmax())
        model, shape = seen.models[chosen], shapes[chosen]
        size = np.array(image.shape[1::-1])
        inside = ((shape.joints >= -0.5) & (shape.joints <= size - 0.5)).all(axis=1)
        confidence = np.where(sure > 0, sure, GUESSED) * person.found.confidence * np.where(inside, 1.0, OUTSIDE)
        order = depth_order(model, seen.view, seen.heading)
        depth = tuple(int(rank) for rank in np.argsort(order))
        placed = _rescaled(shape, factor)
        others = tuple(
            Solution(
                _unshrunk(completed(model, one.joints, known, one.scale, seen.view).joints, factor),
                one.energy,
                one.scale / factor,
            )
            for one in solutions
        )
        genders = {one.gender: float(value) for one, value in zip(seen.models, probability, strict=True)}
        identity = letters(self._settings.seed) + str(index + 1)
        return PosedPuppet(
            identity, model.name, placed.joints, np.clip(confidence, 0.0, 1.0), placed.scale, seen.view, best.energy,
            placed.contours, depth, others, genders,
        )  # fmt: skip


def completed(model: DeformableStructures, joints: Array, confidence: Array, scale: float, view: View) -> PuppetShape:
    """The likely puppet on joints (J,2) px of which some are NaN or have no confidence."""
    filled = model.complete_joints(joints, confidence, scale, view)
    return model.puppet_from_joints(filled, scale, view)


def _unshrunk(points: Array, factor: float) -> Array:
    return np.asarray((points + 0.5) / factor - 0.5) if factor < 1.0 else points


def _rescaled(shape: PuppetShape, factor: float) -> PuppetShape:
    contours = tuple(_unshrunk(contour, factor) for contour in shape.contours)
    return replace(shape, joints=_unshrunk(shape.joints, factor), contours=contours, scale=shape.scale / factor)
