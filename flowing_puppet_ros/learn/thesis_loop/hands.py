# SPDX-License-Identifier: Apache-2.0
"""Learn the hand detectors from annotated wrists (thesis, video chapter, "Image Likelihood").

Positives are boxes at wrists along their forearms; negatives are boxes at random places and directions near the person
and, in a second round, false positives of the first round's filters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.svm import LinearSVC

from flowing_puppet_ros.arrays import F32, Array, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.hands import (
    CELL_METRES,
    LENGTH,
    MAP_PITCH_M,
    HandDetectors,
    HandFilter,
    HandMaps,
    mirror,
)
from flowing_puppet_ros.evidence.image.likelihood import MAX_HAND_DISTANCE_M, PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.formats.annotations import source_video
from flowing_puppet_ros.learn.likelihood.samples import PosedPerson
from flowing_puppet_ros.learn.thesis_loop.hand_samples import (
    KINDS,
    MIN_WRONG_DISTANCE_M,
    find_wrists,
    is_far_from_wrists,
    make_maps,
    sample_wrong_places,
)
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.settings import Settings, setting

MIN_HANDS = 40  # in each half of the videos


@dataclass(frozen=True, slots=True)
class HandSettings(Settings):
    """How the hand detectors are learned."""

    every: int = setting(5, "use every n-th annotated frame of a video", low=1, high=1000)
    wrong: int = setting(12, "wrong places per person, in each round", low=1, high=100)
    regularisation: float = setting(1e-2, "penalty C of errors in the linear SVMs", low=1e-7, high=1e3)
    seed: int = setting(0, "seed of the wrong places and of the solver", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class HandBoxes:
    """N boxes: `descriptors` (N, D) by kind, masks `right` and `flow` (N,), and the `half` (N,) of the videos."""

    descriptors: dict[str, F32]
    right: Bools
    flow: Bools
    half: NDArray[np.intp]

    @classmethod
    def join(cls, groups: list[HandBoxes]) -> HandBoxes:
        """Concatenate several groups."""
        found = {kind: np.concatenate([group.descriptors[kind] for group in groups]) for kind in KINDS}
        right, flow, half = (np.concatenate([getattr(g, name) for g in groups]) for name in ("right", "flow", "half"))
        return cls(found, right, flow, half)


def learn_hands(
    model: DeformableStructures,
    people: Callable[[], Iterable[PosedPerson]],
    settings: HandSettings,
    report: Callable[[str], None],
) -> tuple[HandDetectors, HandBoxes]:
    """Learn both filters, their odds and their joint weights; every call of `people` yields the posed people.

    Odds and weights come from two halves of the source videos, so that no filter scores its own training examples.
    InputError if there are too few wrists.
    """
    likelihood, optical_flow = PartLikelihood.load(), OpticalFlow()
    rng = np.random.default_rng(settings.seed)
    groups: list[HandBoxes] = []
    for posed in people():
        maps = make_maps(posed, likelihood, optical_flow)
        arms = list(find_wrists(model, posed))
        wrong = sample_wrong_places(model, posed, settings.wrong, rng)
        places = np.concatenate([np.reshape([wrist for wrist, _ in arms], (-1, 2)), wrong])
        angles = [np.arctan2(*(wrist - elbow)[::-1]) for wrist, elbow in arms]
        turns = np.concatenate([angles, rng.uniform(0, 2 * np.pi, len(wrong))])
        groups.append(_describe_boxes(maps, posed, places, turns, len(arms)))
    boxes = HandBoxes.join(groups) if groups else None
    if boxes is None or min(np.sum(boxes.right & (boxes.half == half)) for half in (0, 1)) < MIN_HANDS:
        raise InputError(f"the annotations show too few wrists; learning needs {MIN_HANDS} in each half of the videos")
    report(f"{boxes.right.sum()} hands, {(~boxes.right).sum()} random places")
    first = _fit_detectors(boxes, settings)
    for posed in people():
        maps = make_maps(posed, likelihood, optical_flow, first)
        for kind in maps.fields:
            places, turns = _mine_hard_places(model, posed, maps, kind, settings.wrong // 2)
            groups.append(_describe_boxes(maps, posed, places, turns, 0))
    boxes = HandBoxes.join(groups)
    report(f"{(~boxes.right).sum()} wrong places with those that were taken for hands")
    return _fit_detectors(boxes, settings), boxes


def _describe_boxes(maps: HandMaps, posed: PosedPerson, places: Array, turns: Array, right: int) -> HandBoxes:
    """Describe boxes at `places` (N, 2) px in directions `turns` (N,) rad, of which the first `right` are hands."""
    cell = CELL_METRES * maps.scale
    count = len(places)
    found = {}
    for kind in KINDS:
        field = maps.fields.get(kind)
        missing = np.zeros((count, LENGTH[kind]), np.float32)
        found[kind] = missing if field is None else field.describe(places, turns, cell)
    half = crc32(source_video(posed.file).encode()) % 2
    return HandBoxes(found, np.arange(count) < right, np.full(count, "flow" in maps.fields), np.full(count, half))


def _mine_hard_places(
    model: DeformableStructures, posed: PosedPerson, maps: HandMaps, kind: str, count: int
) -> tuple[Array, Array]:
    """Return up to `count` separate places without hands that a detector scores highest, and their directions."""
    scale = posed.puppet.scale
    axis = np.arange(-MAX_HAND_DISTANCE_M, MAX_HAND_DISTANCE_M, MAP_PITCH_M) * scale
    grid = np.stack(np.meshgrid(axis, axis), axis=2).reshape(-1, 2) + posed.puppet.contours[1].mean(axis=0)
    grid = grid[is_far_from_wrists(model, posed, grid)]
    odds, turns = maps.best_orientation(kind, grid)
    chosen: list[int] = []
    for index in np.argsort(-odds):
        if len(chosen) == count:
            break
        if all(np.hypot(*(grid[index] - grid[other])) > MIN_WRONG_DISTANCE_M * scale for other in chosen):
            chosen.append(int(index))
    return grid[chosen], turns[chosen]


def _fit_detectors(boxes: HandBoxes, settings: HandSettings) -> HandDetectors:
    """Fit filters to all boxes; fit odds and joint weights to margins of filters learned on the other half."""
    margins = {kind: np.zeros(len(boxes.right)) for kind in KINDS}
    filters = {}
    for kind in KINDS:
        usable = boxes.flow if kind == "flow" else np.ones(len(boxes.right), dtype=bool)
        for half in (0, 1):
            learned = _fit_svm(boxes, kind, usable & (boxes.half == half), settings)
            others = boxes.half != half
            margins[kind][others] = learned.margin(boxes.descriptors[kind][others])
        whole = _fit_svm(boxes, kind, usable, settings)
        slope, offset = _fit_logistic(margins[kind][usable, None], boxes.right[usable])
        filters[kind] = HandFilter(whole.weight, whole.bias, (float(slope[0]), offset))
    both = np.column_stack([margins[kind] for kind in KINDS])[boxes.flow]
    weight, bias = _fit_logistic(both, boxes.right[boxes.flow])
    return HandDetectors(filters, np.append(weight, bias))


def _fit_svm(boxes: HandBoxes, kind: str, chosen: Bools, settings: HandSettings) -> HandFilter:
    """Fit a linear SVM to some boxes and their mirror images."""
    found, right = boxes.descriptors[kind][chosen], boxes.right[chosen]
    svm = LinearSVC(C=settings.regularisation, class_weight="balanced", random_state=settings.seed, dual=False)
    svm.fit(np.concatenate([found, mirror(found)]), np.concatenate([right, right]))
    return HandFilter(svm.coef_[0].astype(np.float32), float(svm.intercept_[0]), (1.0, 0.0))


def _fit_logistic(measures: Array, right: Array) -> tuple[Array, float]:
    """Fit slopes and offset of the log odds of being right, with both classes of equal weight."""
    regression = LogisticRegression(class_weight="balanced", tol=1e-6, max_iter=1000).fit(measures, right)
    return np.asarray(regression.coef_[0], np.float64), float(regression.intercept_[0])
