# SPDX-License-Identifier: Apache-2.0
"""Pose of the people in one image: joints, part contours and diverse hypotheses of the arms.

Thesis, chapter "Human Pose Estimation from Single Images with the Deformable Structures Model". The detector, or
keypoints that the user has, say where people are; the particle search does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.pose.evidence import KeypointPerson, LikelihoodLike, PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.pose.modes import extract_modes, joint_confidence, searched_parts
from flowing_puppet_ros.image.pose.particle_search import PoseSearch, SearchTarget
from flowing_puppet_ros.image.pose.particles import Particles, clip_shape, particles_of
from flowing_puppet_ros.image.pose.result import PosedPuppet, SearchResult, ViewHypothesis, completed
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

SURELY_SIDEWAYS = 0.97
"""Probability of not facing the camera from which a model of another view is taken."""

DETECTION_TRUST = 0.3
"""Factor of the confidence of detected joints when they tell the view: detectors err more than the model's noise."""

LEAST_KEYPOINTS = 3


class PoseDetectorLike(Protocol):
    """What finds people in an image (H,W,3) RGB uint8, the surest first."""

    def detect(self, image: Array) -> Sequence[PersonHypotheses]:
        """The people."""
        ...


class PoseEstimator:
    """Finds the people of an image and their poses; one instance serves any number of images."""

    def __init__(
        self,
        models: Sequence[DeformableStructures],
        detector: PoseDetectorLike | None,
        likelihood: LikelihoodLike | None,
        settings: PoseSettings | None = None,
        sides: Sequence[MultiViewStructures] = (),
        drawn: Sequence[MultiViewStructures] = (),
    ) -> None:
        """Prepare the search.

        Args:
            models: puppets of one number of parts; the search uses the first and the answer is the most probable one.
            detector: needed for images without keypoints.
            likelihood: contour and colour; None judges by the detector and the body model alone.
            settings: the defaults when None.
            sides: for each of `models` the one of nine views, which takes its place for people seen from the side.
            drawn: for each of `models` one with more parts, such as hands and feet, that draws the answer.
        """
        self._front = tuple(models)
        self._sides = tuple(sides)
        self._drawn = tuple(drawn)
        self._detector = detector
        self._likelihood = likelihood
        self._settings = settings or PoseSettings()
        self._searches: dict[tuple[DeformableStructures, tuple[int, ...]], PoseSearch] = {}

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
        with one_blas_thread():
            found = self._found(colour, keypoints, factor)
            posed = [self._pose(colour, one, index, factor) for index, one in enumerate(found)]
        return [one for one in posed if one is not None]

    def _found(self, image: Array, keypoints: Sequence[Keypoints] | None, factor: float) -> Sequence[PersonHypotheses]:
        if keypoints is None:
            assert self._detector is not None
            found = self._detector.detect(np.ascontiguousarray(image))
            return [one for turn, one in enumerate(found) if turn == 0 or one.confidence >= self._settings.others]
        model = self._front[0]
        people: list[PersonHypotheses] = []
        for one in keypoints:
            placed = replace(one, xy=(one.xy + 0.5) * factor - 0.5)
            joints, confidence = joints_from_keypoints(model, placed)
            if np.isfinite(joints).all(axis=1).sum() < LEAST_KEYPOINTS:
                continue
            try:
                scale = model.estimate_scale(joints, confidence)
            except InputError:
                continue
            people.append(
                KeypointPerson(Keypoints(model.joint_names, joints, confidence), model.shoulder_width * scale)
            )
        return people

    def _pose(self, image: Array, found: PersonHypotheses, index: int, factor: float) -> PosedPuppet | None:
        """The pose of one person, or None when the detection tells no scale; `factor` is that of the shrunk image."""
        rng = np.random.default_rng([self._settings.seed, index])
        try:
            joints, confidence = joints_from_keypoints(self._front[0], found.keypoints)
            view = self._front[0].estimate_view(joints, confidence)
            models, side = self._turned(joints, confidence, view)
            scale = models[0].estimate_scale(joints, confidence)
        except InputError:
            return None
        model = models[0]
        scene = None if self._likelihood is None else PersonWindow.around(self._likelihood, image, joints, scale)
        person = SearchTarget(scene, found, scale, np.array([1.0 if view == "front" else -1.0, 1.0]))
        heading = 0.0 if side is None else VIEW_HEADINGS[side]
        seen = ViewHypothesis(models, view, heading, side, searched_parts(model, np.isfinite(joints).all(axis=1)))
        search = self._search(model, seen.parts)
        start = self._start(model, search, person, view, rng)
        person = self._coloured(search, start, person)
        judged, result = search.run(start, person, rng)
        solutions = extract_modes(model, search, judged, person, self._settings.solutions)
        sure = joint_confidence(model, search, judged, result, person, solutions[0].joints)
        outcome = SearchResult(solutions, sure, person, seen, (image.shape[1], image.shape[0]), factor)
        return self._answer(outcome, letters_of_seed(self._settings.seed) + str(index + 1))

    def _answer(self, outcome: SearchResult, identity: str) -> PosedPuppet:
        """The puppet of the most probable gender."""
        seen = outcome.seen
        probability = self._genders(outcome)
        chosen = int(probability.argmax())
        drawing = seen.models[chosen]
        if self._drawn:
            drawing = self._drawn[chosen].views[len(VIEW_NAMES) // 2 if seen.side is None else seen.side]
        genders = {one.gender: float(value) for one, value in zip(seen.models, probability, strict=True)}
        return outcome.drawn(identity, drawing, genders)

    def _genders(self, outcome: SearchResult) -> Array:
        """Probability of each model, by the energy of its puppet on the best pose."""
        seen, person = outcome.seen, outcome.person
        energies = np.zeros(len(seen.models))
        for row, model in enumerate(seen.models if len(seen.models) > 1 else ()):
            particles = particles_of([outcome.puppet(model, outcome.solutions[0])], model.bone, person.mirror)
            energies[row] = self._search(model, seen.parts).energy(particles, person)
        weight = np.exp(energies.min() - energies)
        return np.asarray(weight / weight.sum())

    def _turned(
        self, joints: Array, confidence: Array, view: View
    ) -> tuple[tuple[DeformableStructures, ...], int | None]:
        """The models for the side from which a person is seen, and the index of the view.

        The models near the front and None, unless the joints (J,2) are far more probable from a side.
        """
        if not self._sides:
            return self._front, None
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        probability = self._sides[0].posterior(joints * mirror, confidence * DETECTION_TRUST)
        best = int(probability.argmax())
        middle = len(probability) // 2
        if probability[middle - 1 : middle + 2].sum() > 1.0 - SURELY_SIDEWAYS:
            return self._front, None
        return tuple(side.views[best] for side in self._sides), best

    def _search(self, model: DeformableStructures, parts: tuple[int, ...]) -> PoseSearch:
        key = model, parts
        if key not in self._searches:
            self._searches[key] = PoseSearch(model, parts, self._settings)
        return self._searches[key]

    def _start(
        self,
        model: DeformableStructures,
        search: PoseSearch,
        person: SearchTarget,
        view: View,
        rng: np.random.Generator,
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
            likely = Particles(likely.center, likely.angle, likely.scale, clip_shape(likely.shape))
            copies = likely.take(rng.integers(len(likely), size=self._settings.particles))
            drawn = clip_shape(copies.shape + 0.5 * rng.standard_normal(copies.shape.shape))
            groups.append(Particles.join([likely, Particles(copies.center, copies.angle, copies.scale, drawn)]))
        return groups

    def _coloured(self, search: PoseSearch, start: list[Particles], person: SearchTarget) -> SearchTarget:
        """The person whose evidence also knows the colours of the torso and the head that a first max-product finds."""
        if person.scene is None or "head" not in search.tree.names or not self._settings.likelihood:
            return person
        torso, head = search.best_contours(start, person, ("torso", "head"))
        return replace(person, scene=person.scene.with_torso(torso, head))
