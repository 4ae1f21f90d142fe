# SPDX-License-Identifier: Apache-2.0
"""Synthetic colour and depth: geometry of known planes and pixels, errors of sensors, what is cut off and hidden."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.rgbd.clothing import paint_surroundings
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import SENSORS, find_shadow, sense_depth, to_millimetres
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, draw_keypoints, find_visible
from flowing_puppet_ros.evaluate.rgbd.motions import MOTIONS, pose_motion
from flowing_puppet_ros.evaluate.rgbd.rendering import NOBODY, PaintedMesh, RayCamera, RenderedView
from flowing_puppet_ros.evaluate.rgbd.sequences import make_chair
from flowing_puppet_ros.evaluate.rgbd.views import CUTS, RgbdStudio, look_along, make_pair, make_registered


def wall(at: float, person: int = NOBODY, width: float = 20.0) -> PaintedMesh:
    """Return a wall that crosses the x axis at a right angle."""
    vertices, triangles = make_box(np.array([at + 0.5, 0, 0]), np.array([1.0, width, 20.0]), np.eye(3))
    return PaintedMesh(vertices, triangles, np.full((8, 3), 200.0), person)


AHEAD = look_along(np.array([1.0, 0.0, 0.0]), 0.0)
"""Axes of a camera that looks along x."""


def test_depth_of_a_wall_is_the_same_at_every_pixel() -> None:
    camera = make_registered().place(AHEAD, np.array([-1.0, 0.3, 0.2])).depth
    view = RayCamera(camera).render([wall(2.0)])
    np.testing.assert_allclose(view.depth, 3.0, atol=1e-5)
    assert view.cosine[239, 319] == pytest.approx(1.0, abs=1e-4)
    # The corner's ray is inclined by the half diagonal over the focal length.
    assert view.cosine[0, 0] == pytest.approx(525 / np.sqrt(525**2 + 319.5**2 + 239.5**2), abs=1e-4)


def test_a_pixel_with_a_lens_sees_the_point_that_projects_to_it() -> None:
    camera = make_pair().place(AHEAD, np.zeros(3)).colour
    edge = 0.4123  # metres to the right, where a person ends and the background begins
    vertices, triangles = make_box(np.array([2.5, edge + 5, 0.0]), np.array([0.01, 10.0, 20.0]), np.eye(3))
    person = PaintedMesh(vertices, triangles, np.full((8, 3), 90.0), 0)
    view = RayCamera(camera).render([person, wall(6.0)])
    column, row = camera.project(np.array([2.495, edge, 0.1]))[0]
    seen = np.flatnonzero(view.person[round(float(row))] == 0)  # left of the edge, since y points left
    assert abs(seen.max() - column) < 1.0


def test_a_moved_colour_camera_sees_the_same_points() -> None:
    pair = make_pair().place(look_along(np.array([0.6, 0.8, 0.0]), 0.2), np.array([0.4, -0.2, 1.5]))
    between = pair.colour.centre - pair.depth.centre
    assert np.linalg.norm(between) == pytest.approx(0.05, abs=0.001)
    right = pair.depth.rotation[0]
    assert between @ right == pytest.approx(0.05, abs=0.001)
    assert right == pytest.approx([0.8, -0.6, 0.0])
    assert pair.depth.rotation[2] == pytest.approx([0.6 * np.cos(0.2), 0.8 * np.cos(0.2), -np.sin(0.2)])


def test_shadow_beside_what_stands_in_front_has_the_width_of_the_disparities() -> None:
    depth = np.full((4, 200), 4.0)
    depth[:, 80:120] = 2.0
    shadow = find_shadow(depth, 525 * 0.075)
    # The projector is at the right, so that the shadow is at the left.
    assert np.flatnonzero(shadow[0]).max() == 79
    assert shadow[0].sum() == pytest.approx(525 * 0.075 * (1 / 2.0 - 1 / 4.0), abs=1)


@pytest.mark.parametrize(("kind", "at_two", "at_four"), [("structured", 0.009, 0.036), ("tof", 0.005, 0.005)])
def test_noise_of_a_wall_grows_as_the_sensor_measures(kind: str, at_two: float, at_four: float) -> None:
    """Disparity errs by sqrt(0.08^2 + 0.125^2 / 12) px, depth by z^2 / (f b) times that; time of flight by 5 mm."""
    for depth, expected in ((2.0, at_two), (4.0, at_four)):
        sensed = sense_depth(
            np.full((200, 300), depth), np.ones((200, 300)), 525.0, SENSORS[kind], np.random.default_rng(1)
        )
        left, top, right, bottom = SENSORS[kind].border
        assert np.isnan(sensed[:top]).all() and np.isnan(sensed[:, :left]).all()
        inner = sensed[top : 200 - bottom, left : 300 - right]
        assert np.isnan(inner).mean() == pytest.approx(SENSORS[kind].speckles, abs=0.002)
        assert np.nanstd(inner) == pytest.approx(expected, rel=0.1)


def test_nothing_is_zero_millimetres() -> None:
    assert to_millimetres(np.array([[np.nan, 2.0004, 1.9996]])).tolist() == [[0, 2000, 2000]]


def test_keypoints_behind_somebody_are_out_of_view_and_those_behind_the_own_body_are_hidden() -> None:
    camera = make_registered().place(AHEAD, np.zeros(3)).depth
    joints = np.tile([3.0, 0.0, 0.0], (12, 1))
    names = list(LIMB_JOINTS)

    def flags(depth: float, person: int) -> tuple[dict[str, bool], dict[str, bool]]:
        shape = (480, 640)
        view = RenderedView(
            np.full(shape, depth), np.ones(shape), np.full(shape, person), np.zeros((*shape, 3), np.uint8)
        )
        visible, in_view = find_visible(joints, camera, view, 0)
        return dict(zip(names, visible, strict=True)), dict(zip(names, in_view, strict=True))

    visible, in_view = flags(2.86, 0)  # 14 cm of the own body before the joint: within a hip, not within a wrist
    assert visible["left_hip"] and not visible["left_wrist"] and in_view["left_wrist"]
    visible, in_view = flags(2.5, 1)
    assert not any(visible.values()) and not any(in_view.values())


def test_keypoints_have_the_noise_and_the_hidden_ones_less_confidence() -> None:
    camera = make_registered().place(AHEAD, np.zeros(3)).depth
    joints = np.tile([3.0, 0.0, 0.0], (12, 1))
    joints[0] = [3.0, 50.0, 0.0]  # far outside
    visible = np.arange(12) < 6
    rng = np.random.default_rng(3)
    drawn = [draw_keypoints(rng, joints, camera, visible, visible, 5.0) for _ in range(200)]
    offset = np.stack([k.pixels for k in drawn])[:, 1:] - [319.5, 239.5]
    assert offset[:, :5].std() == pytest.approx(5.0, rel=0.1)
    assert offset[:, 5:].std() == pytest.approx(10.0, rel=0.1)
    assert all(np.isnan(k.pixels[0]).all() and k.confidence[0] == 0 for k in drawn)
    assert min(k.confidence[1:6].min() for k in drawn) > max(k.confidence[6:].max() for k in drawn)


def test_subdivided_boxes_keep_their_surface() -> None:
    vertices, triangles = make_box(np.zeros(3), np.array([0.3, 0.5, 0.9]), np.eye(3))
    painted = paint_surroundings([(vertices, triangles)], np.random.default_rng(0))[0]
    a, b, c = (painted.vertices[painted.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(2 * (0.3 * 0.5 + 0.3 * 0.9 + 0.5 * 0.9))
    assert np.einsum("ij,ij->", np.cross(b - a, c - a), a) / 6 == pytest.approx(0.3 * 0.5 * 0.9)  # outwards still


@pytest.fixture(scope="module")
def source() -> BodySource:
    """Return people without motion capture."""
    return BodySource()


@pytest.mark.slow
def test_motions_walk_wave_and_sit(source: BodySource) -> None:
    names = source.joint_names
    bodies = {name: pose_motion(source, name, np.random.default_rng(2), 30, 15.0) for name in MOTIONS}
    joints = {name: np.stack([body.joints for body in people]) for name, people in bodies.items()}

    def of(motion: str, joint: str) -> np.ndarray:
        return joints[motion][:, names.index(joint)]

    assert of("walking", "pelvis")[-1, 0] - of("walking", "pelvis")[0, 0] == pytest.approx(0.9 * 29 / 15, abs=0.05)
    assert (of("waving", "right_wrist")[:, 2] > of("waving", "nose")[:, 2]).all()
    assert np.ptp(of("waving", "right_wrist"), axis=0).max() > 0.15
    thigh = of("seated", "left_knee") - of("seated", "left_hip")
    assert (np.abs(thigh[:, 2]) < 0.15).all() and (thigh[:, 0] > 0.3).all()
    chair = make_chair(source, bodies["seated"][0], np.random.default_rng(0))
    seat = max(chair[0].vertices[:, 2])
    assert 0.25 < seat < of("seated", "left_hip")[0, 2]


@pytest.mark.slow
@pytest.mark.parametrize("cut", CUTS)
def test_frames_hold_the_person_as_far_as_the_cut_says(source: BodySource, cut: str) -> None:
    studio = RgbdStudio(source, sensor="tof")
    body = pose_motion(source, "waving", np.random.default_rng(4), 1, 15.0)[0]
    rng = np.random.default_rng(5)
    cameras = studio.place_cameras(rng, [body], cut, np.array([1.0, 0.0, 0.0]))
    frame = studio.look(rng, [body], studio.furnish(rng, [body], cameras, cut), cameras)
    shown = {name.partition("_")[2] for name, seen in zip(LIMB_JOINTS, frame.seen[0].in_view, strict=True) if seen}
    assert ("ankle" in shown) == (cut == "whole")
    assert ("hip" in shown or cut in ("chest", "table", "hips")) and ("shoulder" in shown)
    # Sensed points of the person lie on the true surface.
    points = (
        frame.points[(frame.person == 0) & np.isfinite(frame.depth)] - cameras.depth.translation
    ) @ cameras.depth.rotation
    step = points[:: max(1, len(points) // 300)]
    distance = np.sqrt(((step[:, None] - body.vertices[None, ::2]) ** 2).sum(axis=2)).min(axis=1)
    assert np.median(distance) < 0.015
