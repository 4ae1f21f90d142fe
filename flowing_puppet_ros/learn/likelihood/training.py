# SPDX-License-Identifier: Apache-2.0
"""Learn the image likelihood of a puppet's parts from annotated images (thesis, "Likelihood", Eqs. 20 to 22)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.svm import LinearSVC

from flowing_puppet_ros.arrays import F32, F64, Array, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.colour import BINS, ColourImage, SkinColour, face_of, histogram_of, log_ratio
from flowing_puppet_ros.evidence.image.contour import (
    PLACES,
    ContourFilter,
    ContourLikelihood,
    describe,
    kind_of,
    on_right,
)
from flowing_puppet_ros.evidence.image.likelihood import TERMS_OF, PartLikelihood
from flowing_puppet_ros.evidence.image.outline import mirrored_order
from flowing_puppet_ros.image.formats.annotations import source_of
from flowing_puppet_ros.learn.likelihood.samples import Moves, Posed, wrong_contours
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import render_labels
from flowing_puppet_ros.model.tree import mirrored_name
from flowing_puppet_ros.settings import Settings, setting

FEWEST = 20
"""Right examples that each kind of part needs at least."""

_TOLERANCE, _ITERATIONS = 1e-3, 4000


@dataclass(frozen=True, slots=True)
class LikelihoodSettings(Settings):
    """How the likelihood is learned."""

    every: int = setting(5, "use every so manieth annotated frame of a video", low=1, high=1000)
    wrong: int = setting(12, "wrong contours for each right one", low=1, high=100)
    regularisation: float = setting(5e-4, "penalty C of errors in the linear SVMs", low=1e-7, high=1e3)
    seed: int = setting(0, "seed of the wrong contours and of the solver", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """The likelihood, and how many right examples each kind of part had."""

    likelihood: PartLikelihood
    counts: dict[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Examples:
    """N groups of one right and M wrong contours: descriptors, which are seen, colour terms, and the fold of each."""

    found: F32
    visible: Bools
    colours: F64
    fold: NDArray[np.intp]

    def of_fold(self, fold: int) -> _Examples:
        """The groups of one fold."""
        chosen = self.fold == fold
        return _Examples(self.found[chosen], self.visible[chosen], self.colours[chosen], self.fold[chosen])


def learn(
    model: DeformableStructures, people: Sequence[Posed], settings: LikelihoodSettings, say: Callable[[str], None]
) -> Learned:
    """Learn skin, the filters, their calibration and the weights of the terms from posed people.

    Calibration and weights come from two folds of different source videos, so that no filter judges its own examples.
    InputError when a kind of part has too few examples.
    """
    skin = SkinColour(learn_skin(people))
    blank = PartLikelihood(len(model.tree), ContourLikelihood({}), skin, {})
    rng = np.random.default_rng(settings.seed)
    filters, terms, counts = {}, {}, {}
    for kind in TERMS_OF:
        examples = _gather(model, blank, people, kind, settings.wrong, rng)
        counts[kind] = len(examples.found)
        say(f"{kind}: {counts[kind]} examples")
        if min(np.sum(examples.fold == 0), np.sum(examples.fold == 1)) < FEWEST:
            raise InputError(
                f"the annotations show {counts[kind]} {kind.replace('_', ' ')}s; learning needs at least {FEWEST} "
                "in each half of the videos"
            )
        filters[kind], terms[kind] = _fit_kind(examples, settings)
    return Learned(PartLikelihood(len(model.tree), ContourLikelihood(filters), skin, terms), counts)


def learn_skin(people: Sequence[Posed]) -> F64:
    """Log ratio (BINS^2,) of colours in the faces against those beside the people; every image counts the same."""
    face_sum, beside_sum = np.zeros(BINS * BINS), np.zeros(BINS * BINS)
    for posed in people:
        colours, contours = ColourImage.of(posed.image), posed.puppet.contours
        face = colours.inside(face_of(contours[1]))
        beside = colours.bins[render_labels(contours, range(len(contours)), colours.bins.shape) == 0]
        if face is not None and len(beside):
            face_sum += face
            beside_sum += histogram_of(beside)
    if not face_sum.any():
        raise InputError("no face is seen in the annotated images, so the colour of skin cannot be learned")
    return log_ratio(face_sum / face_sum.sum(), beside_sum / beside_sum.sum())


def _gather(
    model: DeformableStructures,
    blank: PartLikelihood,
    people: Sequence[Posed],
    kind: str,
    wrong: int,
    rng: np.random.Generator,
) -> _Examples:
    """Describe every part of a kind that shows; those without a side also as seen in a mirror."""
    halves = {source: index % 2 for index, source in enumerate(sorted({source_of(posed.file) for posed in people}))}
    rows: list[tuple[Array, Array, Array, int]] = []
    for posed in people:
        shown = [
            part for part, name in enumerate(model.tree.names) if kind_of(name) == kind and posed.shows(model, part)
        ]
        if not shown:
            continue
        scene = blank.scene(posed.image).with_torso(*posed.puppet.contours[:2])
        for part in shown:
            name, scale = model.tree.names[part], np.full(1 + wrong, posed.puppet.scale)
            moved = wrong_contours(model, posed.puppet, part, wrong, Moves(far=0.25), rng)
            contours = np.concatenate([posed.puppet.contours[part][None], moved])
            colours = scene.terms(part, contours, scale)[:, 1:]
            right = on_right(name, contours)
            for ordered in [right] if mirrored_name(name) != name else [right, mirrored_order(right)]:
                described = describe(scene.features, ordered, PLACES[kind], scale)
                rows.append((*described, colours, halves[source_of(posed.file)]))
    if not rows:
        raise InputError(f"the annotations show no {kind.replace('_', ' ')}, so its likelihood cannot be learned")
    found, visible, colour_terms, fold = zip(*rows, strict=True)
    return _Examples(np.stack(found), np.stack(visible), np.stack(colour_terms), np.array(fold))


def _fit_kind(examples: _Examples, settings: LikelihoodSettings) -> tuple[ContourFilter, Array]:
    margins = np.empty(examples.found.shape[:2])
    for fold in (0, 1):
        held_out = examples.of_fold(1 - fold)
        fitted = _fit_filter(examples.of_fold(fold), settings)
        flat = [array.reshape(-1, *array.shape[2:]) for array in (held_out.found, held_out.visible)]
        margins[examples.fold == 1 - fold] = fitted.margin(*flat).reshape(-1, margins.shape[1])
    (slope,), offset = _logistic(margins[:, :, None])
    final = _fit_filter(examples, settings)
    calibrated = ContourFilter(final.weights, final.unseen, final.bias, (-slope, -offset))
    log_phi = calibrated.log_probability(margins)
    weight, _ = _logistic(np.concatenate([log_phi[:, :, None], examples.colours], axis=2))
    return calibrated, weight


def _fit_filter(examples: _Examples, settings: LikelihoodSettings) -> ContourFilter:
    """Fit the linear SVM; descriptors outside the image are given their mean over the others."""
    seen = examples.visible.sum(axis=(0, 1))
    mean = examples.found.sum(axis=(0, 1), dtype=np.float64) / np.maximum(seen, 1)[..., None]
    filled = np.where(examples.visible[..., None], examples.found, mean.astype(np.float32))
    right, share = _labels(examples.found.shape[:2])
    svm = LinearSVC(
        C=settings.regularisation, random_state=settings.seed, tol=_TOLERANCE, max_iter=_ITERATIONS, dual=True
    )
    svm.fit(filled.reshape(right.size, -1), right, sample_weight=share)
    weights = svm.coef_[0].reshape(mean.shape)
    unseen = np.sum(weights * mean, axis=-1)
    return ContourFilter(weights.astype(np.float32), unseen.astype(np.float32), float(svm.intercept_[0]), (-1.0, 0.0))


def _logistic(columns: Array) -> tuple[F64, float]:
    """Slopes (T,) and offset of the log odds that a contour is right, given columns (N,1+M,T)."""
    right, share = _labels(columns.shape[:2])
    regression = LogisticRegression(C=1.0, tol=1e-6, max_iter=1000)
    regression.fit(columns.reshape(right.size, -1), right, sample_weight=share)
    return np.asarray(regression.coef_[0], np.float64), float(regression.intercept_[0])


def _labels(shape: tuple[int, ...]) -> tuple[Bools, F64]:
    """Which of (N,1+M) examples are right (the first of each group), and weights that balance right and wrong."""
    right = np.zeros(shape, np.bool_)
    right[:, 0] = True
    return right.ravel(), np.where(right, 1.0, 1.0 / (shape[1] - 1)).ravel()
