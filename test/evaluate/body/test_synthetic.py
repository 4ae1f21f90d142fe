# SPDX-License-Identifier: Apache-2.0
"""Synthetic people and what sensors see of them (the bodies need the extra for learning, the scans do not)."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.garments import FEET, Tailor
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.body.synthetic_scans import (
    DepthSettings,
    RaycastScene,
    draw_sensor_position,
    make_box,
    make_furniture,
    sample_surface,
    scan_depth,
    scan_lidar,
    scan_whole,
)
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")
SIZE = np.array([0.4, 0.6, 1.8])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> BodySource:
    """People with a motion capture in which a hanging left arm swings and the body moves on."""
    frames = np.zeros((30, 117))
    frames[:, 0:3] = np.linspace(0, 30, 30)[:, None] * [1.0, 0.0, 2.0]
    frames[:, 3 + 3 * 21] = np.linspace(0, 1.2, 30)
    path = tmp_path_factory.mktemp("mocap") / "mocap.npz"
    np.savez(path, swing=frames)
    return BodySource(Path(path))


@pytest.fixture
def block() -> RaycastScene:
    """A box the size of a person, standing on the ground."""
    return RaycastScene(*make_box(np.array([0, 0, SIZE[2] / 2]), SIZE, np.eye(3)))


def test_boxes_are_closed_and_look_outward() -> None:
    vertices, faces = make_box(np.array([1.0, 2.0, 3.0]), SIZE, np.eye(3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(SIZE.prod())


def test_samples_lie_on_the_surface_evenly() -> None:
    vertices, faces = make_box(np.zeros(3), SIZE, np.eye(3))
    points, normals = sample_surface(vertices, faces, np.random.default_rng(0), 20000)
    np.testing.assert_allclose((np.abs(points) / (SIZE / 2)).max(axis=1), 1)
    np.testing.assert_allclose((points * normals).sum(axis=1), np.abs(normals) @ (SIZE / 2))
    top = SIZE[0] * SIZE[1] / (2 * (SIZE[0] * SIZE[1] + SIZE[0] * SIZE[2] + SIZE[1] * SIZE[2]))
    assert np.mean(normals[:, 2] > 0.5) == pytest.approx(top, abs=0.01)


def test_a_whole_scan_shows_nothing_from_within() -> None:
    outer, faces = make_box(np.zeros(3), SIZE, np.eye(3))
    inner = make_box(np.zeros(3), SIZE / 2, np.eye(3))[0]
    scene = RaycastScene(np.concatenate([outer, inner]), np.concatenate([faces, faces + len(outer)]))
    scan = scan_whole(scene, np.random.default_rng(0), 500)
    np.testing.assert_allclose((np.abs(scan.points) / (SIZE / 2)).max(axis=1), 1)
    assert len(scan.points) == 500
    assert scan.normals is not None
    assert len(np.unique(scan.normals.round(3), axis=0)) == 6


def test_a_depth_view_shows_the_near_side(block: RaycastScene) -> None:
    eye = np.array([3.0, 0.3, 0.9])
    view = scan_depth(block, np.random.default_rng(0), eye, DepthSettings(noise=0.005, step=0.005, points=4000))
    assert len(view.points) == 4000
    assert view.points[:, 0].mean() == pytest.approx(SIZE[0] / 2, abs=0.02)
    assert np.percentile(np.abs(view.points[:, 0] - SIZE[0] / 2), 90) == pytest.approx(1.645 * 0.005, abs=0.004)
    assert np.ptp(view.points[:, 2]) == pytest.approx(SIZE[2], abs=0.03)
    assert np.ptp(view.points[:, 1]) == pytest.approx(SIZE[1], abs=0.03)


def test_lidar_points_lie_on_rings(block: RaycastScene) -> None:
    eye = np.array([8.0, 0.0, 1.7])
    view = scan_lidar(block, np.random.default_rng(0), eye, noise=0.02)
    rays = view.points - eye
    elevation = np.degrees(np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])))
    rings = np.unique((elevation - elevation.min()).round(3))
    np.testing.assert_allclose(rings / 0.4, np.round(rings / 0.4), atol=0.01)
    front = np.abs(view.points[:, 0] - SIZE[0] / 2) < 0.1
    assert view.points[front, 0].std() == pytest.approx(0.02, rel=0.2)
    # 0.6 x 1.8 m at 7.8 m: 23 points in each of 32 rings.
    assert 500 < front.sum() < 900


def test_surroundings_are_told_from_the_person(block: RaycastScene) -> None:
    rng = np.random.default_rng(1)
    eye = draw_sensor_position(rng, block.vertices, (2.5, 2.5), (1.2, 1.2))
    assert np.hypot(*eye[:2]) == pytest.approx(2.5)
    scene = RaycastScene(block.vertices, block.triangles, make_furniture(rng, block.vertices, eye))
    view = scan_depth(scene, rng, eye, DepthSettings(points=100000))
    inside = (np.abs(view.points - [0, 0, 0.9]) < SIZE / 2 + 0.03).all(axis=1)
    assert view.on_person.sum() > 5000
    assert inside[view.on_person].all()
    floor = np.abs(view.points[:, 2]) < 0.03
    assert (floor & ~view.on_person).sum() > 5000


@LEARN
def test_bodies_stand_and_their_template_is_on_them(source: BodySource) -> None:
    model = StitchedPuppet.load()
    for hard in (False, True):
        body = source.draw_body(np.random.default_rng(2), hard)
        truth = body.template_vertices("neutral")
        assert body.vertices[:, 2].min() == pytest.approx(0)
        assert body.hard is hard
        assert cKDTree(body.vertices).query(truth)[0].max() < 0.02
        true_joints = body.joints[[source.joint_names.index(name) for name in model.joint_names]]
        assert np.linalg.norm(model.joints(truth) - true_joints, axis=1).mean() < 0.02


@LEARN
def test_who_stands_sways_as_motion_capture_does_and_keeps_the_feet(source: BodySource, tmp_path: Path) -> None:
    frames = np.zeros((30, 117))
    frames[:, 3 + 3 * 21 + 1] = np.linspace(0, 1.2, 30)  # an arm swings
    np.savez(tmp_path / "still.npz", swing=frames)
    rng = np.random.default_rng(1)
    body = source.draw_body(rng, hard=False)
    swayed = BodySource(tmp_path / "still.npz").sway(rng, body, 12, 10.0)
    assert len(swayed) == 12 and np.abs(swayed[0].vertices - body.vertices).max() < 1e-9
    place = {name: [each.joints[source.joint_names.index(name)] for each in swayed] for name in source.joint_names}
    assert all(np.ptp(place[name], axis=0).max() < 1e-6 for name in ("left_ankle", "right_wrist", "neck"))
    arm = np.array(place["left_wrist"]) - place["left_shoulder"]
    length = np.linalg.norm(arm, axis=1)
    assert np.ptp(length) < 1e-6
    steps = np.linalg.norm(np.diff(arm, axis=0), axis=1)  # 2 of 29 frames, in each of which it turns by 1.2 / 29
    assert 0.02 < steps.max() <= 2 * np.sin(1.2 / 29) * length[0] + 1e-9 and np.ptp(steps) < 1e-6
    with pytest.raises(InputError, match="nobody stands"):
        source.sway(rng, body, 12, 10.0)


@LEARN
def test_bodies_are_drawn_by_the_seed(source: BodySource) -> None:
    first, again, other = (source.draw_body(np.random.default_rng(seed), hard=True).vertices for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.05


@LEARN
def test_motion_is_smooth_and_goes_through_the_captured_frames(source: BodySource) -> None:
    # Both need four frames of capture, so that both draw the same ones.
    fast = source.draw_motion(np.random.default_rng(5), 7, 60.0)
    slow = source.draw_motion(np.random.default_rng(5), 3, 20.0)
    for captured, reached in zip(slow, fast[::3], strict=True):
        level = captured.joints - reached.joints
        np.testing.assert_allclose(level, np.tile([0.0, 0.0, level[0, 2]], (len(level), 1)), atol=1e-9)
    steps = np.linalg.norm(np.diff([body.joints for body in fast], axis=0), axis=2)
    assert 0.01 < steps.mean() < 0.1
    assert np.abs(np.diff(steps, axis=0)).max() < 0.02


@LEARN
def test_poses_of_people_need_motion_capture() -> None:
    source = BodySource()
    with pytest.raises(InputError, match="--mocap"):
        source.draw_body(np.random.default_rng(0), hard=False)
    with pytest.raises(InputError, match="longer motion capture"):
        source.draw_motion(np.random.default_rng(0), 4, 20.0)


@LEARN
def test_garments_cover_their_bones_and_lie_outside_of_the_body(source: BodySource) -> None:
    body = source.draw_body(np.random.default_rng(2), hard=False)
    tailor, rng = Tailor(source), np.random.default_rng(0)
    bare, triangles = tailor.dress(body, (), rng)
    np.testing.assert_array_equal(bare, body.vertices)
    dressed, _ = tailor.dress(body, ("jacket", "shoes"), rng)
    moved = dressed - body.vertices
    bone = np.array(source.bone_names)[source.bone_of_vertex]
    assert np.median(np.linalg.norm(moved[bone == "Spine1"], axis=1)) > 0.015
    assert moved[bone == "Head"].any(axis=1).mean() < 0.1 and np.median(moved[np.isin(bone, FEET), 2]) < -0.01
    corners = body.vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = (moved[triangles].mean(axis=1) * normals).sum(axis=1)[np.isin(bone[triangles], ("Spine1",)).all(axis=1)]
    assert (outward > 0).mean() > 0.95
    skirted, faces = tailor.dress(body, ("skirt",), rng)
    ring = skirted[len(body.vertices) :][:64, :2]
    legs = body.vertices[np.isin(bone, ("LeftUpLeg", "RightUpLeg"))]
    near = legs[np.abs(legs[:, 2] - skirted[len(body.vertices), 2]) < 0.02][:, :2]
    middle = ring.mean(axis=0)
    assert np.linalg.norm(near - middle, axis=1).max() < np.linalg.norm(ring - middle, axis=1).max()
    assert faces.max() == len(skirted) - 1
