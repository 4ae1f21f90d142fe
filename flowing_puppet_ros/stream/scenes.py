# SPDX-License-Identifier: Apache-2.0
"""The people of successive clouds of a scene, each under an id that stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.body.people import ExtractionSettings, PersonCloud, extract_people

NEAR = 1.0
"""Metres that a person may move, or their cloud's middle may jump, from one cloud to the next."""
FORGOTTEN = 30
"""Clouds without a person after which their id is not given again."""


class ScenePeople:
    """Finds people and keeps their ids: the nearest known person within a metre is the same."""

    def __init__(self, settings: ExtractionSettings) -> None:
        self._settings = settings
        self._places: dict[str, NDArray[np.float64]] = {}
        self._unseen: dict[str, int] = {}
        self._count = 0

    def reset(self) -> None:
        """Forget everybody; ids begin anew."""
        self._places, self._unseen, self._count = {}, {}, 0

    def find(
        self,
        points: NDArray[np.float64],
        normals: NDArray[np.float64] | None,
        viewpoint: NDArray[np.float64] | None,
    ) -> list[tuple[str, PersonCloud]]:
        """Return (id, cloud) of the people in points (N,3) in metres, z up, the likeliest person first."""
        people = extract_people(points, normals, self._settings, viewpoint)
        middles = [np.median(person.points, axis=0) for person in people]
        known = list(self._places)
        pairs = sorted(
            (float(np.linalg.norm(middle - self._places[identity])), identity, index)
            for identity in known
            for index, middle in enumerate(middles)
        )
        given: dict[int, str] = {}
        for distance, identity, index in pairs:
            if distance < NEAR and index not in given and identity not in given.values():
                given[index] = identity
        for index in range(len(people)):
            if index not in given:
                self._count += 1
                given[index] = f"b{self._count}"
        for identity in known:
            self._unseen[identity] += 1
        for index, identity in given.items():
            self._places[identity], self._unseen[identity] = middles[index], 0
        for identity in [identity for identity, clouds in self._unseen.items() if clouds > FORGOTTEN]:
            del self._places[identity], self._unseen[identity]
        return [(given[index], person) for index, person in enumerate(people)]
