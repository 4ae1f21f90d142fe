# SPDX-License-Identifier: Apache-2.0
"""Somebody on a chair is found where they sit, the empty chair is nobody, and who stands on a box has its top below."""

import numpy as np
import pytest

from flowing_puppet_ros.body.bank.posed_bank import is_posed
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.upright.found_body import FoundBody, SearchedScan
from flowing_puppet_ros.body.upright.person_finder import PersonFinder, PersonFinderSettings
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.props.furniture import Place, make_chair
from flowing_puppet_ros.evaluate.props.poses import draw_seated, draw_standing
from flowing_puppet_ros.evaluate.scene.scene_meshes import Mesh, stand_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import StitchedPuppet

pytest.importorskip("body_models")
pytestmark = pytest.mark.slow
HEIGHT, PLACE = 1.4, np.array([4.0, 0.5, 0.0])
TURN = rotation.exp(np.array([0.0, 0.0, 2.6]))  # towards the sensor, nearly
FLOOR = [
    make_box(np.array([0, 0, -0.05]), np.array([40, 40, 0.1]), np.eye(3)),
    stand_box(9.0, 0.0, 0.0, (0.2, 16.0, 3.0)),
]


@pytest.fixture(scope="module")
def source() -> BodySource:
    return BodySource()


def turn(mesh: Mesh) -> Mesh:
    return mesh[0] @ TURN.T + PLACE, mesh[1]


def find(people: list[Mesh], things: list[Mesh]) -> list[FoundBody]:
    points, _ = scan_scene([*FLOOR, *things], people, np.random.default_rng(0), "spinning-64", HEIGHT)
    finder = PersonFinder(BodyFitter(StitchedPuppet.load(), FitterSettings()), PersonFinderSettings())
    return finder.find(SearchedScan(SceneHeights.of(points, np.zeros(3)), np.zeros(3)), remember=False)


def measure_error(found: FoundBody, body: TrueBody, source: BodySource) -> float:
    assert found.fit is not None
    model, true = StitchedPuppet.load(), body.joints @ TURN.T + PLACE - [0.0, 0.0, HEIGHT]
    rows = {name: row for row, name in enumerate(model.joint_names)}
    own = [
        (found.fit.joints[rows[name]], place)
        for name, place in zip(source.joint_names, true, strict=True)
        if name in rows
    ]
    return float(np.mean([np.linalg.norm(a - b) for a, b in own]))


def test_who_sits_on_a_chair_is_found_there_and_the_empty_chair_is_nobody(source: BodySource) -> None:
    rng = np.random.default_rng(3)
    body = draw_seated(source, rng, "free")
    chair = [turn(mesh) for mesh in make_chair(Place.of(source, body), rng)]
    (found,) = find([turn((body.vertices, source.triangles))], chair)
    assert found.fit is not None and measure_error(found, body, source) < 0.15
    assert is_posed(dict(zip(StitchedPuppet.load().joint_names, found.fit.joints, strict=True)))
    assert find([], chair) == []


def test_who_stands_on_a_box_is_as_tall_as_on_the_floor(source: BodySource) -> None:
    body = draw_standing(source, np.random.default_rng(5), "hanging").translate(np.array([0.0, 0.0, 0.3]))
    (found,) = find([turn((body.vertices, source.triangles))], [turn(stand_box(0.0, 0.0, 0.0, (0.8, 0.8, 0.3)))])
    assert found.fit is not None and measure_error(found, body, source) < 0.12
    assert abs(StitchedPuppet.load().measure_height(found.fit.state.shape) - body.stature) < 0.15
    assert found.person.floor == pytest.approx(0.3 - HEIGHT, abs=0.08)
