# SPDX-License-Identifier: Apache-2.0
"""What is published of bodies: stamps and frames, meshes that go with their people, transforms by id."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import JOINT_CONFIDENCE, BodyVisibility, Visibility
from flowing_puppet_ros.body.track.tracked_body import TrackedBody, TrackStatus
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components.body_outputs import BodyOutputs, BodyOutputSettings
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriSettings
from flowing_puppet_ros.stream.messages.bodies.ros4hri_skeleton import MOVING_JOINTS
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, rotation_matrix

FACTORY = BagMessageFactory()
ALL = {"body_meshes", "body_vertices", "part_poses"}
TENTH = 100_000_000


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


def body(model: StitchedPuppet, place: tuple[float, float, float]) -> BodyFit:
    """Return a body of which all but the left lower arm was seen."""
    state = model.rest_state()
    state = replace(state, center=state.center + np.array(place))
    vertices = model.vertices(state)
    hidden = model.part_of_vertex == model.tree.index("left_lower_arm")
    visibility = BodyVisibility.of_vertices(
        model, np.where(hidden, Visibility.INFERRED, Visibility.SEEN).astype(np.int8)
    )
    return BodyFit(state, vertices, model.joints(vertices), 1.0, np.ones(16), 0.9, True, 0.01, visibility)


def header(tenths: int) -> Any:
    return make_header(FACTORY, 10**9 + tenths * TENTH, "lidar")


def outputs(model: StitchedPuppet, humans: bool = False, **settings: Any) -> BodyOutputs:
    return BodyOutputs(BodyOutputSettings(**settings), Ros4HriSettings(publish=humans), FACTORY, model)


def markers(made: list[tuple[str, Any]]) -> list[tuple[int, int]]:
    return [(marker.id, marker.action) for name, message in made if name == "body_meshes" for marker in message.markers]


@pytest.mark.slow
def test_everything_has_the_stamp_and_frame_of_the_cloud(model: StitchedPuppet) -> None:
    made = outputs(model).make(header(3), [TrackedBody("b1", body(model, (2, 0, 1)))], subscribed=ALL)
    found = dict(made)
    assert [name for name, _ in made].count("body_topology") == 1
    for name in ("bodies", "part_poses", "body_vertices"):
        assert found[name].header == header(3)
    assert found["body_meshes"].markers[0].header == header(3)
    assert {frame.header.stamp.nanosec for frame in found["/tf"].transforms} == {3 * TENTH}
    again = outputs(model)
    again.make(header(0), [TrackedBody("b1", body(model, (2, 0, 1)))])
    assert "body_topology" not in dict(again.make(header(1), [TrackedBody("b1", body(model, (2, 0, 1)))]))


@pytest.mark.slow
def test_meshes_come_at_their_rate_and_go_at_once(model: StitchedPuppet) -> None:
    shown, one, two = (
        outputs(model, max_mesh_rate=5.0),
        TrackedBody("b1", body(model, (2, 0, 1))),
        TrackedBody("b2", body(model, (2, 1, 1))),
    )
    assert markers(shown.make(header(0), [one, two], subscribed=ALL)) == [(1, 0), (2, 0)]
    assert markers(shown.make(header(1), [one, two], subscribed=ALL)) == []
    assert markers(shown.make(header(2), [one], hidden=["b2"], subscribed=ALL)) == [(1, 0)], "who is hidden is not lost"
    assert markers(shown.make(header(3), [one], subscribed=ALL)) == [(2, 2)]
    assert markers(shown.make(header(4), [one, two], subscribed=ALL)) == [(1, 0), (3, 0)], "no number is used again"
    assert markers(shown.make(header(0), [one, two], subscribed=ALL)) == [(1, 0), (3, 0)], "a recording starts again"
    assert markers(shown.make(header(5), [], subscribed=ALL)) == [(1, 2), (3, 2)]
    every = outputs(model, max_mesh_rate=0.0)
    assert all(markers(every.make(header(k), [one], subscribed=ALL)) for k in range(3))


def test_the_preview_is_the_body_with_fewer_triangles(model: StitchedPuppet) -> None:
    volumes = []
    for triangles in (0, 2000, 1000):
        made = dict(
            outputs(model, max_mesh_triangles=triangles).make(
                header(0), [TrackedBody("b1", body(model, (2, 0, 1)))], subscribed=ALL
            )
        )
        (marker,) = made["body_meshes"].markers
        corners = np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3, 3)
        assert len(corners) == len(model.faces) if triangles == 0 else len(corners) <= triangles
        volumes.append(np.linalg.det(corners - [2, 0, 1]).sum() / 6)
    np.testing.assert_allclose(volumes, volumes[0], rtol=0.05)


def test_vertices_are_one_row_a_body_and_poses_one_block(model: StitchedPuppet) -> None:
    one, two = body(model, (2, 0, 1)), body(model, (2, 1, 1))
    made = dict(outputs(model).make(header(0), [TrackedBody("b1", one), TrackedBody("b2", two)], subscribed=ALL))
    cloud = made["body_vertices"]
    assert (cloud.height, cloud.width) == (2, len(model.part_of_vertex))
    points, _ = decode_cloud(cloud)
    np.testing.assert_allclose(points[cloud.width :], two.vertices, atol=1e-5)
    assert len(made["part_poses"].poses) == 32


def test_frames_are_named_by_id_and_hang_on_the_sensor(model: StitchedPuppet) -> None:
    fit = body(model, (2, 0, 1))
    for humans in (False, True):
        frames = dict(outputs(model, humans=humans).make(header(0), [TrackedBody("7", fit)]))["/tf"].transforms
        names = [frame.child_frame_id for frame in frames]
        assert names[0] == "body_p7" and frames[0].header.frame_id == "lidar"
        assert len(set(names)) == len(names)
        assert {frame.header.frame_id for frame in frames[1:]} == {"body_p7"}
        assert {f"{name}_p7" for name in model.tree.names} <= set(names)
        assert ("l_wrist_p7" in names) == humans
        q, p = frames[0].transform.rotation, frames[0].transform.translation
        turn, origin = rotation_matrix((q.x, q.y, q.z, q.w)), np.array([p.x, p.y, p.z])
        np.testing.assert_allclose(origin, (fit.joints[5] + fit.joints[6]) / 2)
        hand = next(frame for frame in frames if frame.child_frame_id == "left_hand_p7").transform.translation
        there = origin + turn @ np.array([hand.x, hand.y, hand.z])
        np.testing.assert_allclose(there, fit.state.center[model.tree.index("left_hand")], atol=1e-6)
    few = dict(outputs(model, part_frames=False).make(header(0), [TrackedBody("b1", fit)]))["/tf"].transforms
    assert [frame.child_frame_id for frame in few] == ["body_b1"]


def test_people_by_rep_155(model: StitchedPuppet) -> None:
    shown, one = outputs(model, humans=True), TrackedBody("b1", body(model, (2, 0, 1)))
    found = dict(shown.make(header(0), [one]))
    states = found["/humans/bodies/b1/joint_states"]
    assert states.name == [f"{name}_b1" for name in MOVING_JOINTS] and len(states.position) == 20
    assert np.isfinite(states.position).all()
    assert found["/humans/bodies/tracked"].ids == ["b1"]
    assert 'name="body_b1"' in found["/humans/bodies/b1/urdf"].data
    again = dict(shown.make(header(1), [one]))
    assert "/humans/bodies/b1/urdf" not in again, "it is latched"
    hidden = dict(shown.make(header(2), [], hidden=["b1"]))
    assert hidden["/humans/bodies/tracked"].ids == ["b1"]
    gone = dict(shown.make(header(3), []))
    assert gone["/humans/bodies/b1/urdf"] is None and gone["/humans/bodies/b1/joint_states"] is None
    assert gone["/humans/bodies/tracked"].ids == []


def test_a_body_tells_how_it_came_how_it_moves_and_how_tall_it_is(model: StitchedPuppet) -> None:
    fit = body(model, (2, 0, 1))
    tall = replace(
        fit, state=replace(fit.state, shape=fit.state.shape + 2.0 * np.eye(model.shape_count)[0]), reliable=False
    )
    made = outputs(model).make(
        header(0),
        [
            TrackedBody("b1", fit, TrackStatus.TRACKED, np.array([0.1, -0.2, 0.3])),
            TrackedBody("b2", tall, TrackStatus.HIDDEN),
        ],
    )
    one, two = dict(made)["bodies"].bodies
    assert (one.state, two.state) == (one.TRACKED, two.HIDDEN)
    assert (one.velocity.x, one.velocity.y, one.velocity.z) == (0.1, -0.2, 0.3)
    assert one.reliable and not two.reliable
    assert one.height == pytest.approx(np.ptp(fit.vertices[:, 2]), abs=1e-3)
    assert abs(two.height - one.height) > 0.02


def test_what_was_not_seen_is_said_and_pale(model: StitchedPuppet) -> None:
    made = dict(outputs(model).make(header(0), [TrackedBody("b1", body(model, (2, 0, 1)))], subscribed=ALL))
    (one,) = made["bodies"].bodies
    parts = {part.name: part.visibility for part in one.parts}
    assert parts.pop("left_lower_arm") == one.parts[0].INFERRED
    assert set(parts.values()) == {one.parts[0].SEEN}
    joints = {joint.name: joint for joint in one.joints}
    assert joints["right_elbow"].visibility == joints["right_elbow"].SEEN
    assert joints["right_elbow"].confidence == pytest.approx(JOINT_CONFIDENCE[Visibility.SEEN])
    (marker,) = made["body_meshes"].markers
    corners = np.array([(p.x, p.y, p.z) for p in marker.points])
    pale = np.array([colour.r > marker.color.r for colour in marker.colors])
    assert 0.01 < pale.mean() < 0.1
    left_arm = [
        (joints[name].position.x, joints[name].position.y, joints[name].position.z)
        for name in ("left_elbow", "left_wrist")
    ]
    middle = np.mean(left_arm, axis=0)
    assert np.linalg.norm(corners[pale] - middle, axis=1).max() < 0.25


def test_a_body_that_was_seen_all_over_has_one_colour(model: StitchedPuppet) -> None:
    fit = body(model, (2, 0, 1))
    seen = BodyVisibility.of_vertices(model, np.full(len(model.part_of_vertex), Visibility.SEEN, np.int8))
    made = dict(outputs(model).make(header(0), [TrackedBody("b1", replace(fit, visibility=seen))], subscribed=ALL))
    assert not made["body_meshes"].markers[0].colors
