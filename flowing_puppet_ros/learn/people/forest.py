# SPDX-License-Identifier: Apache-2.0
"""Learn the filter's trees and the weights of a fit's evidence from examples."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowing_puppet_ros.body.upright.decision_trees import DecisionTrees
from flowing_puppet_ros.body.upright.person_finder import PersonModel
from flowing_puppet_ros.learn.people.examples import CandidateExamples

TREES, MAX_DEPTH, MIN_LEAF_EXAMPLES = 80, 9, 3
REGULARISATION = 1.0  # of the logistic regression


def learn_model(examples: CandidateExamples, seed: int) -> PersonModel:
    """Learn from examples; the same examples and seed give the same model."""
    from sklearn.ensemble import ExtraTreesClassifier
    from sklearn.linear_model import LogisticRegression

    forest = ExtraTreesClassifier(
        TREES,
        max_depth=MAX_DEPTH,
        min_samples_leaf=MIN_LEAF_EXAMPLES,
        class_weight="balanced",
        random_state=seed,
    ).fit(examples.shape, examples.is_person)
    fitted = np.isfinite(examples.evidence).all(axis=1)
    evidence, truth = examples.evidence[fitted], examples.is_person[fitted]
    mean, scale = evidence.mean(axis=0), np.maximum(evidence.std(axis=0), 1e-9)
    judge = LogisticRegression(C=REGULARISATION, class_weight="balanced").fit((evidence - mean) / scale, truth)
    return PersonModel(_flatten(forest), mean, scale, np.append(judge.coef_[0], judge.intercept_))


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
        np.array(roots, np.int32), feature.astype(np.int16), threshold, left.astype(np.int32), right.astype(np.int32),
        value,
    )  # fmt: skip
