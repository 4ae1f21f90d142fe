# SPDX-License-Identifier: Apache-2.0
"""Learn the image likelihood of a puppet's parts from annotated images (thesis, "Likelihood", Eqs. 20-22)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.svm import LinearSVC

from flowing_puppet_ros.arrays import F32, F64, Array, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.colour import (
    BINS,
    ColourImage,
    SkinColour,
    face_contour,
    log_ratio,
    smooth_histogram,
)
from flowing_puppet_ros.evidence.image.contour import (
    PLACES,
    ContourFilter,
    ContourLikelihood,
    describe,
    order_as_right,
    part_kind,
)
from flowing_puppet_ros.evidence.image.likelihood import TERMS_OF, PartLikelihood
from flowing_puppet_ros.evidence.image.outline import mirror_order
from flowing_puppet_ros.image.formats.annotations import source_video
from flowing_puppet_ros.learn.likelihood.samples import ContourPerturbation, PosedPerson, perturb_contours
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import render_labels
from flowing_puppet_ros.model.tree import mirrored_name
from flowing_puppet_ros.settings import Settings, setting

MIN_EXAMPLES = 20
"""Right examples that each kind of part needs in each fold."""

_SVM_TOLERANCE, _MAX_SVM_ITERATIONS = 1e-3, 4000  # of LinearSVC


@dataclass(frozen=True, slots=True)
class LikelihoodSettings(Settings):
    """How the likelihood is learned."""

    every: int = setting(5, "use every n-th annotated frame of a video", low=1, high=1000)
    wrong: int = setting(12, "wrong contours for each right one", low=1, high=100)
    regularisation: float = setting(5e-4, "penalty C of errors in the linear SVMs", low=1e-7, high=1e3)
    seed: int = setting(0, "seed of the wrong contours and of the solver", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class LearnedLikelihood:
    """The likelihood, and the number of right examples of each kind of part."""

    likelihood: PartLikelihood
    counts: dict[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Examples:
    """N groups of one right and M wrong contours: descriptors, their visibility, colour terms, and the fold (N,)."""

    descriptors: F32
    visible: Bools
    colours: F64
    fold: NDArray[np.intp]

    def select_fold(self, fold: int) -> _Examples:
        """Return the groups of one fold."""
        chosen = self.fold == fold
        return _Examples(self.descriptors[chosen], self.visible[chosen], self.colours[chosen], self.fold[chosen])


def learn_likelihood(
    model: DeformableStructures,
    people: Sequence[PosedPerson],
    settings: LikelihoodSettings,
    report: Callable[[str], None],
) -> LearnedLikelihood:
    """Learn skin, the filters, their calibration and the weights of the terms from posed people.

    Calibration and weights come from two folds of different source videos, so that no filter scores its own training
    examples. InputError if a kind of part has too few examples.
    """
    skin = SkinColour(learn_skin(people))
    blank = PartLikelihood(len(model.tree), ContourLikelihood({}), skin, {})
    rng = np.random.default_rng(settings.seed)
    filters, terms, counts = {}, {}, {}
    for kind in TERMS_OF:
        examples = _describe_kind(model, blank, people, kind, settings.wrong, rng)
        counts[kind] = len(examples.descriptors)
        report(f"{kind}: {counts[kind]} examples")
        if min(np.sum(examples.fold == 0), np.sum(examples.fold == 1)) < MIN_EXAMPLES:
            raise InputError(
                f"the annotations show {counts[kind]} {kind.replace('_', ' ')}s; learning needs at least "
                f"{MIN_EXAMPLES} in each half of the videos"
            )
        filters[kind], terms[kind] = _fit_kind(examples, settings)
    return LearnedLikelihood(PartLikelihood(len(model.tree), ContourLikelihood(filters), skin, terms), counts)


def learn_skin(people: Sequence[PosedPerson]) -> F64:
    """Return the log ratio (BINS^2,) of colours in faces to those beside people; every image counts the same."""
    face_sum, beside_sum = np.zeros(BINS * BINS), np.zeros(BINS * BINS)
    for posed in people:
        colours, contours = ColourImage.of(posed.image), posed.puppet.contours
        face = colours.histogram_inside(face_contour(contours[1]))
        beside = colours.bins[render_labels(contours, range(len(contours)), colours.bins.shape) == 0]
        if face is not None and len(beside):
            face_sum += face
            beside_sum += smooth_histogram(beside)
    if not face_sum.any():
        raise InputError("the annotated images show no face, so the colour of skin cannot be learned; annotate some")
    return log_ratio(face_sum / face_sum.sum(), beside_sum / beside_sum.sum())


def _describe_kind(
    model: DeformableStructures,
    blank: PartLikelihood,
    people: Sequence[PosedPerson],
    kind: str,
    wrong: int,
    rng: np.random.Generator,
) -> _Examples:
    """Describe every visible part of a kind; those on the midline also mirrored."""
    halves = {source: index % 2 for index, source in enumerate(sorted({source_video(posed.file) for posed in people}))}
    rows: list[tuple[Array, Array, Array, int]] = []
    for posed in people:
        shown = [
            part for part, name in enumerate(model.tree.names) if part_kind(name) == kind and posed.shows(model, part)
        ]
        if not shown:
            continue
        scene = blank.prepare(posed.image).with_torso(*posed.puppet.contours[:2])
        for part in shown:
            name, scale = model.tree.names[part], np.full(1 + wrong, posed.puppet.scale)
            moved = perturb_contours(model, posed.puppet, part, wrong, ContourPerturbation(far=0.25), rng)
            contours = np.concatenate([posed.puppet.contours[part][None], moved])
            colours = scene.terms(part, contours, scale)[:, 1:]
            right = order_as_right(name, contours)
            for ordered in [right] if mirrored_name(name) != name else [right, mirror_order(right)]:
                described = describe(scene.features, ordered, PLACES[kind], scale)
                rows.append((*described, colours, halves[source_video(posed.file)]))
    if not rows:
        raise InputError(f"the annotations show no {kind.replace('_', ' ')}, so its likelihood cannot be learned")
    found, visible, colour_terms, fold = zip(*rows, strict=True)
    return _Examples(np.stack(found), np.stack(visible), np.stack(colour_terms), np.array(fold))


def _fit_kind(examples: _Examples, settings: LikelihoodSettings) -> tuple[ContourFilter, Array]:
    margins = np.empty(examples.descriptors.shape[:2])
    for fold in (0, 1):
        held_out = examples.select_fold(1 - fold)
        fitted = _fit_filter(examples.select_fold(fold), settings)
        flat = [array.reshape(-1, *array.shape[2:]) for array in (held_out.descriptors, held_out.visible)]
        margins[examples.fold == 1 - fold] = fitted.margin(*flat).reshape(-1, margins.shape[1])
    (slope,), offset = _fit_logistic(margins[:, :, None])
    final = _fit_filter(examples, settings)
    calibrated = ContourFilter(final.weights, final.unseen, final.bias, (-slope, -offset))
    log_phi = calibrated.log_probability(margins)
    weight, _ = _fit_logistic(np.concatenate([log_phi[:, :, None], examples.colours], axis=2))
    return calibrated, weight


def _fit_filter(examples: _Examples, settings: LikelihoodSettings) -> ContourFilter:
    """Fit the linear SVM; descriptors outside the image get their mean over the others."""
    seen = examples.visible.sum(axis=(0, 1))
    mean = examples.descriptors.sum(axis=(0, 1), dtype=np.float64) / np.maximum(seen, 1)[..., None]
    filled = np.where(examples.visible[..., None], examples.descriptors, mean.astype(np.float32))
    right, share = _make_labels(examples.descriptors.shape[:2])
    svm = LinearSVC(
        C=settings.regularisation,
        random_state=settings.seed,
        tol=_SVM_TOLERANCE,
        max_iter=_MAX_SVM_ITERATIONS,
        dual=True,
    )
    svm.fit(filled.reshape(right.size, -1), right, sample_weight=share)
    weights = svm.coef_[0].reshape(mean.shape)
    unseen = np.sum(weights * mean, axis=-1)
    return ContourFilter(weights.astype(np.float32), unseen.astype(np.float32), float(svm.intercept_[0]), (-1.0, 0.0))


def _fit_logistic(columns: Array) -> tuple[F64, float]:
    """Fit slopes (T,) and offset of the log odds that a contour is right, given columns (N, 1+M, T)."""
    right, share = _make_labels(columns.shape[:2])
    regression = LogisticRegression(C=1.0, tol=1e-6, max_iter=1000)
    regression.fit(columns.reshape(right.size, -1), right, sample_weight=share)
    return np.asarray(regression.coef_[0], np.float64), float(regression.intercept_[0])


def _make_labels(shape: tuple[int, ...]) -> tuple[Bools, F64]:
    """Mark the right ones of (N, 1+M) examples (the first of each group); also return weights that balance both."""
    right = np.zeros(shape, np.bool_)
    right[:, 0] = True
    return right.ravel(), np.where(right, 1.0, 1.0 / (shape[1] - 1)).ravel()
