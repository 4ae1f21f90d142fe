# SPDX-License-Identifier: Apache-2.0
"""Two people who cross, and one who is hidden for ten images, keep their ids."""

from __future__ import annotations

import numpy as np
from drawn_people import detection, draw, pose, tracker  # type: ignore[import-not-found]

Place = tuple[float, float]


def whose(result: object, truth: dict[str, np.ndarray]) -> dict[str, str]:
    """Name -> id of the puppet nearest to each person's joints."""
    puppets = result.puppets  # type: ignore[attr-defined]
    found = {}
    for name, joints in truth.items():
        near = min(puppets, key=lambda puppet: float(np.linalg.norm(puppet.joints - joints, axis=1).mean()))
        found[name] = near.id
    return found


def test_people_who_cross_keep_their_ids() -> None:
    follower = tracker()
    ids = {}
    for time in range(21):
        left, right = pose(0, (60 + 10 * time, 118)), pose(0, (260 - 10 * time, 122))
        result = follower.step(draw(left, right), time, [detection(left), detection(right)])
        if time == 0:
            ids = whose(result, {"left": left, "right": right})
    assert len(set(ids.values())) == 2
    assert whose(result, {"left": left, "right": right}) == ids


def test_who_is_hidden_for_ten_images_keeps_the_id() -> None:
    follower = tracker()
    ids = {}
    for time in range(22):
        still, passing = pose(0, (160, 118)), pose(0, (10 + 14 * time, 120))
        hidden = 6 <= time < 16
        seen = [detection(passing)] if hidden else [detection(still), detection(passing)]
        result = follower.step(draw(still, passing), time, seen)
        if time == 0:
            ids = whose(result, {"still": still, "passing": passing})
    assert whose(result, {"still": still, "passing": passing}) == ids
    assert len(result.puppets) == 2
