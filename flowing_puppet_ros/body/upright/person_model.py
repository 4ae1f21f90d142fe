# SPDX-License-Identifier: Apache-2.0
"""What was learned about people in scans: a filter of candidates, a judge of fits, and how sure both can be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit

from flowing_puppet_ros.body.upright.verification import EVIDENCE_NAMES, FitEvidence
from flowing_puppet_ros.model import weights

UPRIGHT, POSED = "clouds", "posed"
"""Names of the shipped files: of people who stand or walk, and of those who sit, bend or crouch."""
MIN_ODDS, MAX_ODDS = 0.02, 0.98  # of each forest
ACCURACY_NAMES = (
    "cost", "distance", "supported", "explained", "hidden", "log_points", "confidence", "stature", "foreign", "lowest",
)  # fmt: skip
"""Evidence that tells how close the joints are; how low the lowest point is tells whether the legs are seen."""
_ACCURACY_COLUMNS = [EVIDENCE_NAMES.index(name) for name in ACCURACY_NAMES]


@dataclass(frozen=True, slots=True, eq=False)
class DecisionTrees:
    """Trees one after the other; a leaf has no feature (-1).

    Attributes:
        roots: (T,) node of each root.
        feature: (N,) int, that a node compares.
        threshold: (N,) up to which its left branch is taken.
        left, right: (N,) nodes.
        value: (N,) probability at a leaf.
    """

    roots: np.ndarray
    feature: np.ndarray
    threshold: np.ndarray
    left: np.ndarray
    right: np.ndarray
    value: np.ndarray

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], forest: str) -> DecisionTrees:
        """Take the arrays of a `forest`, which are named as the attributes."""
        return cls(*(np.ascontiguousarray(arrays[f"{forest}_{name}"]) for name in cls.__slots__))

    def to_arrays(self, forest: str) -> dict[str, np.ndarray]:
        """Return what `from_arrays` takes."""
        return {f"{forest}_{name}": getattr(self, name) for name in self.__slots__}

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Return the mean probability (C,) of the trees for features (C, F)."""
        return _predict(
            np.ascontiguousarray(features, dtype=np.float64),
            self.roots,
            self.feature,
            self.threshold,
            self.left,
            self.right,
            self.value,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PersonModel:
    """What was learned.

    Attributes:
        trees: of the filter, over what a candidate looks like.
        judge: trees over the evidence of a fit.
        calibration: (2,) by which the judge's log odds count, and a constant.
        accuracy: (len(ACCURACY_NAMES) + 1,) weights of evidence, and a constant: log odds that the joints of a person
            are within 10 cm in the mean.
    """

    trees: DecisionTrees
    judge: DecisionTrees
    calibration: np.ndarray
    accuracy: np.ndarray

    @classmethod
    @lru_cache(maxsize=2)
    def load(cls, name: str = UPRIGHT) -> PersonModel:
        """Load a shipped model."""
        return cls.from_arrays(weights.load("people", name))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PersonModel:
        """Take the arrays of a file."""
        filters, judge = (DecisionTrees.from_arrays(arrays, name) for name in ("trees", "judge"))
        return cls(filters, judge, arrays["calibration"], arrays["accuracy"])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what `from_arrays` takes."""
        return (
            self.trees.to_arrays("trees")
            | self.judge.to_arrays("judge")
            | {"calibration": self.calibration, "accuracy": self.accuracy}
        )

    def judge_fit(self, evidence: FitEvidence, odds: float = 0.0) -> float:
        """Return the probability of a person by the evidence of a fit, and by other log odds."""
        judged = log_odds(self.judge.predict(evidence.values[None])[0])
        return float(_logistic(calibrate_odds(judged, self.calibration) + odds))

    def rate(self, probability: float, evidence: FitEvidence) -> float:
        """Return the probability that a body is a person whose joints are within 10 cm in the mean."""
        return probability * float(_logistic(select_accuracy(evidence.values) @ self.accuracy[:-1] + self.accuracy[-1]))


def log_odds(probability: np.ndarray | float) -> np.ndarray:
    """Return the log odds of a forest's probabilities, which are never quite sure."""
    odds = np.clip(probability, MIN_ODDS, MAX_ODDS)
    return np.asarray(np.log(odds / (1 - odds)))


def calibrate_odds(judged: np.ndarray, calibration: np.ndarray) -> np.ndarray:
    """Return the log odds of a person by those of the judge."""
    return np.asarray(calibration[0] * judged + calibration[1])


def select_accuracy(evidence: np.ndarray) -> np.ndarray:
    """Return the evidence (..., len(ACCURACY_NAMES)) that tells about the joints."""
    return evidence[..., _ACCURACY_COLUMNS]


def _logistic(odds: np.ndarray | float) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-odds)))


@njit(cache=True, nogil=True)
def _predict(features, roots, feature, threshold, left, right, value):  # type: ignore[no-untyped-def]
    result = np.zeros(len(features))
    for row in range(len(features)):
        for root in roots:
            node = root
            while feature[node] >= 0:
                node = left[node] if features[row, feature[node]] <= threshold[node] else right[node]
            result[row] += value[node]
    return result / len(roots)
