# SPDX-License-Identifier: Apache-2.0
"""Learn to score poses: a conditional logit ranks them, regressions correct their scale and calibrate confidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector.detection import PoseHypothesis
from flowing_puppet_ros.image.detector.scoring import PoseScorer, agree_on_scale, log_length_ratios, suppress_duplicates
from flowing_puppet_ros.learn.detector.data import Example

MAX_NECK_OFFSET, MAX_SCALE_RATIO = 0.5, 1.25  # in S, and a ratio: a pose this close to the person is correct
LOG_SCALE_DEVIATION = 0.15  # tolerance of scale among poses at the right place
MIN_TARGET_SUM = 0.05  # of an image's target weights; images below it teach nothing
RIDGE, SCALE_RIDGE = 3.0, 1.0  # L2 penalties of the logit and of the scale correction


def learn_pose_scorer(found: Sequence[tuple[Example, list[PoseHypothesis]]]) -> tuple[PoseScorer, float]:
    """Learn a scorer from the poses found in each example's image; also return the share of correct best poses.

    InputError if no person was found.
    """
    found = [(example, poses) for example, poses in found if poses]
    weight = _fit_conditional_logit(found)
    ranking = PoseScorer(weight, np.zeros(4), np.zeros(2))
    rows, corrections, picked = [], [], []
    for example, poses in found:
        scores = ranking.score(poses)
        for order, index in enumerate(suppress_duplicates(poses, scores)):
            scale = agree_on_scale(poses, scores, index)
            picked.append((example, poses[index], scale, float(scores[index])))
            if order == 0 and _is_at_neck(example, poses[index]):
                rows.append(log_length_ratios(poses[index], scale))
                corrections.append(np.log(example.scale / scale))
    if not rows:
        raise InputError("no annotated person of the held-out images was found; annotate more images")
    design = np.array(rows)
    normal = design.T @ design + np.diag([SCALE_RIDGE] * 3 + [1e-6])
    ranking = PoseScorer(weight, np.linalg.solve(normal, design.T @ np.array(corrections)), np.zeros(2))
    right = np.array(
        [_is_correct(example, pose, ranking.correct_scale(pose, scale)) for example, pose, scale, _ in picked]
    )
    values = np.array([score for *_, score in picked])
    slope, offset = fit_logistic(values[:, None], right)
    first = {id(example): correct for (example, *_), correct in reversed(list(zip(picked, right, strict=True)))}
    return PoseScorer(weight, ranking.scale, np.array([slope[0], offset])), float(np.mean(list(first.values())))


def fit_logistic(features: Array, right: Array, ridge: float = 1.0) -> tuple[Array, float]:
    """Return weights (D,) and bias of the log-odds that samples `features` (N, D) are `right` (N,).

    The ridge acts on the weights of standardised features; the mean prediction equals the share of right samples.
    """
    scaler = StandardScaler().fit(features)
    fitted = LogisticRegression(C=1 / ridge, tol=1e-8, max_iter=1000).fit(scaler.transform(features), right)
    weight: Array = fitted.coef_[0] / scaler.scale_
    return weight, float(fitted.intercept_[0] - weight @ scaler.mean_)


def _is_at_neck(example: Example, pose: PoseHypothesis) -> bool:
    distance = float(np.linalg.norm(pose.points[0] - example.joint("neck")))
    return distance < MAX_NECK_OFFSET * example.scale


def _is_correct(example: Example, pose: PoseHypothesis, scale: float) -> bool:
    return _is_at_neck(example, pose) and 1 / MAX_SCALE_RATIO < scale / example.scale < MAX_SCALE_RATIO


def _fit_conditional_logit(found: Sequence[tuple[Example, list[PoseHypothesis]]]) -> Array:
    """Fit weights (FEATURES,) whose softmax over an image's poses agrees best with how well they fit the person."""
    measures = [np.stack([pose.features for pose in poses]) for _, poses in found]
    every = np.concatenate(measures)
    mean, deviation = every.mean(axis=0), np.maximum(every.std(axis=0), 1e-9)
    images = []
    for (example, poses), values in zip(found, measures, strict=True):
        misfit = np.log([pose.scale / example.scale for pose in poses]) / LOG_SCALE_DEVIATION
        target = np.array([_is_at_neck(example, pose) for pose in poses]) * np.exp(-0.5 * misfit**2)
        if target.sum() > MIN_TARGET_SUM:
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
