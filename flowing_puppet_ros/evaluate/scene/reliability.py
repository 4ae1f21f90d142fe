# SPDX-License-Identifier: Apache-2.0
"""Whether the confidence of a body is how often such bodies are right: a person, with the joints within 10 cm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowing_puppet_ros.evaluate.scene.scene_score import GhostScore, PersonScore

CLOSE_M = 0.10  # mean error of the joints of a body that is right
BIN_EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def tabulate_reliability(people: Sequence[PersonScore], ghosts: Sequence[GhostScore]) -> list[dict[str, float | str]]:
    """Tabulate by the confidence of bodies how many are right; people whose joints are not known are left out."""
    known = [person for person in people if person.found and np.isfinite(person.joint_error)]
    if not known:
        return []
    confidence = np.array([person.confidence for person in known] + [ghost.confidence for ghost in ghosts])
    right = np.array([person.joint_error < CLOSE_M for person in known] + [False] * len(ghosts))
    place = np.digitize(confidence, BIN_EDGES[1:-1])
    rows: list[dict[str, float | str]] = []
    for k in range(len(BIN_EDGES) - 1):
        own = place == k
        if own.any():
            rows.append(
                {
                    "confidence": f"{BIN_EDGES[k]} to {BIN_EDGES[k + 1]}",
                    "bodies": int(own.sum()),
                    "mean_confidence": float(confidence[own].mean()),
                    "right_share": float(right[own].mean()),
                }
            )
    return rows
