# SPDX-License-Identifier: Apache-2.0
"""Scores of bodies from colour and depth: bodies moved by known steps, and frames as the nodes see them."""

from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.evaluate.body.synthetic_bodies import TrueBody
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, SeenKeypoints
from flowing_puppet_ros.evaluate.rgbd.methods import SensedScene, as_puppet
from flowing_puppet_ros.evaluate.rgbd.scores import score_body, summarise_rgbd
from flowing_puppet_ros.evaluate.rgbd.tracking import MotionScore, summarise_motions
from flowing_puppet_ros.evaluate.rgbd.views import RgbdFrame, look_along, make_pair
from flowing_puppet_ros.model import weights
from flowing_puppet_ros.model.sp import StitchedPuppet

PLACE, EYE = np.array([2.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.2])  # of the person's torso and of the depth camera


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


def make_frame(model: StitchedPuppet, in_view: np.ndarray) -> RgbdFrame:
    """Return a frame of a person with the model's own mean body, before a wall at x = 3 m, seen from (0, 0, 1.2) m."""
    vertices = model.vertices(model.rest_state()) + PLACE
    index = weights.load("sp", "neutral")["anny_vertex"]
    whole = np.zeros((int(index.max()) + 1, 3))
    whole[index] = vertices
    joints = model.joints(vertices)
    body = TrueBody(whole, joints, hard=False, stature=1.7)
    cameras = make_pair().place(look_along(np.array([1.0, 0.0, 0.0]), 0.0), EYE)
    seen = SeenKeypoints(np.zeros((12, 2)), np.ones(12), in_view, in_view)
    shape = (480, 640)
    limbs = joints[[model.joint_names.index(name) for name in LIMB_JOINTS]]
    return RgbdFrame(
        np.full(shape, 3.0), np.zeros((720, 1280, 3), np.uint8), cameras, [body], limbs[None], [seen], [seen],
        np.full(shape, -1), np.full(shape, 3.0),
    )  # fmt: skip


def make_fit(model: StitchedPuppet, step: np.ndarray) -> BodyFit:
    state = model.rest_state()
    vertices = model.vertices(state) + PLACE - EYE + step
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, dtype=np.int8))
    return BodyFit(state, vertices, model.joints(vertices), 0.0, np.ones(16), 0.9, True, 0.01, seen)


def test_a_body_that_is_off_by_a_step_is_off_by_its_length(model: StitchedPuppet) -> None:
    in_view = np.arange(12) < 8
    frame = make_frame(model, in_view)
    to_world = SensedScene.of(frame).to_world
    score = score_body(model, make_fit(model, np.array([0.0, 0.03, 0.04])), to_world, frame, 0, "knees", 0.5)
    for error in (score.vertex_error, score.seen_error, score.unseen_error, score.visible_error):
        assert error == pytest.approx(0.05, abs=1e-6)
    assert not score.flipped and not score.wrong and score.lost_arms == 0
    assert score.stature_error == pytest.approx(model.measure_height(model.rest_state().shape) - 1.7)
    far = score_body(model, make_fit(model, np.array([0.0, 0.2, 0.0])), to_world, frame, 0, "knees", 0.5)
    missing = score_body(model, None, to_world, frame, 0, "knees", 0.5)
    assert far.wrong and far.lost_arms == far.seen_arms == 4 and missing.lost_arms == 4
    summary = summarise_rgbd([score, far, missing])
    assert summary["seen_cm"] == pytest.approx(12.5) and summary["missed"] == 1 and summary["over_6_cm"] == 2
    assert summary["wrong_reliable"] == 1
    # Nobody is in the frame's `person`; all joints are said to be seen, and those of one body of two are within 10 cm.
    assert summary["hidden_vertices_cm"] == pytest.approx(12.5) and np.isnan(summary["seen_vertices_cm"])
    assert summary["seen_hits"] == 0.5 and np.isnan(summary["near_hits"])
    shown = replace(frame, person=np.zeros((480, 640), int), true_depth=np.full((480, 640), 2.0))
    near = score_body(model, make_fit(model, np.array([0.0, 0.03, 0.04])), to_world, shown, 0, "knees", 0.5)
    assert near.seen_vertex_error == pytest.approx(0.05) and near.hidden_vertex_error == pytest.approx(0.05)


def test_turned_bodies_are_called_flipped(model: StitchedPuppet) -> None:
    frame = make_frame(model, np.ones(12, dtype=bool))
    fit = make_fit(model, np.zeros(3))
    turned = replace(fit, vertices=fit.vertices[model.mirror_vertex])
    assert score_body(model, turned, SensedScene.of(frame).to_world, frame, 0, "whole", 0.1).flipped


def test_frames_are_seen_as_the_nodes_see_them(model: StitchedPuppet) -> None:
    frame = make_frame(model, np.ones(12, dtype=bool))
    frame.depth[:, :20] = np.nan
    scene = SensedScene.of(frame)
    assert len(scene.points) == 240 * 310
    np.testing.assert_allclose(scene.points[:, 0], 3.0)  # the wall, and the sensor is the origin
    point = np.array([2.5, 0.3, 0.2])
    np.testing.assert_allclose(scene.colour.project(point)[0], frame.cameras.colour.project(point + EYE)[0], atol=1e-6)
    pixel, depth = scene.image.projection.project(scene.points[:50])
    np.testing.assert_allclose(pixel[:, 0] + 640 * pixel[:, 1], scene.image.pixel[:50], atol=1e-3)
    np.testing.assert_allclose(depth, 3.0)


def test_keypoints_stand_at_their_names(model: StitchedPuppet) -> None:
    pixels = np.arange(24.0).reshape(12, 2)
    seen = SeenKeypoints(pixels, np.linspace(0.1, 0.9, 12), np.ones(12, bool), np.ones(12, bool))
    puppet = as_puppet(model.joint_names, "p1", seen)
    row = model.joint_names.index("right_wrist")
    assert puppet.pixels[row].tolist() == pixels[LIMB_JOINTS.index("right_wrist")].tolist()
    assert np.isfinite(puppet.pixels[:, 0]).sum() == 12 and puppet.id == "p1"


def test_motions_are_summed_up_by_frame() -> None:
    errors = np.full((5, 12), 0.02)
    errors[3] = np.nan
    score = MotionScore(10.0, errors, np.array([0, 1, 1, 1, 0], bool), np.array([0, 0, 0, 1, 0], bool), np.full(5, 0.1))
    summary = summarise_motions([score])
    assert summary["joints_cm"] == pytest.approx(2.0) and summary["arms_lost_percent"] == pytest.approx(60)
    assert summary["longest_lost_s"] == pytest.approx(0.3) and summary["longest_missing_s"] == pytest.approx(0.1)
