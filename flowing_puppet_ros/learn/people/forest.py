# SPDX-License-Identifier: Apache-2.0
"""Learn the filter's trees and the weights of a fit's evidence from examples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from flowing_puppet_ros.body.upright.person_model import (
    DecisionTrees,
    PersonModel,
    calibrate_odds,
    log_odds,
    select_accuracy,
)
from flowing_puppet_ros.learn.people.examples import CandidateExamples
from flowing_puppet_ros.learn.people.unseen import make_forest, predict_unseen

CLOSE_M = 0.10  # mean error of the joints of a body that is close
REGULARISATION = 1.0  # of the logistic regression


def learn_model(examples: CandidateExamples, seed: int, kept: PersonModel | None = None) -> PersonModel:
    """Learn from examples; the same examples and seed give the same model.

    Of a model that is `kept`, only what tells how close the joints are is learned anew.
    """
    fitted = examples.fitted
    tracked = np.isfinite(examples.tracked).all(axis=1)
    evidence = np.concatenate([examples.evidence[fitted], examples.tracked[tracked]])
    truth, scan, error = (
        np.concatenate([each[fitted], each[tracked]])
        for each in (examples.is_person, examples.scan, examples.joint_error)
    )
    accuracy = _learn_accuracy(evidence, error)
    if kept is not None:
        return replace(kept, accuracy=accuracy)
    return PersonModel(
        _flatten(make_forest(seed).fit(examples.shape, examples.is_person)),
        _flatten(make_forest(seed).fit(evidence, truth)),
        _calibrate(log_odds(predict_unseen(evidence, truth, scan, seed)), truth),
        accuracy,
    )


def _learn_accuracy(evidence: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the weights and the constant (K,) of the log odds that bodies are close, by their mean error (N,) m."""
    from sklearn.linear_model import LogisticRegression

    known = np.isfinite(error)
    inputs, close = select_accuracy(evidence[known]), error[known] < CLOSE_M
    mean, scale = inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-9)
    accuracy = LogisticRegression(C=REGULARISATION).fit((inputs - mean) / scale, close)
    weight = accuracy.coef_[0] / scale
    return np.append(weight, accuracy.intercept_[0] - weight @ mean)


def _calibrate(judged: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the weight of the judge's log odds (N,) and the constant under which people (N,) are likeliest."""

    def cost(calibration: np.ndarray) -> float:
        odds = calibrate_odds(judged, calibration)
        return float(np.logaddexp(0.0, np.where(truth == 1, -odds, odds)).mean())

    return np.asarray(minimize(cost, np.array([1.0, 0.0]), method="Nelder-Mead").x)


def _flatten(forest: Any) -> DecisionTrees:
    """Return the trees of a forest one after the other."""
    roots, columns, first = [], [], 0
    for tree in (estimator.tree_ for estimator in forest.estimators_):
        leaf = tree.children_left < 0
        votes = tree.value[:, 0, :]
        columns.append(
            (
                np.where(leaf, -1, tree.feature),
                np.where(leaf, 0.0, tree.threshold),
                np.where(leaf, 0, tree.children_left + first),
                np.where(leaf, 0, tree.children_right + first),
                votes[:, 1] / votes.sum(axis=1),
            )
        )
        roots.append(first)
        first += tree.node_count
    feature, threshold, left, right, value = (np.concatenate(each) for each in zip(*columns, strict=True))
    return DecisionTrees(
        np.array(roots, np.int32), feature.astype(np.int16), threshold.astype(np.float32), left.astype(np.int32),
        right.astype(np.int32), value.astype(np.float32),
    )  # fmt: skip
