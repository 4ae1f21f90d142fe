# SPDX-License-Identifier: Apache-2.0
"""Two people who cross, and one who is hidden for ten images, keep their ids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_people import NAMES, CapsuleModel, detection, draw, pose, tracker  # type: ignore[import-not-found]

from flowing_puppet_ros.image.tracking.appearance import torso_appearances
from flowing_puppet_ros.image.tracking.association import associate
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.track import Track

pytestmark = pytest.mark.slow

Place = tuple[float, float]


def match_ids(result: object, truth: dict[str, np.ndarray]) -> dict[str, str]:
    """Map each name to the id of the puppet nearest to the joints."""
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
            ids = match_ids(result, {"left": left, "right": right})
    assert len(set(ids.values())) == 2
    assert match_ids(result, {"left": left, "right": right}) == ids


@pytest.mark.parametrize(("apart", "exchange"), [(0, 99), (20, 10)])
def test_a_detectors_ids_help_where_people_meet_but_not_where_they_are_apart(apart: int, exchange: int) -> None:
    """In equal clothes at one place only the ids tell; 12 cm apart, ids that are exchanged do not matter."""
    follower, chance = tracker(), np.random.default_rng(1)
    ids = {}
    for time in range(21):
        left, right = pose(0, (60 + 10 * time, 120 - apart / 2)), pose(0, (260 - 10 * time, 120 + apart / 2))
        names = ("7", "8") if time < exchange else ("8", "7")
        seen = [
            replace(detection(joints + chance.normal(0, 4, joints.shape)), track_id=name)
            for joints, name in zip((left, right), names, strict=True)
        ]
        result = follower.step(draw(left, right), time, seen)
        if time == 0:
            ids = match_ids(result, {"left": left, "right": right})
    assert len(set(ids.values())) == 2
    assert match_ids(result, {"left": left, "right": right}) == ids


def test_a_person_hidden_for_ten_images_keeps_the_id() -> None:
    follower = tracker()
    ids = {}
    for time in range(22):
        still, passing = pose(0, (160, 118)), pose(0, (10 + 14 * time, 120))
        hidden = 6 <= time < 16
        seen = [detection(passing)] if hidden else [detection(still), detection(passing)]
        result = follower.step(draw(still, passing), time, seen)
        if time == 0:
            ids = match_ids(result, {"still": still, "passing": passing})
    assert match_ids(result, {"still": still, "passing": passing}) == ids
    assert len(result.puppets) == 2


RED, BLUE = (1.0, 0.35, 0.3), (0.3, 0.4, 1.0)


@pytest.mark.parametrize("behind", ["left", "right"])
@pytest.mark.parametrize("meeting", ["cross", "turn back"])
def test_people_in_different_clothes_keep_their_ids_where_one_hides_the_other(meeting: str, behind: str) -> None:
    """The detector sees one of two for as long as they overlap; the flow of the nearer one drags the other along."""
    follower = tracker()
    shirts = {"left": RED, "right": BLUE}
    order = [behind, "right" if behind == "left" else "left"]
    ids: dict[str, str] = {}
    for time in range(25):
        way = 8.0 * (time if meeting == "cross" else min(time, 24 - time))
        places = {"left": (64 + way, 118), "right": (256 - way, 121)}
        people = {name: pose(0, place) for name, place in places.items()}
        image = draw(*(people[name] for name in order), shirts=[shirts[name] for name in order])
        hidden = abs(places["left"][0] - places["right"][0]) < 70
        seen = [detection(people[name]) for name in (order[1:] if hidden else order)]
        result = follower.step(image, time, seen)
        if time == 3:
            ids = match_ids(result, people)
    assert len(set(ids.values())) == 2
    assert match_ids(result, people) == ids
    assert len(result.puppets) == 2


def test_at_equal_distance_the_appearance_decides_who_was_detected() -> None:
    """Joints alone would swap the detections, by a few millimetres."""
    image = draw(pose(0, (90, 118)), pose(0, (230, 118)), shirts=[RED, BLUE])
    red, blue = torso_appearances(NAMES, image, [pose(0, (90, 118)), pose(0, (230, 118))])
    assert red is not None and blue is not None
    model, joints = CapsuleModel(), pose(0)
    people = [Track.start(name, model, joints, np.ones(len(joints)), TrackerSettings()) for name in ("red", "blue")]  # type: ignore[arg-type]
    people[1].mean += 0.5
    found = [(people[1].mean + 0.2, np.ones(len(joints))), (joints - 0.2, np.ones(len(joints)))]
    assert associate(people, found, 0.5)[0] == {0: 1, 1: 0}
    for person, appearance in zip(people, (red, blue), strict=True):
        person.update_appearance(appearance.colours)
    assert associate(people, found, 0.5, [red, blue])[0] == {0: 0, 1: 1}
    assert associate(people, found, 0.5, [blue, red])[0] == {0: 1, 1: 0}
