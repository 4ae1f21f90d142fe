# SPDX-License-Identifier: Apache-2.0
"""A forest of decision trees as arrays: the cheap filter of candidates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit


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
