# SPDX-License-Identifier: Apache-2.0
"""People whom nobody tracks yet: groups of views, one a camera, that show one person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.view import (
    MIN_COMMON_JOINTS,
    CalibratedView,
    measure_mismatch,
    measure_ray_mismatch,
)
from flowing_puppet_ros.multiview.triangulation import Expectation, TriangulationSettings, triangulate_plane

type Key = tuple[str, int]
"""A person in an image: the camera's name and the number in the camera's list."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewCluster:
    """Views of one person by camera, and joints (J, 3) m with confidence (J,) triangulated from them."""

    views: dict[str, int]
    joints: F64
    confidence: F64
    mismatch: float


def triangulate_views(
    views: Sequence[CalibratedView], settings: TriangulationSettings, expected: Expectation | None = None
) -> tuple[F64, F64]:
    """Return the joints (J, 3) m and confidences (J,) of the views' person; NaN and 0 where they do not agree."""
    plane = np.stack([view.plane for view in views])
    weights = np.stack([view.weight for view in views])
    return triangulate_plane([view.camera for view in views], plane, weights, settings, expected)


def drop_disagreeing(
    views: Mapping[str, CalibratedView], settings: AssociationSettings, triangulation: TriangulationSettings
) -> tuple[dict[str, CalibratedView], F64, F64]:
    """Return the views that agree on one person, with its joints (J, 3) m and confidences (J,).

    The view with the largest median distance from the joints is left out until none is beyond
    `settings.max_view_error`. Fewer than two views are left where nobody is: the joints are NaN then.
    """
    left = dict(views)
    count = len(next(iter(views.values())).weight) if views else 0
    while len(left) >= 2:
        joints, confidence = triangulate_views(list(left.values()), triangulation)
        errors = {name: _median_error(view, joints) for name, view in left.items()}
        worst = max(errors, key=lambda name: errors[name])
        if errors[worst] <= settings.max_view_error:
            return left, joints, confidence
        if len(left) == 2:
            break
        del left[worst]
    return {}, np.full((count, 3), np.nan), np.zeros(count)


def _median_error(view: CalibratedView, joints: F64) -> float:
    """Return the median distance (m) of a view's joints; joints on which no two views agree count as far away."""
    known = view.weight > 0
    distance = np.where(np.isfinite(joints).all(axis=1), view.measure_distances(joints), np.inf)[known]
    finite = np.isfinite(distance)
    if np.count_nonzero(finite) < MIN_COMMON_JOINTS:
        return np.inf
    return float(np.median(distance))


def find_clusters(
    people: Mapping[str, Sequence[CalibratedView]],
    free: set[Key],
    settings: AssociationSettings,
    triangulation: TriangulationSettings,
) -> list[ViewCluster]:
    """Return the people whom two or more of the `free` views show, those with most and best views first.

    Every pair of views that agrees proposes a person, to whom each other camera adds the view that fits best. Views
    are given to one person only.
    """
    pairs: list[tuple[float, Key, Key]] = []
    for one, other in combinations(sorted(free), 2):
        if one[0] == other[0]:
            continue
        mismatch = measure_ray_mismatch(
            people[one[0]][one[1]], people[other[0]][other[1]], settings.max_epipolar_distance
        )
        if mismatch < settings.max_mismatch:
            pairs.append((mismatch, one, other))
    proposals: list[ViewCluster] = []
    for _, one, other in sorted(pairs):
        # A pair within a person who was proposed already would grow into the same.
        if not any({one, other} <= set(cluster.views.items()) for cluster in proposals):
            cluster = _grow(people, free, one, other, settings, triangulation)
            proposals += [cluster] if cluster is not None else []
    proposals.sort(key=lambda cluster: (-len(cluster.views), cluster.mismatch))
    found: list[ViewCluster] = []
    taken: set[Key] = set()
    for cluster in proposals:
        keys = set(cluster.views.items())
        if not keys & taken:
            found.append(cluster)
            taken |= keys
    return found


def _grow(
    people: Mapping[str, Sequence[CalibratedView]],
    free: set[Key],
    one: Key,
    other: Key,
    settings: AssociationSettings,
    triangulation: TriangulationSettings,
) -> ViewCluster | None:
    """Return the person of two views and of the best views of other cameras; None if they do not agree."""
    chosen = dict([one, other])
    joints, _ = triangulate_views([people[name][index] for name, index in chosen.items()], triangulation)
    for name in sorted({key[0] for key in free} - set(chosen)):
        costs = {
            index: measure_mismatch(people[name][index], joints, settings.max_epipolar_distance)
            for camera, index in sorted(free)
            if camera == name
        }
        best = min(costs, key=lambda index: costs[index])
        if costs[best] < settings.max_mismatch:
            chosen[name] = best
    views = {name: people[name][index] for name, index in chosen.items()}
    agreeing, joints, confidence = drop_disagreeing(views, settings, triangulation)
    if len(agreeing) < 2 or np.count_nonzero(confidence) < MIN_COMMON_JOINTS:
        return None
    mismatch = np.mean([measure_mismatch(view, joints, settings.max_epipolar_distance) for view in agreeing.values()])
    return ViewCluster({name: chosen[name] for name in agreeing}, joints, confidence, float(mismatch))
