# SPDX-License-Identifier: Apache-2.0
"""People of scenes keep their ids from cloud to cloud, and the component fits each of them."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
TENTH = 100_000_000
Place = tuple[float, float]


@pytest.fixture(scope="module")
def person() -> np.ndarray:
    model = StitchedPuppet.load("neutral")
    vertices = model.vertices(model.rest_state())
    return np.asarray(vertices - [0, 0, vertices[:, 2].min()])


@pytest.fixture(scope="module")
def floor() -> np.ndarray:
    return np.pad(np.random.default_rng(0).uniform(-4, 4, (3000, 2)), ((0, 0), (0, 1)))


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The middles of all clouds that had a full fit, each of which finds a standing person at once."""
    middles: list[np.ndarray] = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any = None, **_: Any) -> BodyFit:
        middles.append(points.mean(axis=0))
        state = fitter.model.rest_state()
        lowest = fitter.model.vertices(state)[:, 2].min()
        middle = fitter.model.vertices(state).mean(axis=0)
        state.center[:] += [*(points.mean(axis=0) - middle)[:2], points[:, 2].min() - lowest]
        return fitter.assess(state, fitter.prepare_cloud(points, normals, viewpoint))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    return middles


class Stage:
    """A component, and people who stand on a floor before it."""

    def __init__(self, person: np.ndarray, floor: np.ndarray, settings: dict[str, Any] | None = None) -> None:
        self.person, self.floor = person, floor
        self.component = BodyFitterComponent(
            BodyFitterSettings.from_mapping(
                {"view": "full", "fitter.max_points": 1000, "fitter.threads": 1}
                | {"tracker.max_points": 500, "tracker.gauss_newton_steps": 2}
                | (settings or {})
            ),
            FACTORY,
        )
        self.component.set_subscribed("body_meshes", True)
        self.tenths = 0
        self.made: dict[str, Any] = {}

    def cloud(self, *places: Place) -> Any:
        self.tenths += 1
        points = np.concatenate([self.floor, *(self.person + np.array([x, y, 0.0]) for x, y in places)])
        return make_cloud(FACTORY, make_header(FACTORY, self.tenths * TENTH, "lidar"), points)

    def show(self, *places: Place) -> dict[Place, str]:
        """Return the id of the body at each place."""
        self.made = dict(self.component.handle("points", self.cloud(*places)))
        middles = {}
        for body in self.made["bodies"].bodies:
            pelvis = next(joint.position for joint in body.joints if joint.name == "pelvis")
            middles[body.id] = np.array([pelvis.x, pelvis.y])
        assert [body.id for body in self.made["bodies"].bodies] == sorted(middles, key=lambda i: (len(i), i))
        close = {place: [i for i, m in middles.items() if np.linalg.norm(m - place) < 0.2] for place in places}
        return {place: ids[0] for place, ids in close.items() if ids}


@pytest.mark.slow
def test_in_a_recording_all_new_people_are_searched_at_once_and_then_followed(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]
) -> None:
    stage = Stage(person, floor)
    crowd = [(0.0, 2.0 * k - 4) for k in range(5)]
    first = stage.show(*crowd[:4])
    assert sorted(first.values()) == ["b1", "b2", "b3", "b4"] and len(fits) == 4
    everybody = stage.show(*crowd)
    assert everybody == first | {crowd[4]: "b5"} and len(fits) == 5
    moved = stage.show(*[(x + 0.1, y) for x, y in crowd])
    assert list(moved.values()) == list(everybody.values())
    assert stage.component.report.drain_warnings() == []


@pytest.mark.slow
def test_people_keep_their_ids_where_stamps_stand_still(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]
) -> None:
    stage = Stage(person, floor)
    for k in range(4):
        stage.tenths = 6
        assert stage.show((0.05 * k, 1.0)) == {(0.05 * k, 1.0): "b1"}
    assert len(fits) == 1, "followed, not searched again"
    (warning,) = stage.component.report.drain_warnings()
    assert "two clouds have the stamp 700000000 ns: they are taken as 0.1 s apart" in warning
    stage.tenths = 6 + 6
    assert stage.show((0.2, 1.0)) == {(0.2, 1.0): "b1"}, "a stamp that advances counts again"


@pytest.mark.slow
def test_who_is_hidden_for_a_while_keeps_the_id_and_who_is_gone_does_not(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]
) -> None:
    stage = Stage(person, floor, {"tracker.hold": 0.5, "output.max_mesh_rate": 0.0})
    stage.show((0, 0), (2, 0))
    first = stage.show((0, 0), (2, 0))
    for _ in range(3):
        assert stage.show((2, 0)) == {(2, 0): first[2, 0]}
        assert [marker.action for marker in stage.made["body_meshes"].markers] == [0], "hidden is not lost"
    assert stage.show((0.1, 0), (2, 0)) == {(0.1, 0): first[0, 0], (2, 0): first[2, 0]}
    assert len(fits) == 2, "a person who comes back is followed from the last body"
    actions = []
    for _ in range(6):
        stage.show((2, 0))
        actions += [marker.action for marker in stage.made["body_meshes"].markers]
    assert sorted(actions) == [0, 0, 0, 0, 0, 0, 2]
    frames = [frame.child_frame_id for frame in stage.made["/tf"].transforms]
    assert [name for name in frames if name.startswith("body_")] == [f"body_{first[2, 0]}"]
    assert stage.show((0.1, 0), (2, 0))[0.1, 0] == "b3"
    stage.component.reset()
    assert stage.show((2, 0)) == {(2, 0): "b4"}


@pytest.mark.slow
def test_people_who_touch_stay_two(person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]) -> None:
    stage = Stage(person, floor)
    apart = [(0.0, -0.9), (0.0, 0.9)]
    stage.show(*apart)
    ids = list(stage.show(*apart).values())
    for near in (0.8, 0.7, 0.6, 0.5, 0.45, 0.5, 0.6):
        found = stage.show((0.0, -near), (0.0, near))
        assert list(found.values()) == ids, near
    assert len(fits) == 2


@pytest.mark.slow
def test_after_a_stall_a_person_is_neither_cut_in_two_nor_taken_for_another(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]
) -> None:
    """Seconds without a cloud leave the body behind: it still stands in a part of the person's points."""
    stage = Stage(person, floor)
    for x in (0.0, 0.05, 0.1):
        stage.show((x, 0.0))
    for x in (0.3, 0.6, 1.0, 1.3, 1.5):
        stage.tenths += 14
        assert stage.show((x, 0.0)) == {(x, 0.0): "b1"}


@pytest.mark.slow
def test_a_doubtful_body_is_searched_again_after_a_while(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    result = BodyFitter.assess
    monkeypatch.setattr(BodyFitter, "assess", lambda *known: replace(result(*known), reliable=False))
    stage = Stage(person, floor)
    for searches in (1, 2, 3):
        for _ in range(2):
            assert stage.show((0, 0)) == {(0, 0): "b1"}
            assert len(fits) == searches
        stage.tenths += 50


def test_seeds_begin_ids(person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]) -> None:
    assert list(Stage(person, floor, {"fitter.seed": 2}).show((0, 0)).values()) == ["bc1"]


def test_the_region_of_interest_leaves_people_out(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]
) -> None:
    stage = Stage(person, floor, {"region.min_x": -1.0, "region.max_x": 1.0})
    assert list(stage.show((0, 0), (2, 0))) == [(0, 0)]


@pytest.mark.slow
def test_in_the_background_a_search_holds_nobody_up(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, quick, gate = Stage(person, floor), BodyFitter.fit, threading.Event()

    def slow(fitter: BodyFitter, *arguments: Any, **keywords: Any) -> BodyFit:
        assert gate.wait(60)
        assert keywords["quick"] and not keywords["nonrigid"], "nobody waits for the best there is"
        return quick(fitter, *arguments, **keywords)

    monkeypatch.setattr(BodyFitter, "fit", slow)
    beside = ThreadPoolExecutor(1)
    stage.component.background = beside

    def wait() -> None:
        beside.submit(int).result(60)

    gate.set()
    assert stage.show((0, 0)) == {}, "the search runs beside"
    wait()
    assert stage.show((0.05, 0)) == {(0.05, 0): "b1"}
    gate.clear()
    for step in range(3):
        there = (0.05 * step, 0.0)
        assert stage.show(there, (2 + 0.1 * step, 0)) == {there: "b1"}, "the other is followed meanwhile"
    gate.set()
    wait()
    # The new body has followed the person through the clouds that came while it was searched.
    assert stage.show((0.15, 0), (2.3, 0)) == {(0.15, 0): "b1", (2.3, 0): "b2"}
    assert len(fits) == 2
    beside.shutdown()


def test_what_goes_wrong_in_the_background_is_told_and_ends_nothing(
    person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, good = Stage(person, floor), BodyFitter.fit

    def broken(*_: Any, **__: Any) -> BodyFit:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(BodyFitter, "fit", broken)
    with ThreadPoolExecutor(1) as beside:
        stage.component.background = beside
        assert stage.show((0, 0)) == {}
        beside.submit(int).result(60)
        with pytest.raises(ZeroDivisionError, match="a defect"):
            stage.show((0, 0))
        monkeypatch.setattr(BodyFitter, "fit", good)
        stage.show((0, 0))
        beside.submit(int).result(60)
        assert list(stage.show((0, 0)).values()) == ["b1"]


@pytest.mark.slow
def test_goals_fit_everybody_and_touch_no_track(person: np.ndarray, floor: np.ndarray, fits: list[np.ndarray]) -> None:
    stage = Stage(person, floor)
    message, found = stage.component.fit(stage.cloud((0, 0), (2, 1)), None, seed=0)
    assert [body.id for body in message.bodies] == ["b1", "b2"] == [body.id for body in found]
    assert stage.show((0, 0)) == {(0, 0): "b1"}
    alone = make_cloud(FACTORY, make_header(FACTORY, 1, "lidar"), person[person[:, 2] > 1.2])
    assert len(stage.component.fit(alone, None, seed=0)[1]) == 1, "a cloud of a person's size is one"
    with pytest.raises(InputError, match="there is nobody in the cloud"):
        stage.component.fit(stage.cloud(), None, seed=0)


def test_clouds_that_cannot_show_people_are_one_sentence(person: np.ndarray) -> None:
    component = BodyFitterComponent(BodyFitterSettings(), FACTORY)
    millimetres = person * 1000 + 3000
    for stamp, points, sentence in (
        (1, millimetres, "beyond the segmentation.max_range of 30 m; check the unit"),
        (2, person[:0], "no finite"),
    ):
        made = dict(component.handle("points", make_cloud(FACTORY, make_header(FACTORY, stamp, "lidar"), points)))
        assert made["bodies"].bodies == []
        (warning,) = component.report.drain_warnings()
        assert sentence in warning
