# SPDX-License-Identifier: Apache-2.0
"""Diverse particle selection: keep the subset of particles that best preserves the messages a node sends (D-PMP).

Source: Pacheco, Zuffi, Black and Sudderth, Preserving Modes and Messages via Diverse Particle Selection, ICML 2014.
Choosing columns of the message foundation matrix so that the row maxima survive is facility location, a monotone
submodular function; the greedy choice is within 1 - 1/e of the best, and lazy evaluation makes it cheap (Minoux 1978).
"""

from __future__ import annotations

import numpy as np
from numba import njit


def select_diverse(foundation: np.ndarray, count: int, kept: int, temperature: float) -> np.ndarray:
    """Choose the columns that best preserve the row minima of a message foundation matrix.

    Every row is normalised by its own minimum before costs become weights, exp(-(cost - row minimum) / temperature),
    so that neighbours' particles of low probability keep their say; without it a few good rows take all particles.

    Args:
        foundation: (rows, candidates) costs, see `max_product.message_foundation`.
        count: how many columns to choose, at most `candidates`.
        kept: a column chosen in any case, normally the particle of the best configuration.
        temperature: cost difference at which a weight falls to 1/e.

    Returns:
        (count,) int64 column indices in the order of their choice, `kept` first.
    """
    candidates = foundation.shape[1]
    if not 0 < count <= candidates:
        raise ValueError(f"cannot choose {count} of {candidates} particles")
    weights = np.exp((foundation.min(axis=1, keepdims=True) - foundation) / temperature)
    return _lazy_greedy(np.ascontiguousarray(weights.T), count, kept)


@njit(cache=True, nogil=True)
def _lazy_greedy(weights: np.ndarray, count: int, first: int) -> np.ndarray:
    """Maximise sum over rows of the maximum over the chosen columns; `weights` is (candidates, rows)."""
    candidates, rows = weights.shape
    covered = weights[first].copy()
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = first
    bound = np.full(candidates, np.inf)
    bound[first] = -np.inf
    fresh = np.zeros(candidates, dtype=np.int64)
    for turn in range(1, count):
        while True:
            best = np.argmax(bound)
            if fresh[best] == turn:
                break
            gain = 0.0
            for row in range(rows):
                gain += max(0.0, weights[best, row] - covered[row])
            bound[best] = gain
            fresh[best] = turn
        chosen[turn] = best
        bound[best] = -np.inf
        for row in range(rows):
            covered[row] = max(covered[row], weights[best, row])
    return chosen
