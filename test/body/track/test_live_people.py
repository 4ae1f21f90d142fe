# SPDX-License-Identifier: Apache-2.0
"""People in the scans of a live stream: quick first bodies, better ones beside the scans, ids that outlast gaps."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from kept_tasks import KeptTasks  # type: ignore[import-not-found]

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.candidates import Candidate
from flowing_puppet_ros.body.settings import BodyTrackerSettings, FitterSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.body.track.multi_body_tracker import MAX_LIVE_ASKED, MultiBodyTracker, MultiBodyTrackerSettings
from flowing_puppet_ros.body.track.person_belief import PersonBelief
from flowing_puppet_ros.body.track.person_track import PersonTrack
from flowing_puppet_ros.body.track.scene_tracker import MAX_LIVE_FITS, SEARCH_EVERY, SceneSettings, SceneTracker
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.body.upright.found_body import ExpectedPerson, find_only_reached
from flowing_puppet_ros.body.upright.person_finder import PersonFinder
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.model.sp import StitchedPuppet

LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")
HEIGHT = 1.8  # of the sensor
TENTH = 100_000_000


@pytest.fixture(scope="module")
def person() -> tuple[np.ndarray, np.ndarray]:
    """An Anny body that stands at the origin, facing along x: vertices and triangles."""
    from flowing_puppet_ros.learn.anny.body import AnnyBody

    anny = AnnyBody("neutral")
    vertices = anny.make_rest_body(anny.mean_phenotype()).vertices
    return vertices - [*vertices[:, :2].mean(axis=0), vertices[:, 2].min()], anny.triangles


def _scan(person: tuple[np.ndarray, np.ndarray], places: Sequence[np.ndarray], stamp: int) -> SceneCloud:
    floor = make_box(np.array([0, 0, -0.05]), np.array([40, 40, 0.1]), np.eye(3))
    people = [(person[0] + [*place, 0.0], person[1]) for place in places]
    points = scan_scene([floor], people, np.random.default_rng(stamp), "spinning-64", HEIGHT)[0]
    return SceneCloud(points, None, stamp, single_view=True)


def _nearest(bodies: Sequence[TrackedBody], places: np.ndarray) -> dict[int, str]:
    """Return who is at each of the places (P, 2); every body has to be at one of its own."""
    middles = np.array([body.fit.vertices[:, :2].mean(axis=0) for body in bodies])
    apart = np.linalg.norm(middles[:, None] - places, axis=2)
    assert apart.min(axis=1).max(initial=0.0) < 0.25
    return {int(place): body.id for place, body in zip(apart.argmin(axis=1), bodies, strict=True)}


def _make_tracker() -> SceneTracker:
    return SceneTracker(BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), SceneSettings(view="single"))


@LEARN
@pytest.mark.slow
def test_walkers_keep_their_ids_when_scans_are_left_out(
    person: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 0.6 s somebody whose velocity nobody knows yet is 0.6 m on; nobody is fitted anew for that."""
    fitted: list[int] = []
    start = PersonFinder._start
    monkeypatch.setattr(PersonFinder, "_start", lambda *given, **named: fitted.append(1) or start(*given, **named))  # type: ignore[func-returns-value]
    starts = np.array([[5.0, -3.0], [6.0, 0.5], [5.0, 4.0]])
    walks = np.array([[0.0, 1.0], [-1.0, 0.0], [0.7, -0.7]])
    tracker, later = _make_tracker(), KeptTasks()
    ids: dict[int, str] = {}
    for tenths in (0, 6, 8, 13):
        places = starts + 0.1 * tenths * walks
        cloud = _scan(person, list(places), (tenths + 1) * TENTH)
        bodies, _ = tracker.step(cloud, tenths, cast(Any, later))
        found = _nearest(bodies, places)
        assert len(bodies) == len(found) == 3
        assert not ids or found == ids
        ids = found
        later.run()
    assert len(fitted) == 3


@LEARN
@pytest.mark.slow
def test_who_comes_into_a_live_stream_has_a_quick_body_soon_and_a_better_one_beside(
    person: tuple[np.ndarray, np.ndarray],
) -> None:
    first, others = np.array([[5.0, 0.0]]), np.array([[5.0, 2.5], [6.0, -2.5], [7.0, 5.0]])
    tracker, later = _make_tracker(), KeptTasks()
    for number in range(1, 3):
        bodies, _ = tracker.step(_scan(person, list(first), number * TENTH), 0, cast(Any, later))
        assert [body.id for body in bodies] == ["b1"]
        later.run()
    everybody, known, fitted = np.concatenate([first, others]), 1, []
    for number in range(3, 3 + SEARCH_EVERY + 2):
        bodies, _ = tracker.step(_scan(person, list(everybody), number * TENTH), 0, cast(Any, later))
        _nearest(bodies, everybody)
        assert len(bodies) - known <= MAX_LIVE_FITS  # no scan waits for more
        known = len(bodies)
        fitted.append(later.run())
    assert known == 4
    assert max(fitted) == 1 and sum(fitted) >= 2  # one at a time


def _candidate(x: float, y: float) -> tuple[Candidate, float]:
    return Candidate(np.arange(30), np.array([x, y]), 0.0, 1.7, True), 0.9


def test_a_candidate_is_somebody_who_is_missed_where_nobody_else_can_be_there() -> None:
    offered = [_candidate(0.5, 0.0), _candidate(5.0, 0.0), _candidate(5.6, 0.0), _candidate(9.0, 0.0)]
    places = [0.0, 5.3, 8.7, 9.4]
    expected = [ExpectedPerson(np.array([x, 0.0]), 0.6, True) for x in places]
    # Two candidates are near the second person, and two people near the last candidate.
    assert find_only_reached(offered, [0, 1, 2, 3], expected) == {0: 0}
    assert find_only_reached(offered, [0, 1, 3], expected) == {0: 0, 3: 3}
    assert find_only_reached(offered, [0], ()) == {}


def _track(number: int, place: float, shown: bool, asked: int = 0, count: int = 6) -> PersonTrack:
    vertices = np.array([[place, 0.0, 0.0], [place, 0.0, 1.7]])
    belief = PersonBelief(np.zeros(2), shown=shown, asked=asked, count=count)
    body = cast(Any, SimpleNamespace(last=SimpleNamespace(vertices=vertices)))
    return PersonTrack(f"b{number}", number, vertices[0], TENTH, body, belief=belief)


def test_of_two_tracks_in_one_place_the_better_known_stays() -> None:
    shown, doubtful, beside = _track(2, 1.0, True), _track(1, 1.1, False), _track(3, 1.5, False)
    assert doubtful.is_double_of(shown) and not shown.is_double_of(doubtful)
    assert not beside.is_double_of(shown)
    assert _track(5, 1.0, True).is_double_of(shown)  # the older one stays


def test_a_live_scan_is_asked_about_few_who_are_not_shown_first() -> None:
    tracker = MultiBodyTracker(BodyFitter(StitchedPuppet.load(), FitterSettings()), MultiBodyTrackerSettings(), 0)
    shown = [_track(number, 2.0 * number, True, asked=number, count=2) for number in range(1, 4)]
    waiting = [_track(number, 2.0 * number, False, count=1) for number in range(4, 8)]
    seen = [(track, cast(Any, None)) for track in [*shown, *waiting]]
    assert tracker._choose_asked(seen, 2 * TENTH, live=True) == {4, 5} and MAX_LIVE_ASKED == 2
    assert tracker._choose_asked(seen[:3], 2 * TENTH, live=True) == {1}
    assert len(tracker._choose_asked(seen, 2 * TENTH, live=False)) == 7


def test_somebody_may_be_farther_away_the_longer_nobody_saw_them_and_less_far_once_they_were_seen_to_walk() -> None:
    track = _track(1, 0.0, True)
    soon, later = (track.expect(stamp) for stamp in (TENTH + TENTH, TENTH + 6 * TENTH))
    assert soon.claims and not later.claims
    assert later.reach - soon.reach == pytest.approx(0.5 * 2.0)
    track.update(np.array([0.6, 0.0, 0.0]), 7 * TENTH)
    walking = track.expect(13 * TENTH)
    assert walking.claims and walking.reach < later.reach
    np.testing.assert_allclose(walking.place, [1.2, 0.0])


@LEARN
@pytest.mark.slow
def test_who_is_seen_by_fewer_points_is_not_lost(person: tuple[np.ndarray, np.ndarray]) -> None:
    """An eighth of the points is three times as far from each other; among scattered points a body is lost."""
    cloud = _scan(person, [np.array([4.0, 0.0])], TENTH)
    tracker = _make_tracker()
    (found,) = tracker.find_once(cloud)
    assert found.fit is not None and len(found.person.points) > 300
    for scatter, lost in ((0.0, False), (0.15, True)):
        body = BodyTracker(BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1)), BodyTrackerSettings())
        body.start(found.person, found.fit)
        points = found.person.points[::8]
        points = points + scatter * np.random.default_rng(0).standard_normal(points.shape)
        fit = body.track(replace(found.person, points=points, stamp=2 * TENTH))
        assert fit is not None and body.lost is lost
