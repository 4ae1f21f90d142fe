# SPDX-License-Identifier: Apache-2.0
"""Learn the hand detectors from annotated wrists (thesis, video chapter, "Image Likelihood").

Boxes at wrists along their forearms against boxes at random places and directions near the person and, in a second
round, at the places that the first round's filters take for hands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
    EXTRAS,
    LENGTH,
    PITCH,
    HandDetectors,
    HandFilter,
    HandMaps,
    mirrored,
)
from flowing_puppet_ros.evidence.image.likelihood import REACH, PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.image.formats.annotations import source_of
from flowing_puppet_ros.learn.likelihood.samples import Posed
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.settings import Settings, setting

KINDS = tuple(EXTRAS)
SIDES = ("right", "left")
SURE = 0.5  # confidence of wrists and elbows that teach
APART = 0.12  # m from any wrist, from which a place is wrong
FEWEST = 40
NO_FILTER = HandFilter(np.zeros(0, np.float32), 0.0, (1.0, 0.0))
BLANK = HandDetectors(dict.fromkeys(KINDS, NO_FILTER), np.zeros(3))


@dataclass(frozen=True, slots=True)
class HandSettings(Settings):
    """How the hand detectors are learned."""

    every: int = setting(5, "use every so manieth annotated frame of a video", low=1, high=1000)
    wrong: int = setting(12, "wrong places a person, in each round", low=1, high=100)
    regularisation: float = setting(1e-2, "penalty C of errors in the linear SVMs", low=1e-7, high=1e3)
    seed: int = setting(0, "seed of the wrong places and of the solver", low=0, high=2**31 - 1)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """N boxes: descriptors (N,D) by kind, whether they are `right` and have `flow` (N,), their `half` of the videos."""

    found: dict[str, F32]
    right: Bools
    flow: Bools
    half: NDArray[np.intp]

    @classmethod
    def join(cls, groups: list[Boxes]) -> Boxes:
        """All boxes of several groups."""
        found = {kind: np.concatenate([group.found[kind] for group in groups]) for kind in KINDS}
        right, flow, half = (np.concatenate([getattr(g, name) for g in groups]) for name in ("right", "flow", "half"))
        return cls(found, right, flow, half)


def maps_of(
    posed: Posed, likelihood: PartLikelihood, optical_flow: OpticalFlow, detectors: HandDetectors = BLANK
) -> HandMaps:
    """What hands are looked for in: the image with the colours of the posed person, and the flow back in time."""
    scene = likelihood.scene(posed.image).with_torso(*posed.puppet.contours[:2])
    flows = [] if posed.before is None else [optical_flow(posed.before, posed.image)[1]]
    return HandMaps.of(detectors, scene, flows, posed.puppet.scale)


def wrists_of(model: DeformableStructures, posed: Posed) -> Iterator[tuple[Array, Array]]:
    """Wrist (2,) and elbow (2,) px of each arm whose joints are sure and whose wrist is in the image."""
    for side in SIDES:
        wrist, elbow = (model.joint_names.index(f"{side}_{name}") for name in ("wrist", "elbow"))
        place = posed.puppet.joints[wrist]
        inside = (place >= 0).all() and (place < posed.image.shape[1::-1]).all()
        if min(posed.confidence[wrist], posed.confidence[elbow]) >= SURE and inside:
            yield place, posed.puppet.joints[elbow]


def wrong_places(model: DeformableStructures, posed: Posed, count: int, rng: np.random.Generator) -> Array:
    """Up to `count` random places (N,2) px in the image that a hand could reach and where none is."""
    scale = posed.puppet.scale
    distance, turn = REACH * scale * np.sqrt(rng.random(4 * count)), rng.uniform(0, 2 * np.pi, 4 * count)
    middle = posed.puppet.contours[1].mean(axis=0) + np.array([0.0, 0.2 * scale])
    places = middle + distance[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return places[far_from_wrists(model, posed, places)][:count]


def far_from_wrists(model: DeformableStructures, posed: Posed, places: Array) -> Bools:
    """Which of places (N,2) px are in the image and not near either wrist."""
    wrists = posed.puppet.joints[[model.joint_names.index(f"{side}_wrist") for side in SIDES]]
    near = np.linalg.norm(places[:, None] - wrists, axis=2).min(axis=1) < APART * posed.puppet.scale
    inside = ((places >= 0) & (places < np.array(posed.image.shape[1::-1]))).all(axis=1)
    return np.asarray(inside & ~near)


def learn(
    model: DeformableStructures,
    people: Callable[[], Iterable[Posed]],
    settings: HandSettings,
    say: Callable[[str], None],
) -> tuple[HandDetectors, Boxes]:
    """Learn both filters, their odds and their joint weights; `people` gives the posed people as often as asked.

    Odds and weights come from two halves of the source videos, so that no filter judges its own examples. InputError
    when there are too few wrists.
    """
    likelihood, optical_flow = PartLikelihood.load(), OpticalFlow()
    rng = np.random.default_rng(settings.seed)
    groups: list[Boxes] = []
    for posed in people():
        maps = maps_of(posed, likelihood, optical_flow)
        arms = list(wrists_of(model, posed))
        wrong = wrong_places(model, posed, settings.wrong, rng)
        places = np.concatenate([np.reshape([wrist for wrist, _ in arms], (-1, 2)), wrong])
        angles = [np.arctan2(*(wrist - elbow)[::-1]) for wrist, elbow in arms]
        turns = np.concatenate([angles, rng.uniform(0, 2 * np.pi, len(wrong))])
        groups.append(_described(maps, posed, places, turns, len(arms)))
    boxes = Boxes.join(groups) if groups else None
    if boxes is None or min(np.sum(boxes.right & (boxes.half == half)) for half in (0, 1)) < FEWEST:
        raise InputError(f"the annotations show too few wrists; learning needs {FEWEST} in each half of the videos")
    say(f"{boxes.right.sum()} hands, {(~boxes.right).sum()} random places")
    first = _fit(boxes, settings)
    for posed in people():
        maps = maps_of(posed, likelihood, optical_flow, first)
        for kind in maps.fields:
            places, turns = _taken_for_hands(model, posed, maps, kind, settings.wrong // 2)
            groups.append(_described(maps, posed, places, turns, 0))
    boxes = Boxes.join(groups)
    say(f"{(~boxes.right).sum()} wrong places with those that were taken for hands")
    return _fit(boxes, settings), boxes


def _described(maps: HandMaps, posed: Posed, places: Array, turns: Array, right: int) -> Boxes:
    """Boxes at places (N,2) px in directions `turns` (N,), of which the first `right` are hands."""
    cell = CELL_METRES * maps.scale
    count = len(places)
    found = {}
    for kind in KINDS:
        field = maps.fields.get(kind)
        missing = np.zeros((count, LENGTH[kind]), np.float32)
        found[kind] = missing if field is None else field.describe(places, turns, cell)
    half = crc32(source_of(posed.file).encode()) % 2
    return Boxes(found, np.arange(count) < right, np.full(count, "flow" in maps.fields), np.full(count, half))


def _taken_for_hands(
    model: DeformableStructures, posed: Posed, maps: HandMaps, kind: str, count: int
) -> tuple[Array, Array]:
    """Up to `count` places that a detector takes for hands most, apart from each other, and their directions."""
    scale = posed.puppet.scale
    axis = np.arange(-REACH, REACH, PITCH) * scale
    grid = np.stack(np.meshgrid(axis, axis), axis=2).reshape(-1, 2) + posed.puppet.contours[1].mean(axis=0)
    grid = grid[far_from_wrists(model, posed, grid)]
    odds, turns = maps.best_orientation(kind, grid)
    chosen: list[int] = []
    for index in np.argsort(-odds):
        if len(chosen) == count:
            break
        if all(np.hypot(*(grid[index] - grid[other])) > APART * scale for other in chosen):
            chosen.append(int(index))
    return grid[chosen], turns[chosen]


def _fit(boxes: Boxes, settings: HandSettings) -> HandDetectors:
    """Filters of all boxes; odds and joint weights by the margins of filters that have not seen the half."""
    margins = {kind: np.zeros(len(boxes.right)) for kind in KINDS}
    filters = {}
    for kind in KINDS:
        usable = boxes.flow if kind == "flow" else np.ones(len(boxes.right), dtype=bool)
        for half in (0, 1):
            learned = _svm(boxes, kind, usable & (boxes.half == half), settings)
            others = boxes.half != half
            margins[kind][others] = learned.margin(boxes.found[kind][others])
        whole = _svm(boxes, kind, usable, settings)
        slope, offset = _logistic(margins[kind][usable, None], boxes.right[usable])
        filters[kind] = HandFilter(whole.weight, whole.bias, (float(slope[0]), offset))
    both = np.column_stack([margins[kind] for kind in KINDS])[boxes.flow]
    weight, bias = _logistic(both, boxes.right[boxes.flow])
    return HandDetectors(filters, np.append(weight, bias))


def _svm(boxes: Boxes, kind: str, chosen: Bools, settings: HandSettings) -> HandFilter:
    """Linear SVM of some boxes and of what a mirror shows of them."""
    found, right = boxes.found[kind][chosen], boxes.right[chosen]
    svm = LinearSVC(C=settings.regularisation, class_weight="balanced", random_state=settings.seed, dual=False)
    svm.fit(np.concatenate([found, mirrored(found)]), np.concatenate([right, right]))
    return HandFilter(svm.coef_[0].astype(np.float32), float(svm.intercept_[0]), (1.0, 0.0))


def _logistic(measures: Array, right: Array) -> tuple[Array, float]:
    """Slopes and offset of the log odds of being right, as if as many were right as wrong."""
    regression = LogisticRegression(class_weight="balanced", tol=1e-6, max_iter=1000).fit(measures, right)
    return np.asarray(regression.coef_[0], np.float64), float(regression.intercept_[0])
