# SPDX-License-Identifier: Apache-2.0
"""Learn to choose among poses: scores by a conditional logit, their scale and how probable they are by regression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.optimize import minimize

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector_rank import (
    SCALE_INPUTS,
    Pose,
    Ranking,
    agreed_scale,
    best_places,
    scale_inputs,
)
from flowing_puppet_ros.learn.calibration import logistic

type Array = np.ndarray[Any, Any]

FOUND_NECK, FOUND_SCALE = 0.5, 1.25  # units of S and ratio: a pose this close to the person has found them
SCALE_DEVIATION = 0.15  # of the logarithm: how much the choice among poses at the right place minds their scale
LEAST_TARGET = 0.05
LARGEST_CORRECTION = 0.5  # of the logarithm of S: poses that are further off say nothing of the others
RIDGE, SCALE_RIDGE = 3.0, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """What is kept of a pose: thousands are compared, and beliefs take much memory. See detector_rank.Pose."""

    points: Array
    scale: float
    measures: Array

    @classmethod
    def of(cls, pose: Pose) -> Self:
        """The outline of a pose."""
        return cls(pose.points, pose.scale, pose.measures)


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """The neck (2,) px and S of a person, and the poses found in the image by filters that had not seen the person."""

    neck: Array
    scale: float
    poses: Sequence[Outline]


def learn_ranking(looked: Sequence[Looked], far: Sequence[Looked]) -> tuple[Ranking, float]:
    """The ranking of poses, and the share of the people `looked` at whom the best ones find.

    `far` are people made far away, who teach the scale alone: how often people are small is not theirs to say.
    InputError when no pose is right, or when hardly any is wrong: then there is nothing to tell.
    """
    looked, far = ([one for one in some if one.poses] for some in (looked, far))
    if not looked:
        raise InputError("nobody was found on the held-out images; annotate more images")
    ranking = Ranking(_conditional_logit(looked), np.zeros(SCALE_INPUTS), np.zeros(2))
    ranking = replace(ranking, scale=_learn_scale(ranking, [*looked, *far]))
    first, right, values = [], [], []
    for one in looked:
        scores = ranking.scores(one.poses)
        best = best_places(one.poses, scores)
        found = [_right(one, one.poses[k], _scale(ranking, one, scores, k)) for k in best]
        first.append(found[0])
        right += found
        values += scores[best].tolist()
    slope, offset = logistic(np.array(values)[:, None], np.array(right))
    return replace(ranking, odds=np.array([slope[0], offset])), float(np.mean(first))


def _learn_scale(ranking: Ranking, looked: Sequence[Looked]) -> Array:
    """Weights (SCALE_INPUTS,) of the correction of S, from the people whom the best poses find."""
    rows, corrections = [], []
    for one in looked:
        scores = ranking.scores(one.poses)
        best = int(scores.argmax())
        if _at_place(one, one.poses[best]):
            scale = agreed_scale(one.poses, scores, best)
            correction = float(np.log(one.scale / scale))
            if abs(correction) < LARGEST_CORRECTION:
                rows.append(scale_inputs(one.poses[best], scale))
                corrections.append(correction)
    if not rows:
        raise InputError("no annotated person of the held-out images was found; annotate more images")
    design = np.array(rows)
    normal = design.T @ design + np.diag([SCALE_RIDGE] * (SCALE_INPUTS - 1) + [1e-6])
    return np.linalg.solve(normal, design.T @ np.array(corrections))


def _scale(ranking: Ranking, one: Looked, scores: Array, index: int) -> float:
    return ranking.corrected_scale(one.poses[index], agreed_scale(one.poses, scores, index))


def _at_place(one: Looked, pose: Pose) -> bool:
    return float(np.linalg.norm(pose.points[0] - one.neck)) < FOUND_NECK * one.scale


def _right(one: Looked, pose: Pose, scale: float) -> bool:
    return _at_place(one, pose) and 1 / FOUND_SCALE < scale / one.scale < FOUND_SCALE


def _conditional_logit(looked: Sequence[Looked]) -> Array:
    """Weights (MEASURES,) under which softmax over an image's poses agrees best with how well they fit the person."""
    measures = [np.stack([pose.measures for pose in one.poses]) for one in looked]
    every = np.concatenate(measures)
    mean, deviation = every.mean(axis=0), np.maximum(every.std(axis=0), 1e-9)
    images = []
    for one, values in zip(looked, measures, strict=True):
        misfit = np.log([pose.scale / one.scale for pose in one.poses]) / SCALE_DEVIATION
        target = np.array([_at_place(one, pose) for pose in one.poses]) * np.exp(-0.5 * misfit**2)
        if target.sum() > LEAST_TARGET:
            images.append(((values - mean) / deviation, target / target.sum()))

    def loss(weight: Array) -> tuple[float, Array]:
        value, gradient = RIDGE * float(weight @ weight), 2 * RIDGE * weight
        for x, target in images:
            score = x @ weight
            share = np.exp(score - score.max())
            share /= share.sum()
            value -= float(target @ np.log(share + 1e-12))
            gradient = gradient - x.T @ (target - share)
        return value, gradient

    weight: Array = minimize(loss, np.zeros(every.shape[1]), jac=True).x
    return weight / deviation
