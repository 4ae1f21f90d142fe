# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the hand maps: the rank of true wrists among random places near the person."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.image.likelihood import Ranks
from flowing_puppet_ros.evidence.image.hands import EXTRAS, SPEED_SCALE_M, HandDetectors, HandMaps, hand_score
from flowing_puppet_ros.evidence.image.likelihood import PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.learn.likelihood.samples import PosedPerson
from flowing_puppet_ros.learn.thesis_loop.hand_samples import find_wrists, make_maps, sample_wrong_places
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

MIN_MOTION_M = 0.015  # per frame; hands that move less are at rest


def rank_wrists(
    model: DeformableStructures, detectors: HandDetectors, people: Iterable[PosedPerson], wrong: int, seed: int
) -> dict[str, dict[str, Ranks]]:
    """Rank wrists among `wrong` random places, for all hands and for those that move according to the flow.

    The measures are each map (its maximum over orientations), each detector along the forearm, and `hand_score`.
    Forearms to random places start at the true elbow.
    """
    likelihood, optical_flow = PartLikelihood.load(), OpticalFlow()
    rng = np.random.default_rng(seed)
    places: dict[str, dict[str, list[float]]] = {"all hands": {}, "moving hands": {}}
    for posed in people:
        maps = make_maps(posed, likelihood, optical_flow, detectors)
        for wrist, elbow in find_wrists(model, posed):
            others = sample_wrong_places(model, posed, wrong, rng)
            if len(others) < wrong:
                continue
            candidates = np.concatenate([wrist[None], others])
            groups = ["all hands"] + ["moving hands"] * _is_moving(maps, wrist)
            for measure, score in _score_candidates(maps, candidates, elbow).items():
                better = np.sum(score[1:] > score[0]) + 0.5 * np.sum(score[1:] == score[0])
                for group in groups:
                    places[group].setdefault(measure, []).append(float(better))
    return {
        group: {measure: Ranks(np.array(found), wrong) for measure, found in measures.items()}
        for group, measures in places.items()
    }


def _score_candidates(maps: HandMaps, candidates: Array, elbow: Array) -> dict[str, Array]:
    along = candidates - elbow
    angle = np.arctan2(along[:, 1], along[:, 0])
    scores = {}
    for kind in EXTRAS:
        if kind in maps.fields:
            scores[f"{kind} map"] = maps.best_orientation(kind, candidates)[0]
            scores[f"{kind} along the forearm"] = maps.log_odds(kind, candidates, angle)
    return scores | {"hand_score": hand_score(maps, candidates, np.broadcast_to(elbow, along.shape), maps.scale)}


def _is_moving(maps: HandMaps, wrist: Array) -> bool:
    """Return whether the flow near a wrist differs from the background's."""
    if "flow" not in maps.fields:
        return False
    field = maps.fields["flow"]
    height, width = field.extras.shape[:2]
    x, y = np.clip(np.rint(wrist * field.level.scale), 0, (width - 1, height - 1)).astype(int)
    speed = field.extras[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3, 1]
    return bool(speed.mean() > 1 - np.exp(-MIN_MOTION_M / SPEED_SCALE_M))
