# SPDX-License-Identifier: Apache-2.0
"""A person whom no puppet model made is found in a scan, at their height, and furniture is not."""

from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec

import numpy as np
import pytest

from flowing_puppet_ros.body.bank.upright_bank import make_upright_bank
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.scene_tracker import MAX_FIRST_FITS, SceneSettings, SceneTracker
from flowing_puppet_ros.body.upright.found_body import SearchedScan
from flowing_puppet_ros.body.upright.person_finder import PersonFinder, PersonFinderSettings
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow
LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")
PLACE, HEIGHT = np.array([7.0, 1.0]), 1.8
ORIGIN = np.zeros(3)


@pytest.fixture(scope="module")
def scan() -> tuple[np.ndarray, np.ndarray, float]:
    """A floor, a wall, a cupboard and an Anny body in the rest pose; points, who they are of, the stature."""
    from flowing_puppet_ros.learn.anny.body import AnnyBody

    anny = AnnyBody("neutral")
    rest = anny.make_rest_body(anny.mean_phenotype())
    turned = rest.vertices - [*rest.vertices[:, :2].mean(axis=0), rest.vertices[:, 2].min()] + [*PLACE, 0.0]
    level = np.eye(3)
    around = [
        make_box(np.array([0, 0, -0.05]), np.array([40, 40, 0.1]), level),
        make_box(np.array([12.0, 0, 1.5]), np.array([0.2, 40, 3]), level),
        make_box(np.array([6.0, -3.0, 0.85]), np.array([0.6, 0.5, 1.7]), level),
    ]
    people = [(turned, anny.triangles)]
    points, owner = scan_scene(around, people, np.random.default_rng(0), "spinning-64", HEIGHT)
    return points, owner, rest.stature


@LEARN
def test_the_person_is_found_at_their_height_and_the_cupboard_is_not(
    scan: tuple[np.ndarray, np.ndarray, float],
) -> None:
    points, owner, stature = scan
    found: list[tuple[PersonCloud, BodyFit]] = []
    for threads in (1, 2):
        fitter = BodyFitter(StitchedPuppet.load(), FitterSettings(threads=threads))
        finder = PersonFinder(fitter, PersonFinderSettings())
        (body,) = finder.find(SearchedScan(SceneHeights.of(points, ORIGIN), ORIGIN))
        assert body.fit is not None
        found.append((body.person, body.fit))
        assert len(finder.last_rejected) >= 1  # the cupboard, among others
    person, fit = found[0]
    assert person.rows is not None and (owner[person.rows] == 0).mean() > 0.95
    assert np.linalg.norm(fit.vertices[:, :2].mean(axis=0) - PLACE) < 0.12
    assert abs(StitchedPuppet.load().measure_height(fit.state.shape) - stature) < 0.08
    assert abs(fit.vertices[:, 2].min() + HEIGHT) < 0.05
    assert person.score > 0.9 and fit.confidence > 0.5
    assert fit.vertices.tobytes() == found[1][1].vertices.tobytes()


@LEARN
def test_in_a_recording_everybody_has_a_body_in_the_first_scan() -> None:
    """Live, so many candidates have one that no scan waits long for its bodies."""
    from flowing_puppet_ros.learn.anny.body import AnnyBody

    anny = AnnyBody("neutral")
    rest = anny.make_rest_body(anny.mean_phenotype())
    standing = rest.vertices - [*rest.vertices[:, :2].mean(axis=0), rest.vertices[:, 2].min()]
    places = np.array([[6.0, 2.0 * k - 4.0, 0.0] for k in range(5)])
    floor = make_box(np.array([0, 0, -0.05]), np.array([40, 40, 0.1]), np.eye(3))
    people = [(standing + place, anny.triangles) for place in places]
    points = scan_scene([floor], people, np.random.default_rng(0), "spinning-64", HEIGHT)[0]
    tracker = SceneTracker(BodyFitter(StitchedPuppet.load(), FitterSettings()), SceneSettings())
    bodies = tracker.step(SceneCloud(points, None, 100_000_000), 0)[0]
    assert [body.id for body in bodies] == ["b1", "b2", "b3", "b4", "b5"]
    middles = np.array([body.fit.vertices[:, :2].mean(axis=0) for body in bodies])
    nearest = np.linalg.norm(middles[:, None] - places[:, :2], axis=2)
    assert sorted(nearest.argmin(axis=1)) == [0, 1, 2, 3, 4] and nearest.min(axis=1).max() < 0.15
    tracker.reset()
    with ThreadPoolExecutor(1) as beside:
        assert len(tracker.step(SceneCloud(points, None, 100_000_000), 0, beside)[0]) == min(5, MAX_FIRST_FITS)


@LEARN
def test_a_new_person_has_a_body_in_the_first_scan_and_keeps_the_id(
    scan: tuple[np.ndarray, np.ndarray, float],
) -> None:
    points, owner, _ = scan
    tracker = SceneTracker(BodyFitter(StitchedPuppet.load(), FitterSettings()), SceneSettings())
    for step in range(4):
        moved = points + np.where(owner[:, None] == 0, [0.0, 0.1 * step, 0.0], 0.0)
        (body,) = tracker.step(SceneCloud(moved, None, (step + 1) * 100_000_000), step)[0]
        assert body.id == "b1"
        assert np.linalg.norm(body.fit.vertices[:, :2].mean(axis=0) - PLACE - [0, 0.1 * step]) < 0.15
    empty = points[owner != 0]
    assert tracker.step(SceneCloud(empty, None, 500_000_000), 9) == ([], ["b1"])


@LEARN
def test_who_stands_in_a_large_cluster_is_found_again_as_the_one_who_is_known(
    scan: tuple[np.ndarray, np.ndarray, float],
) -> None:
    """A person who touches a long wall has a small share of that cluster, which no prediction claims then."""
    points, owner, _ = scan
    gap = np.linspace(0.0, 12.0, 3000)
    heights = np.tile(np.linspace(-HEIGHT + 0.2, -HEIGHT + 1.5, 30), 100)
    fence = np.column_stack([np.full(3000, PLACE[0] + 0.25), PLACE[1] + 0.25 + gap, heights])
    finder = PersonFinder(BodyFitter(StitchedPuppet.load(), FitterSettings()), PersonFinderSettings())
    joined = np.concatenate([points, fence])
    (first,) = finder.find(SearchedScan(SceneHeights.of(joined, ORIGIN), ORIGIN))
    assert first.fit is not None and first.person.owner is None
    known = [first.fit.vertices[::8]]
    again = finder.find(SearchedScan(SceneHeights.of(joined, ORIGIN), ORIGIN, 100_000_000, known=known))
    assert [body.person.owner for body in again] == [0]
    assert again[0].person.rows is not None and (owner[again[0].person.rows[:-1]] == 0).mean() > 0.5


def test_the_bank_stands_on_the_floor_and_is_of_many_statures() -> None:
    bank = make_upright_bank(StitchedPuppet.load())
    model = StitchedPuppet.load()
    for state in bank.states[::20]:
        assert abs(model.vertices(state)[:, 2].min()) < 1e-9
    assert 0.05 < bank.stature.std() < 0.12 and 1.6 < bank.stature.mean() < 1.8


def test_the_bank_leans_and_strides_as_people_do() -> None:
    """Of 240 people in motion capture who stand or walk, shoulders are 7 cm from above the hips, strides 23 cm."""
    model = StitchedPuppet.load()
    joints = [
        dict(zip(model.joint_names, model.joints(model.vertices(s)), strict=True))
        for s in make_upright_bank(model).states
    ]
    lean = [(j["left_shoulder"] + j["right_shoulder"] - j["left_hip"] - j["right_hip"])[:2] / 2 for j in joints]
    stride = [abs(j["left_ankle"][0] - j["right_ankle"][0]) for j in joints]
    assert 0.05 < np.hypot(*np.transpose(lean)).mean() < 0.11
    assert 0.15 < np.mean(stride) < 0.3 and max(stride) > 0.5


@LEARN
def test_a_full_fit_that_faces_the_other_way_does_not_turn_the_body(scan: tuple[np.ndarray, np.ndarray, float]) -> None:
    points, owner, _ = scan
    height = points[:, 2] + HEIGHT
    feet, shins = (points[(owner == 0) & (height > low) & (height < low + 0.1)] for low in (0.0, 0.2))
    toes = (feet.mean(axis=0) - shins.mean(axis=0))[:2]
    finder = PersonFinder(BodyFitter(StitchedPuppet.load(), FitterSettings()), PersonFinderSettings())
    (body,) = finder.find(SearchedScan(SceneHeights.of(points, ORIGIN), ORIGIN))
    assert body.fit is not None and body.person.floor is not None
    cloud = finder.upright.make_cloud(body.person.points, ORIGIN, None)
    turned = finder.upright.turn_round(body.fit.state, cloud, body.person.floor).fit
    ahead = body.fit.state.rotation[0, :2, 0]
    assert turned.state.rotation[0, :2, 0] @ ahead < 0
    assert ahead @ toes > 0
    chosen = finder.choose_facing(body.person, body.fit, turned)
    assert chosen.state.rotation[0, :2, 0] @ ahead > 0
    assert finder.choose_facing(body.person, body.fit, body.fit) is body.fit
    assert body.person.rows is not None
    judged = finder.judge(body.person, body.person.rows, turned, turn=True)
    assert judged.turned is not None and judged.turned[1] > 0
    assert judged.turned[0].state.rotation[0, :2, 0] @ ahead > 0
    assert finder.judge(body.person, body.person.rows, body.fit).turned is None
