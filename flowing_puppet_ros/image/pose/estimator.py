# SPDX-License-Identifier: Apache-2.0
"""Pose of the people in one image: joints, part contours and diverse hypotheses of the arms.

Thesis, chapter "Human Pose Estimation from Single Images with the Deformable Structures Model". The detector, or
keypoints that the user supplies, locate the people; the particle search estimates their poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.ids import letters_of_seed
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.pose.evidence import KeypointPerson, LikelihoodLike, PersonHypotheses, PersonWindow
from flowing_puppet_ros.image.pose.modes import extract_modes, joint_confidence, select_parts
from flowing_puppet_ros.image.pose.particle_search import PoseSearch, SearchTarget
from flowing_puppet_ros.image.pose.particles import PartParticles, clip_shape, particles_from_puppets
from flowing_puppet_ros.image.pose.result import PosedPuppet, PoseSearchResult, ViewHypothesis, complete_puppet
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.images import as_image, as_rgb
from flowing_puppet_ros.model.ds.multiview import VIEW_HEADINGS, VIEW_NAMES, MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View
from flowing_puppet_ros.process.threads import one_blas_thread

VIEW_CONFIDENCE_FACTOR = 0.3
"""Factor on the confidence of detected joints when the view is estimated: detectors err more than the model."""

MIN_KEYPOINTS = 3  # joints that keypoints must give for a person to be estimated


class PoseDetectorLike(Protocol):
    """A detector of people in an image (H, W, 3) RGB uint8."""

    def detect(self, image: Array) -> Sequence[PersonHypotheses]:
        """Return the people, most confident first."""
        ...


class PoseEstimator:
    """Estimator of the poses of the people in an image; one instance serves any number of images."""

    def __init__(
        self,
        models: Sequence[DeformableStructures],
        detector: PoseDetectorLike | None,
        likelihood: LikelihoodLike | None,
        settings: PoseSettings | None = None,
        side_models: Sequence[MultiViewStructures] = (),
        drawing_models: Sequence[MultiViewStructures] = (),
    ) -> None:
        """Prepare the search.

        Args:
            models: puppets with the same number of parts; the first is searched, the most probable one is returned.
            detector: needed for images without keypoints.
            likelihood: contour and colour; None scores by the detector and the body model alone.
            settings: the defaults when None.
            side_models: for each of `models` its nine views, used for people seen from the side.
            drawing_models: for each of `models` one with more parts, such as hands and feet, to draw the result with.
        """
        self._front = tuple(models)
        self._side_models = tuple(side_models)
        self._drawing_models = tuple(drawing_models)
        self._detector = detector
        self._likelihood = likelihood
        self._settings = settings or PoseSettings()
        self._searches: dict[tuple[DeformableStructures, tuple[int, ...]], PoseSearch] = {}

    def estimate(self, image: Array, keypoints: Sequence[Keypoints] | None = None) -> list[PosedPuppet]:
        """Estimate the poses of the people in an image (H, W, 3) RGB or (H, W) grey uint8, in its pixels.

        `keypoints` of people, if given, replace the detector. The list is empty when no one is found. InputError when
        the array is not an image, or when there are neither keypoints nor a detector.
        """
        image = as_image(image)
        if keypoints is None and self._detector is None:
            raise InputError("without a detector the pose needs keypoints of the people; pass one of them")
        factor = min(1.0, self._settings.max_side / max(image.shape[:2]))
        if factor < 1.0:
            height, width = np.maximum(np.rint(np.array(image.shape[:2]) * factor), 1).astype(int)
            image = cv2.resize(image, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        colour = as_rgb(image)
        # Sums of several BLAS threads would differ in their last bits.
        with one_blas_thread():
            found = self._find_people(colour, keypoints, factor)
            posed = [self._estimate_person(colour, one, index, factor) for index, one in enumerate(found)]
        return [one for one in posed if one is not None]

    def _find_people(
        self, image: Array, keypoints: Sequence[Keypoints] | None, factor: float
    ) -> Sequence[PersonHypotheses]:
        if keypoints is None:
            assert self._detector is not None
            found = self._detector.detect(image)
            return [one for turn, one in enumerate(found) if turn == 0 or one.confidence >= self._settings.others]
        model = self._front[0]
        people: list[PersonHypotheses] = []
        for one in keypoints:
            scaled = replace(one, xy=(one.xy + 0.5) * factor - 0.5)
            joints, confidence = joints_from_keypoints(model, scaled)
            if np.isfinite(joints).all(axis=1).sum() < MIN_KEYPOINTS:
                continue
            try:
                scale = model.estimate_scale(joints, confidence)
            except InputError:
                continue
            people.append(
                KeypointPerson(Keypoints(model.joint_names, joints, confidence), model.shoulder_width * scale)
            )
        return people

    def _estimate_person(self, image: Array, found: PersonHypotheses, index: int, factor: float) -> PosedPuppet | None:
        """Estimate one person's pose; None when the joints give no scale. `factor` is that of the reduced image."""
        rng = np.random.default_rng([self._settings.seed, index])
        try:
            joints, confidence = joints_from_keypoints(self._front[0], found.keypoints)
            view = self._front[0].estimate_view(joints, confidence)
            models, side = self._choose_view(joints, confidence, view)
            scale = models[0].estimate_scale(joints, confidence)
        except InputError:
            return None
        model = models[0]
        window = None if self._likelihood is None else PersonWindow.around(self._likelihood, image, joints, scale)
        target = SearchTarget(window, found, scale, np.array([1.0 if view == "front" else -1.0, 1.0]))
        heading = 0.0 if side is None else VIEW_HEADINGS[side]
        parts = select_parts(model, np.isfinite(joints).all(axis=1))
        view_hypothesis = ViewHypothesis(models, view, heading, side, parts)
        search = self._search_for(model, parts)
        start = self._initialise_particles(model, search, target, view, rng)
        target = self._add_colour_evidence(search, start, target)
        scored, marginals = search.run(start, target, rng)
        solutions = extract_modes(model, search, scored, target, self._settings.solutions)
        confidences = joint_confidence(model, search, scored, marginals, target, solutions[0].joints)
        result = PoseSearchResult(
            solutions, confidences, target, view_hypothesis, (image.shape[1], image.shape[0]), factor
        )
        return self._draw_result(result, letters_of_seed(self._settings.seed) + str(index + 1))

    def _draw_result(self, result: PoseSearchResult, identity: str) -> PosedPuppet:
        """Return the puppet of the most probable gender."""
        view = result.view_hypothesis
        probability = self._gender_probabilities(result)
        chosen = int(probability.argmax())
        drawing = view.models[chosen]
        if self._drawing_models:
            drawing = self._drawing_models[chosen].views[len(VIEW_NAMES) // 2 if view.side is None else view.side]
        genders = {one.gender: float(value) for one, value in zip(view.models, probability, strict=True)}
        return result.draw(identity, drawing, genders)

    def _gender_probabilities(self, result: PoseSearchResult) -> Array:
        """Return the probability of each model, by the energy of its puppet on the best pose."""
        view, target = result.view_hypothesis, result.target
        energies = np.zeros(len(view.models))
        for row, model in enumerate(view.models if len(view.models) > 1 else ()):
            particles = particles_from_puppets(
                [result.make_puppet(model, result.solutions[0])], model.bone, target.mirror
            )
            energies[row] = self._search_for(model, view.parts).energy(particles, target)
        weight = np.exp(energies.min() - energies)
        return np.asarray(weight / weight.sum())

    def _choose_view(
        self, joints: Array, confidence: Array, view: View
    ) -> tuple[tuple[DeformableStructures, ...], int | None]:
        """Return the models for the side from which a person is seen, and the index of the view.

        The frontal models and None, unless the joints (J, 2) are far more probable from a side.
        """
        if not self._side_models:
            return self._front, None
        mirror = np.array([1.0 if view == "front" else -1.0, 1.0])
        probability = self._side_models[0].posterior(joints * mirror, confidence * VIEW_CONFIDENCE_FACTOR)
        best = self._side_models[0].find_side(probability)
        if best is None:
            return self._front, None
        return tuple(side.views[best] for side in self._side_models), best

    def _search_for(self, model: DeformableStructures, parts: tuple[int, ...]) -> PoseSearch:
        key = model, parts
        if key not in self._searches:
            self._searches[key] = PoseSearch(model, parts, self._settings)
        return self._searches[key]

    def _initialise_particles(
        self,
        model: DeformableStructures,
        search: PoseSearch,
        target: SearchTarget,
        view: View,
        rng: np.random.Generator,
    ) -> list[PartParticles]:
        """Return the first particles: the detector's poses with their likely shapes, and copies with random shapes."""
        puppets = []
        for keypoints, _ in target.hypotheses.modes(self._settings.modes):
            joints, confidence = joints_from_keypoints(model, keypoints)
            puppets.append(complete_puppet(model, joints, confidence, target.scale, view))
        particles = particles_from_puppets(puppets, model.bone, target.mirror)
        groups = []
        for part in search.parts:
            likely = particles[part]
            likely = PartParticles(likely.center, likely.angle, likely.scale, clip_shape(likely.shape))
            copies = likely.take(rng.integers(len(likely), size=self._settings.particles))
            shapes = clip_shape(copies.shape + 0.5 * rng.standard_normal(copies.shape.shape))
            groups.append(
                PartParticles.join([likely, PartParticles(copies.center, copies.angle, copies.scale, shapes)])
            )
        return groups

    def _add_colour_evidence(
        self, search: PoseSearch, start: list[PartParticles], target: SearchTarget
    ) -> SearchTarget:
        """Add the colours of the torso and the head that a first max-product finds to the person's evidence."""
        if target.window is None or "head" not in search.tree.names or not self._settings.likelihood:
            return target
        torso, head = search.find_best_contours(start, target, ("torso", "head"))
        return replace(target, window=target.window.with_torso(torso, head))
