# SPDX-License-Identifier: Apache-2.0
"""Upright bodies on few points: what is said about them, and how they are turned round."""

import numpy as np
import pytest

from flowing_puppet_ros.body.bank.upright_bank import make_child_bank
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.visibility import Visibility
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.upright.upright_fit import (
    FLOOR_WEIGHT,
    SOLE_VERTICES,
    UprightFitter,
    floor_term,
    keep_place_only,
)
from flowing_puppet_ros.model.sp import StitchedPuppet

SENSOR = np.array([-6.0, 0.0, 1.6])


@pytest.fixture(scope="module")
def fitter() -> BodyFitter:
    return BodyFitter(StitchedPuppet.load(), FitterSettings(threads=1))


def see(model: StitchedPuppet, count: int) -> tuple[np.ndarray, float]:
    """Return some vertices of the rest pose that face the sensor behind it, and the height of its soles."""
    vertices = model.vertices(model.rest_state())
    facing = np.flatnonzero(((SENSOR - vertices) * vertex_normals(vertices, model.faces)).sum(axis=1) > 0)
    return vertices[facing[np.linspace(0, len(facing) - 1, count).astype(np.int64)]], float(vertices[:, 2].min())


def test_few_points_tell_place_and_height_and_nothing_about_limbs(fitter: BodyFitter) -> None:
    model = fitter.model
    points, _ = see(model, 59)
    cloud = UprightFitter(fitter).make_cloud(points, SENSOR, None)
    fit = fitter.assess(model.rest_state(), cloud)
    assert keep_place_only(model, fit, 60) is fit
    kept = keep_place_only(model, fit, 59)
    names = model.tree.names
    limbs = [k for k, name in enumerate(names) if name not in ("torso", "head")]
    assert (kept.visibility.parts[limbs] == Visibility.INFERRED).all() and (kept.part_confidence[limbs] == 0).all()
    assert kept.visibility.parts[names.index("torso")] == Visibility.NEAR
    wrists = [model.joint_names.index(f"{side}_wrist") for side in ("left", "right")]
    assert (kept.visibility.joints[wrists] == Visibility.INFERRED).all()
    assert not kept.reliable
    np.testing.assert_array_equal(kept.vertices, fit.vertices)


def test_a_child_is_as_tall_as_it_is(fitter: BodyFitter) -> None:
    model = fitter.model
    small = 1.2 / model.measure_height(model.rest_state().shape)
    points, floor = see(model, 300)
    points = np.column_stack([points[:, :2] * small, floor + (points[:, 2] - floor) * small])
    upright = UprightFitter(fitter)
    found = upright.fit(upright.make_cloud(points, SENSOR, None), floor)
    assert abs(found.stature - 1.2) < 0.06
    bank = make_child_bank(model)
    assert bank.stature.min() > 1.0 and bank.stature.max() < 1.5
    assert abs(model.vertices(bank.states[7])[:, 2].min()) < 1e-9


@pytest.mark.slow
def test_a_body_is_turned_round_where_it_stands(fitter: BodyFitter) -> None:
    model = fitter.model
    points, floor = see(model, 150)
    upright = UprightFitter(fitter)
    cloud = upright.make_cloud(points, SENSOR, None)
    before = model.rest_state()
    after = upright.turn_round(before, cloud, floor).fit
    assert after.state.rotation[0, 0, 0] < -0.8  # it faced along x
    places = dict(zip(model.joint_names, after.joints, strict=True))
    rest = dict(zip(model.joint_names, model.joints(model.vertices(before)), strict=True))
    for name, other in (("left_shoulder", "right_shoulder"), ("right_hip", "left_hip"), ("left_wrist", "right_wrist")):
        assert np.linalg.norm(places[name] - rest[other]) < 0.2
    assert abs(after.vertices[:, 2].min() - floor) < 0.05


def test_the_floor_pulls_at_the_lowest_vertices_and_at_all_below_it() -> None:
    vertices = np.zeros((200, 3))
    vertices[:, 2] = np.random.default_rng(0).permutation(200) / 100 - 0.4  # 40 of them below 0
    for floor in (0.0, -0.5):
        order = np.argsort(vertices[:, 2])[: 40 if floor == 0.0 else SOLE_VERTICES]
        term = floor_term(vertices, floor)
        matrix, vector = np.zeros((200, 3, 3)), np.zeros((200, 3))
        matrix[order, 2, 2] = FLOOR_WEIGHT / SOLE_VERTICES
        vector[order, 2] = FLOOR_WEIGHT / SOLE_VERTICES * (vertices[order, 2] - floor)
        np.testing.assert_allclose(term.matrix, matrix)
        np.testing.assert_allclose(term.vector, vector)
