# SPDX-License-Identifier: Apache-2.0
"""Views in which a person's left and right limbs are exchanged: decided over whole limbs and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, I64
from flowing_puppet_ros.multiview.association.view import CalibratedView, measure_mismatch

_GROUPS = (("shoulder", "elbow", "wrist", "hand"), ("hip", "knee", "ankle", "foot"))
_MAX_DISTANCE_M = 0.30  # at which a joint no longer speaks for or against
_MEMORY = 0.7  # of what was found in the sets before
_FITS = 0.3  # in mismatch, below which nobody asks whether sides are exchanged
_EXCHANGE_COST = 0.1  # in mismatch
_MIN_EVIDENCE = 0.8  # joints by which the exchanged limbs must fit better, to be exchanged or to stay so


@dataclass(slots=True, eq=False)
class ExchangedLimbs:
    """Whether arms and legs of one person are exchanged, by camera; `names` are those of the joints."""

    names: Sequence[str]
    _evidence: dict[tuple[str, int], float] = field(default_factory=dict)

    def correct(self, views: Mapping[str, CalibratedView], expected: F64) -> dict[str, CalibratedView]:
        """Return the views with left and right as they fit the joints (J, 3) m `expected`, NaN where unknown."""
        corrected = dict(views)
        for name, view in views.items():
            for number, group in enumerate(find_sides(self.names)):
                gain = _compare(view, expected, group)
                evidence = _MEMORY * self._evidence.get((name, number), 0.0) + gain
                self._evidence[name, number] = evidence
                # Over time, but not against what this image shows.
                if evidence > _MIN_EVIDENCE and gain > 0:
                    corrected[name] = _exchange(corrected[name], group)
        return corrected


def measure_either_mismatch(view: CalibratedView, joints: F64, max_distance: float, groups: Sequence[I64]) -> float:
    """Return how badly a view fits joints (J, 3) m, as `measure_mismatch` does, with left and right as they fit better.

    `groups` are those of `find_sides`.
    """
    plain = measure_mismatch(view, joints, max_distance)
    if plain < _FITS:
        return plain
    for group in groups:
        view = _exchange(view, group)
    return min(plain, measure_mismatch(view, joints, max_distance) + _EXCHANGE_COST)


def find_sides(names: Sequence[str]) -> list[I64]:
    """Return for arms and for legs the pairs (P, 2) of places of the left and right joints in `names`."""
    place = {name: index for index, name in enumerate(names)}
    return [
        np.array(
            [
                (place[f"left_{each}"], place[f"right_{each}"])
                for each in group
                if {f"left_{each}", f"right_{each}"} <= place.keys()
            ],
            np.int64,
        ).reshape(-1, 2)
        for group in _GROUPS
    ]


def _compare(view: CalibratedView, expected: F64, group: I64) -> float:
    """Return by how many joints' worth the exchanged limbs of a view fit what is expected better than its own."""
    both = group.ravel()
    swapped = group[:, ::-1].ravel()
    plain, other = _exchange_arrays(view, group)
    own, exchanged = (
        view.measure_distances(expected),
        replace(view, plane=plain, weight=other).measure_distances(expected),
    )
    known = np.isfinite(own[both]) & np.isfinite(exchanged[both])
    costs = [np.minimum(np.nan_to_num(each[both]) / _MAX_DISTANCE_M, 1.0) ** 2 for each in (own, exchanged)]
    weight = np.sqrt(view.weight[both] * view.weight[swapped]) * known
    return float((weight * (costs[0] - costs[1])).sum())


def _exchange(view: CalibratedView, group: I64) -> CalibratedView:
    here, there = group.ravel(), group[:, ::-1].ravel()
    joints, confidence, rays = view.person.joints.copy(), view.person.confidence.copy(), view.rays.copy()
    joints[here], confidence[here], rays[here] = (
        view.person.joints[there],
        view.person.confidence[there],
        view.rays[there],
    )
    plane, weight = _exchange_arrays(view, group)
    person = replace(view.person, joints=joints, confidence=confidence)
    return replace(view, person=person, plane=plane, weight=weight, rays=rays)


def _exchange_arrays(view: CalibratedView, group: I64) -> tuple[F64, F64]:
    plane, weight = view.plane.copy(), view.weight.copy()
    plane[group.ravel()] = view.plane[group[:, ::-1].ravel()]
    weight[group.ravel()] = view.weight[group[:, ::-1].ravel()]
    return plane, weight
