# SPDX-License-Identifier: Apache-2.0
"""Follows people in space through the people whom the cameras track, and keeps their ids.

At each instant, tracked people claim the views that fit their predicted joints, one a camera; what remains is grouped
by epipolar distance into people who are new or have come back. A person is never made of views that disagree, and a
joint never of a view in which it lies on somebody else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.assignment import assign_cheapest
from flowing_puppet_ros.multiview.association.clusters import (
    Key,
    ViewCluster,
    drop_disagreeing,
    find_clusters,
    triangulate_views,
)
from flowing_puppet_ros.multiview.association.exchange import ExchangedLimbs, find_sides, measure_either_mismatch
from flowing_puppet_ros.multiview.association.identity import choose_returning
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.track_3d import PersonTrack3D, find_bones
from flowing_puppet_ros.multiview.association.view import (
    MIN_COMMON_JOINTS,
    CalibratedView,
    PersonInView,
    calibrate_views,
)
from flowing_puppet_ros.multiview.association.weights import doubt_hidden_joints, doubt_joints_on_others
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings

_MEMBER_BONUS = 0.15  # in mismatch, for the view that was this person's in the set before
_MAX_UNSEEN_S = 0.7  # after which the predicted place no longer claims views
_MIN_PEOPLE_DISTANCE_M = 0.25  # median over the joints, below which two people are one


@dataclass(frozen=True, slots=True, eq=False)
class PersonInSpace:
    """One person at one instant.

    Attributes:
        id: b1, b2, ... in the order in which people were first seen.
        joints: (J, 3) m, NaN where fewer than two views agree.
        confidence: (J,) in [0, 1], 0 where fewer than two views agree.
        views: camera -> number of the person in the camera's list.
        weights: camera -> (J,) confidence of the joints in that view, 0 where they are not this person's.
        seen: camera -> the person in that view, with left and right as in space.
    """

    id: str
    joints: F64
    confidence: F64
    views: dict[str, int]
    weights: dict[str, F64]
    seen: dict[str, PersonInView]


class PeopleTracker3D:
    """People in space over time; `step` takes the people of all cameras at one instant. Deterministic and causal."""

    def __init__(
        self,
        names: Sequence[str],
        settings: AssociationSettings | None = None,
        triangulation: TriangulationSettings | None = None,
    ) -> None:
        """Start without people, whose joints are called `names`."""
        self.names = tuple(names)
        self.settings = settings or AssociationSettings()
        self.triangulation = triangulation or TriangulationSettings()
        self._bones = find_bones(self.names)
        self._sides = find_sides(self.names)
        self._tracks: list[PersonTrack3D] = []
        # Pairs of (camera, id in it) that agreed in the last set and this one -> in how many sets so far.
        self._candidates: dict[frozenset[tuple[str, str]], int] = {}
        self._fresh: dict[frozenset[tuple[str, str]], int] = {}
        self._count = 0

    def reset(self) -> None:
        """Forget everybody; ids go on."""
        self._tracks.clear()
        self._candidates.clear()

    def step(
        self, stamp: int, cameras: Mapping[str, Camera], people: Mapping[str, Sequence[PersonInView]]
    ) -> list[PersonInSpace]:
        """Return the people whom at least two cameras see at `stamp` (ns), in the order of their ids.

        `people` has the tracked people of every camera, with the joints of this tracker in each. Those whom one camera
        alone sees are in no result.
        """
        horizon = stamp - round(self.settings.memory * 1e9)
        self._tracks = [track for track in self._tracks if track.stamp >= horizon]
        views = calibrate_views(cameras, people, self.triangulation.min_confidence)
        claimed = self._claim(stamp, views)
        found: dict[str, tuple[PersonTrack3D, dict[str, int]]] = {}
        free: set[Key] = {(name, k) for name, group in views.items() for k in range(len(group))}
        for track, chosen in claimed:
            own = {name: views[name][k] for name, k in chosen.items()}
            for name, view in track.exchanged.correct(own, track.predict(stamp)).items():
                views[name][chosen[name]] = view
            agreeing, joints, _ = drop_disagreeing(
                {name: views[name][k] for name, k in chosen.items()}, self.settings, self.triangulation
            )
            if len(agreeing) >= 2 and np.isfinite(joints).all(axis=1).sum() >= MIN_COMMON_JOINTS:
                found[track.id] = track, {name: chosen[name] for name in agreeing}
                free -= set(found[track.id][1].items())
        self._fresh = {}
        for cluster in find_clusters(views, free, self.settings, self.triangulation):
            joined = self._place(stamp, cluster, views, found)
            if joined is not None:
                found[joined.id] = joined, cluster.views
        self._candidates = self._fresh
        return self._finish(stamp, views, found)

    def _claim(
        self, stamp: int, views: Mapping[str, Sequence[CalibratedView]]
    ) -> list[tuple[PersonTrack3D, dict[str, int]]]:
        """Return the views that tracked people claim by where they are expected, one a camera and person."""
        tracks = [track for track in self._tracks if stamp - track.stamp <= _MAX_UNSEEN_S * 1e9]
        claims: list[dict[str, int]] = [{} for _ in tracks]
        expected = [track.predict(stamp) for track in tracks]
        for name, group in views.items():
            if not (tracks and group):
                continue
            cost = np.array(
                [
                    [
                        measure_either_mismatch(view, joints, self.settings.max_joint_distance, self._sides)
                        - _MEMBER_BONUS * (track.members.get(name) == view.person.id)
                        for view in group
                    ]
                    for track, joints in zip(tracks, expected, strict=True)
                ]
            )
            limit = self.settings.max_mismatch
            for row, column in zip(*assign_cheapest(np.minimum(cost, limit)), strict=True):
                if cost[row, column] < limit:
                    claims[row][name] = int(column)
        return list(zip(tracks, claims, strict=True))

    def _place(
        self,
        stamp: int,
        cluster: ViewCluster,
        views: Mapping[str, Sequence[CalibratedView]],
        found: Mapping[str, tuple[PersonTrack3D, dict[str, int]]],
    ) -> PersonTrack3D | None:
        """Return the track of a group of views that nobody claims: one who came back or a new one; None if in doubt."""
        if any(self._is_same_place(stamp, track, cluster) for track, _ in found.values()):
            return None  # a second observation of somebody in the same images
        seen = {name: views[name][k].person for name, k in cluster.views.items()}
        others = [track for track in self._tracks if track.id not in found]
        track = choose_returning(stamp, others, seen, cluster.joints)
        if track is not None:
            track.relocate(stamp, cluster.joints)
            return track
        if len(found) >= self.settings.max_people or not self._is_confirmed(cluster, seen, views):
            return None
        self._count += 1
        track = PersonTrack3D(f"b{self._count}", cluster.joints.copy(), stamp, bones=self._bones)
        track.exchanged = ExchangedLimbs(self.names)
        self._tracks.append(track)
        return track

    def _is_same_place(self, stamp: int, track: PersonTrack3D, cluster: ViewCluster) -> bool:
        distance = np.linalg.norm(track.predict(stamp) - cluster.joints, axis=1)
        return bool(np.nanmedian(distance) < _MIN_PEOPLE_DISTANCE_M) if np.isfinite(distance).any() else False

    def _is_confirmed(
        self,
        cluster: ViewCluster,
        seen: Mapping[str, PersonInView],
        views: Mapping[str, Sequence[CalibratedView]],
    ) -> bool:
        """Return whether views are a person: at once where nobody else is in view, else after some sets."""
        if all(len(group) <= 1 for group in views.values()):
            return True
        # Two views stay the same pair although a third one comes and goes.
        keys = [frozenset({(name, seen[name].id) for name in pair}) for pair in _pairs(list(cluster.views))]
        counts = [self._candidates.get(key, 0) + 1 for key in keys]
        self._fresh |= dict(zip(keys, counts, strict=True))
        return max(counts) >= self.settings.confirm_sets

    def _finish(
        self,
        stamp: int,
        views: Mapping[str, Sequence[CalibratedView]],
        found: Mapping[str, tuple[PersonTrack3D, dict[str, int]]],
    ) -> list[PersonInSpace]:
        """Triangulate everybody without the joints that lie on others, and remember them."""
        expected = {identity: track.expect(stamp) for identity, (track, _) in found.items()}
        result = []
        for identity, (track, chosen) in found.items():
            own = {name: views[name][k] for name, k in chosen.items()}
            others = [each.joints for other, each in expected.items() if other != identity]
            cleaned = self._clean(own, expected[identity].joints, others)
            joints, confidence = triangulate_views(list(cleaned.values()), self.triangulation, expected[identity])
            track.update(stamp, joints)
            track.members = {name: view.person.id for name, view in own.items()}
            for name, view in own.items():
                key = name, view.person.id
                track.votes[key] = track.votes.get(key, 0) + 1
                if view.person.colours is not None:
                    track.colours[name] = view.person.colours
            weights = {name: view.weight for name, view in cleaned.items()}
            seen = {name: view.person for name, view in cleaned.items()}
            result.append(PersonInSpace(identity, joints, confidence, chosen, weights, seen))
        return sorted(result, key=lambda person: int(person.id[1:]))

    def _clean(
        self, views: Mapping[str, CalibratedView], expected: F64, others: Sequence[F64]
    ) -> dict[str, CalibratedView]:
        """Return a person's views without joints that are not its own, and with doubt in those that are hidden."""
        return {
            name: doubt_hidden_joints(doubt_joints_on_others(view, expected, others), expected, others, self._bones)
            for name, view in views.items()
        }


def _pairs(names: list[str]) -> list[tuple[str, str]]:
    return [(one, other) for i, one in enumerate(names) for other in names[i + 1 :]]
