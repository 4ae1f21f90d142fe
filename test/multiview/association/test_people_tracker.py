# SPDX-License-Identifier: Apache-2.0
"""People who walk, cross, hide one another, leave and come back: ids and joints against the known ones."""

import itertools

import numpy as np
import pytest
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.multiview.association.people_tracker import PeopleTracker3D, PersonInSpace
from flowing_puppet_ros.multiview.association.view import PersonInView

RATE = 30.0
CAMERAS = ring()


def crossing(t: float) -> dict[str, F64]:
    """Return three people on lines that cross near the middle at 2 s, 40 cm from one another."""
    s = t - 2.0
    return {
        "ann": walker((1.1 * s, 0.25), 0.0, 6 * t, 1.62),
        "bob": walker((-1.0 * s, -0.2), np.pi, 6 * t + 1, 1.85),
        "cem": walker((0.3, 0.9 * s + 0.1), np.pi / 2, 6 * t + 2, 1.74),
    }


def nearest(people: dict[str, F64], joints: F64) -> tuple[str, float]:
    """Return whose joints are nearest, and their mean distance (m)."""
    distance = {name: float(np.nanmean(np.linalg.norm(each - joints, axis=1))) for name, each in people.items()}
    best = min(distance, key=lambda name: distance[name])
    return best, distance[best]


@pytest.mark.slow
def test_three_people_who_cross_keep_their_ids_and_their_joints() -> None:
    """The cameras' own ids are as bad as can be: they change at random in every image."""
    random, tracker = np.random.default_rng(3), PeopleTracker3D(NAMES)
    owner: dict[str, set[str]] = {}
    errors, sets = [], 0
    for k in range(120):
        people = crossing(k / RATE)
        seen = photograph(CAMERAS, people, 3.0, random)
        numbers = itertools.count()
        seen = {
            name: [
                PersonInView(f"n{next(numbers)}", p.joints, p.confidence) for p in random.permutation(np.array(group))
            ]
            for name, group in seen.items()
        }
        for person in tracker.step(round(k / RATE * 1e9), CAMERAS, seen):
            who, _ = nearest(people, person.joints)
            owner.setdefault(person.id, set()).add(who)
            errors.append(np.linalg.norm(person.joints - people[who], axis=1))
            sets += 1
    assert sorted(owner) == ["b1", "b2", "b3"]
    assert sorted(map(len, owner.values())) == [1, 1, 1] and len(set.union(*owner.values())) == 3
    assert sets > 0.97 * 3 * 117
    placed = np.concatenate(errors)
    assert np.isfinite(placed).mean() > 0.9
    assert np.nanmean(placed) < 0.02 and np.nanpercentile(placed, 99) < 0.08


def run(
    tracker: PeopleTracker3D, times: np.ndarray, people_at: object, noise: float = 1.0
) -> list[list[PersonInSpace]]:
    random = np.random.default_rng(0)
    assert callable(people_at)
    return [tracker.step(round(t * 1e9), CAMERAS, photograph(CAMERAS, people_at(t), noise, random)) for t in times]


def test_who_leaves_and_comes_back_has_the_same_id_and_a_stranger_has_another() -> None:
    def people_at(t: float) -> dict[str, F64]:
        found = {"ann": walker((0.8, 0.5), 0.0, 6 * t, 1.6)}
        if t < 1 or 2 < t < 3:
            found["bob"] = walker((-1.0, -0.8 + 0.2 * t), np.pi / 2, 5 * t, 1.85)
        if t > 3.5:
            found["eva"] = walker((-1.0, -0.2), np.pi / 2, 5 * t, 1.4)
        return found

    results = run(PeopleTracker3D(NAMES), np.arange(0, 4.5, 0.1), people_at)
    ids = {t: [person.id for person in result] for t, result in zip(range(45), results, strict=True)}
    assert len(ids[8]) == 2 and ids[15] == [ids[8][0] if nearest_is_ann(results[8][0]) else ids[8][1]]
    assert ids[28] == ids[8]
    assert set(ids[44]) - set(ids[8]) == {"b3"}


def nearest_is_ann(person: PersonInSpace) -> bool:
    return bool(np.nanmean(person.joints[:, 0]) > 0)


def test_somebody_in_one_camera_only_stays_there() -> None:
    random, tracker = np.random.default_rng(1), PeopleTracker3D(NAMES)
    for k in range(10):
        people = {"ann": walker((0.0, 0.0), 0.0, k / 5)}
        seen = photograph(CAMERAS, people, 1.0, random)
        ghost = photograph({"cam1": CAMERAS["cam1"]}, {"zoe": walker((-1.5, 1.0), 1.0, k / 5)}, 1.0, random)
        seen["cam1"] += ghost["cam1"]
        found = tracker.step(k * 10**8, CAMERAS, seen)
    assert [person.id for person in found] == ["b1"]
    assert seen["cam1"][found[0].views["cam1"]].id == "ann"


def test_nobody_is_made_of_two_people() -> None:
    """Each camera sees one person, but not the same: no two views may be joined."""
    random = np.random.default_rng(2)
    places = {"cam1": (0.0, 0.0), "cam2": (1.5, 0.0), "cam3": (-1.5, 1.0), "cam4": (0.5, -1.5)}
    tracker = PeopleTracker3D(NAMES)
    for k in range(5):
        seen: dict[str, list[PersonInView]] = {}
        for name, place in places.items():
            seen |= photograph({name: CAMERAS[name]}, {"x": walker(place, 0.7, k / 5)}, 1.0, random)
        assert tracker.step(k * 10**8, CAMERAS, seen) == []


def test_a_joint_that_a_camera_puts_on_somebody_else_is_not_used() -> None:
    random, tracker = np.random.default_rng(4), PeopleTracker3D(NAMES)
    wrist = NAMES.index("left_wrist")
    for k in range(12):
        people = {"ann": walker((0.3, 0.4), 0.0, 0.1 * k), "bob": walker((-0.3, -0.4), np.pi, 0.1 * k)}
        seen = photograph(CAMERAS, people, 1.0, random, hide=False)
        if k > 5:  # two of four cameras take Bob's wrist for Ann's
            for name in ("cam1", "cam3"):
                ann, bob = seen[name]
                ann.joints[wrist] = bob.joints[wrist]
        found = tracker.step(round(k * 1e9 / 30), CAMERAS, seen)
        if k > 5:
            ann_3d = next(person for person in found if nearest(people, person.joints)[0] == "ann")
            assert ann_3d.weights["cam1"][wrist] == ann_3d.weights["cam3"][wrist] == 0
            assert np.linalg.norm(ann_3d.joints[wrist] - people["ann"][wrist]) < 0.03


def test_people_are_not_more_than_allowed_and_ids_go_on_after_a_reset() -> None:
    tracker = PeopleTracker3D(NAMES)

    def alone(t: float) -> dict[str, F64]:
        return {"ann": walker((0.0, 0.0), 0.0, t)}

    assert [person.id for person in run(tracker, np.arange(0, 0.3, 0.1), alone)[-1]] == ["b1"]
    tracker.reset()
    assert [person.id for person in run(tracker, np.arange(1, 1.3, 0.1), alone)[-1]] == ["b2"]
