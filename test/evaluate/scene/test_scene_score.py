# SPDX-License-Identifier: Apache-2.0
"""Recall, ghosts and errors of people found in labelled scans."""

import json
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scene_labels import LabelledScene, label_scene, read_labels
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.scene.scene_meshes import make_prism
from flowing_puppet_ros.evaluate.scene.scene_score import (
    ReportedPerson,
    count_id_switches,
    find_standing,
    score_scene,
    summarise_scenes,
    tabulate_bins,
)
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene


def column(x: float, y: float, count: int, top: float = 1.7) -> np.ndarray:
    return np.column_stack([np.full(count, x), np.full(count, y), np.linspace(-1.5, top - 1.5, count)])


def body(x: float, y: float, identity: str = "b1") -> ReportedPerson:
    joints = {"left_wrist": np.array([x, y + 0.3, -0.5]), "right_wrist": np.array([x, y - 0.3, -0.5])}
    return ReportedPerson(joints, column(x, y, 50), 1.75, identity, 0.9)


def box(x: float, y: float, **more: object) -> dict[str, object]:
    return {"centre": [x, y, -0.65], "height_width_length": [1.7, 0.5, 0.5], **more}


@pytest.fixture
def truth() -> LabelledScene:
    points = np.concatenate([column(5, 0, 100), column(8, 3, 60), column(9, -3, 30)])
    joints = {"left_wrist": [5, -0.3, -0.5], "right_wrist": [5, 0.3, -0.5]}
    entry = {"people": [box(5, 0, joints=joints), box(8, 3), box(9, -3), {**box(3, 3), "class": "car"}]}
    return label_scene(entry, points, "street")


def test_people_count_by_points_and_ghosts_are_bodies_at_nobody(truth: LabelledScene) -> None:
    assert [person.points for person in truth.people] == [100, 60, 30]
    found = [body(5.1, 0), body(9, -3, "b2"), body(3, 3, "b3"), body(-4, 0, "b4")]
    people, ghosts = score_scene("street", truth, found, 50, np.radians(90))
    assert [person.found for person in people] == [True, False, True]
    assert [person.counts for person in people] == [True, True, False]
    assert [(ghost.x, ghost.y) for ghost in ghosts] == [(3.0, 3.0)]  # the one behind is out of the sector
    figures = summarise_scenes(people, ghosts, 1)
    assert figures["recall_percent"] == 50 and figures["ghosts_per_scan"] == 1
    assert figures["place_median_cm"] == pytest.approx(10)
    assert figures["stature_error_mean_cm"] == pytest.approx(5)
    assert people[0].joint_error == pytest.approx(np.hypot(0.6, 0.1), abs=1e-6) and people[0].flipped
    assert {row["bin"]: row["people"] for row in tabulate_bins(people)}["points 25 to 40"] == 1


def test_a_body_stands_for_one_person_only(truth: LabelledScene) -> None:
    people, ghosts = score_scene("s", truth, [body(5, 0), body(5.2, 0.1)], 50, np.pi)
    assert sum(person.found for person in people) == 1 and len(ghosts) == 1


def test_ids_switch_when_a_person_has_another_one(truth: LabelledScene) -> None:
    scans = [[body(5, 0)], [body(5, 0, "b7")], [], [body(5, 0, "b7"), body(8, 3, "b2")]]
    people = [person for found in scans for person in score_scene("s", truth, found, 50, np.pi)[0]]
    assert count_id_switches(people) == 1


def test_labels_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    with pytest.raises(InputError, match="cannot be read"):
        read_labels(path)
    path.write_text(json.dumps([1]))
    with pytest.raises(InputError, match="no table"):
        read_labels(path)
    with pytest.raises(InputError, match="another form"):
        label_scene([{"middle": 3}], np.zeros((1, 3)), "street")


@pytest.mark.parametrize("scanner", ["spinning-16", "spinning-32", "solid-state", "dome", "depth"])
def test_scanners_see_the_near_side_of_what_stands_before_them(scanner: str) -> None:
    post, wall = make_prism((4.0, 0.0), 0.3, 0, 2.0, 64), make_prism((0.0, 0.0), 7.0, 0, 3.0, 64)
    points, owner = scan_scene([wall], [post], np.random.default_rng(0), scanner, 1.2)
    own = points[owner == 0]
    assert len(own) > 100
    ray = np.hypot(*(own[:, :2] - [4.0, 0.0]).T)
    assert abs(np.median(ray) - 0.3) < 0.03 and own[:, 0].max() < 4.1 and own[:, 2].max() < 0.9
    around = points[(owner < 0) & (points[:, 2] > -1.1) & (points[:, 2] < 1.7)]
    assert len(around) and (np.hypot(*around[:, :2].T) > 6.5).all()


def test_some_rays_meet_drops_before_what_they_would_meet() -> None:
    wall, post = make_prism((0.0, 0.0), 7.0, 0, 3.0, 64), make_prism((4.0, 0.0), 0.3, 0, 2.0, 64)
    dry, _ = scan_scene([wall], [post], np.random.default_rng(0), "spinning-16", 1.2)
    wet, owner = scan_scene([wall], [post], np.random.default_rng(0), "spinning-16", 1.2, rain=0.1)
    drops = np.linalg.norm(wet, axis=1) < 3.4
    assert not (np.linalg.norm(dry, axis=1) < 3.4).any()
    assert 0.03 < drops.mean() < 0.1 and (owner[drops] == -1).all()


def test_who_stands_is_told_from_who_walks() -> None:
    people = []
    for step in range(4):
        entry = [box(5 + 0.05 * step, 0), box(8 + 0.2 * step, 3)]
        points = np.concatenate([column(5 + 0.05 * step, 0, 100), column(8 + 0.2 * step, 3, 60)])
        found = [body(8 + 0.2 * step, 3)] + ([body(5, 0, "b2")] if step else [])
        people += score_scene(f"a-{step}", label_scene(entry, points, "a"), found, 50, np.pi)[0]
    assert [person.person for person in find_standing(people)] == [0] * 4
    assert summarise_scenes(people, [], 4)["standing_percent"] == 75
