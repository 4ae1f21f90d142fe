# SPDX-License-Identifier: Apache-2.0
"""What navigation reads: places and velocities of people, the pose of one, topics of REP-155, frames with a prefix."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components.body_outputs import BodyOutputs, BodyOutputSettings
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriSettings
from flowing_puppet_ros.stream.messages.geometry import make_header, rotation_matrix

FACTORY = BagMessageFactory()
HEADER = make_header(FACTORY, 10**9, "lidar")
WALK = np.array([0.3, -1.2, 0.0])


def person(model: StitchedPuppet, identity: str, turn: float, place: list[float]) -> TrackedBody:
    """Return a body at rest that is turned about z by `turn` and stands at `place`."""
    c, s = np.cos(turn), np.sin(turn)
    rotation, state = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), model.rest_state()
    state = replace(state, center=state.center @ rotation.T + place, rotation=rotation @ state.rotation)
    vertices = model.vertices(state)
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, np.int8))
    fit = BodyFit(state, vertices, model.joints(vertices), 1.0, np.ones(16), 0.8, True, 0.01, seen)
    return TrackedBody(identity, fit, velocity=WALK)


@pytest.fixture
def crowd(model: StitchedPuppet) -> list[TrackedBody]:
    return [person(model, "faraw", 0.0, [6.0, 0, 0]), person(model, "nearb", np.pi / 2, [-2.0, 1.0, 0])]


def make(model: StitchedPuppet, crowd: list[TrackedBody], humans: bool = False, **settings: Any) -> dict[str, Any]:
    shown = BodyOutputs(BodyOutputSettings(**settings), Ros4HriSettings(publish=humans), FACTORY, model)
    return dict(shown.make(HEADER, crowd, subscribed={"people", "person_pose"}))


def hips(body: TrackedBody, model: StitchedPuppet) -> np.ndarray:
    sides = [body.fit.joints[model.joint_names.index(f"{side}_hip")] for side in ("left", "right")]
    return np.mean(sides, axis=0)


def test_people_are_where_their_hips_are_and_go_where_they_go(model: StitchedPuppet, crowd: list[TrackedBody]) -> None:
    message = make(model, crowd)["people"]
    assert message.header == HEADER and [each.name for each in message.people] == ["faraw", "nearb"]
    for each, body in zip(message.people, crowd, strict=True):
        found = [(point.x, point.y, point.z) for point in (each.position, each.velocity)]
        np.testing.assert_allclose(found, [hips(body, model), WALK])
        assert each.reliability == pytest.approx(0.8)
    typestore().serialize_cdr(message, "people_msgs/msg/People")


def test_the_nearest_or_the_chosen_person_has_a_pose(model: StitchedPuppet, crowd: list[TrackedBody]) -> None:
    for chosen, expected in (("", crowd[1]), ("faraw", crowd[0])):
        pose = make(model, crowd, person=chosen)["person_pose"].pose
        np.testing.assert_allclose([pose.position.x, pose.position.y, pose.position.z], hips(expected, model))
        q = pose.orientation
        chest = rotation_matrix((q.x, q.y, q.z, q.w))[:, 0]
        # The model at rest faces +x; the near person is turned to +y.
        assert chest @ ([0, 1, 0] if expected is crowd[1] else [1, 0, 0]) > 0.97
    assert "person_pose" not in make(model, crowd, person="nobod") and "person_pose" not in make(model, [])


def test_rep_155_has_position_and_velocity(model: StitchedPuppet, crowd: list[TrackedBody]) -> None:
    made = make(model, crowd, humans=True)
    point = made["/humans/bodies/nearb/position"].point
    np.testing.assert_allclose([point.x, point.y, point.z], hips(crowd[1], model))
    linear = made["/humans/bodies/nearb/velocity"].twist.linear
    np.testing.assert_allclose([linear.x, linear.y, linear.z], WALK)


def test_frames_have_the_prefix_and_the_root_has_the_clouds_frame(
    model: StitchedPuppet, crowd: list[TrackedBody]
) -> None:
    frames = make(model, crowd, frame_prefix="robot1/")["/tf"].transforms
    assert all(frame.child_frame_id.startswith("robot1/") for frame in frames)
    assert {frame.header.frame_id for frame in frames} == {"lidar", "robot1/body_faraw", "robot1/body_nearb"}
