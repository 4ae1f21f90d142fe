# SPDX-License-Identifier: Apache-2.0
"""The body fitter on the golden bag's hulls: waiting, independence of the past, other axes, several people, loss."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import decode_cloud, make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, rotation_matrix, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import BODIES

FACTORY = BagMessageFactory()
# z up -> y down, as in an optical frame: x right, z forward.
TO_OPTICAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def fitter(**settings: Any) -> BodyFitterComponent:
    fast = {
        "fitter.local_iterations": 1,
        "fitter.local_particles": 6,
        "fitter.gauss_newton_steps": 6,
        "fitter.max_points": 2000,
    }
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({**fast, **settings}), FACTORY)
    component.set_expected("initial", True)
    return component


@pytest.fixture(scope="module")
def inputs(golden: Any) -> dict[str, list[Any]]:
    with open_bag(golden.replay) as bag:
        return {topic: [r.message for r in bag.messages([topic])] for topic in ("/hull", "/hull/joints")}


@pytest.fixture(scope="module")
def second(inputs: dict[str, list[Any]]) -> Any:
    """The fit of the second hull alone."""
    component = fitter()
    component.handle("points", inputs["/hull"][1])
    return dict(component.handle("initial", inputs["/hull/joints"][1]))["bodies"]


def raw(bodies: Any) -> bytes:
    return bytes(typestore().serialize_cdr(bodies, BODIES))


def places(body: Any) -> NDArray[np.float64]:
    return np.array([[joint.position.x, joint.position.y, joint.position.z] for joint in body.joints])


@pytest.mark.slow
def test_a_fit_does_not_depend_on_the_order_or_on_the_past(inputs: dict[str, list[Any]], second: Any) -> None:
    component = fitter()
    found = []
    for hull, joints in zip(inputs["/hull"], inputs["/hull/joints"], strict=True):
        assert component.handle("initial", joints) == []
        found.append(dict(component.handle("points", hull))["bodies"])
    assert [stamp_ns(bodies) for bodies in found] == [stamp_ns(hull) for hull in inputs["/hull"]]
    assert raw(found[1]) == raw(second)
    assert found[0].bodies[0].id == found[1].bodies[0].id == inputs["/hull/joints"][0].bodies[0].id


def test_another_seed_is_another_search(inputs: dict[str, list[Any]], second: Any) -> None:
    component = fitter(**{"fitter.seed": 1})
    component.handle("points", inputs["/hull"][1])
    other = dict(component.handle("initial", inputs["/hull/joints"][1]))["bodies"]
    assert raw(other) != raw(second)
    assert np.linalg.norm(places(other.bodies[0]) - places(second.bodies[0]), axis=1).mean() < 0.05


def moved_body(body: Any, name: str, rotation: NDArray[np.float64], shift: NDArray[np.float64]) -> Any:
    """Return a body of joints that stands elsewhere."""
    joints = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyJoint",
            name=joint.name,
            confidence=joint.confidence,
            position=FACTORY.make("geometry_msgs/msg/Point", x=place[0], y=place[1], z=place[2]),
        )
        for joint, place in zip(body.joints, places(body) @ rotation.T + shift, strict=True)
    ]
    return FACTORY.make("flowing_puppet_msgs/msg/Body", id=name, joints=joints)


def test_clouds_of_optical_frames_are_fitted_upright(inputs: dict[str, list[Any]], second: Any) -> None:
    component = fitter(up="-y")
    hull, joints = inputs["/hull"][1], inputs["/hull/joints"][1]
    header = make_header(FACTORY, stamp_ns(hull), "depth_optical_frame")
    points, normals = decode_cloud(hull)
    assert normals is not None
    start = [moved_body(joints.bodies[0], "someone", TO_OPTICAL, np.zeros(3))]
    component.handle("initial", FACTORY.make(BODIES, header=header, bodies=start))
    cloud = make_cloud(FACTORY, header, points @ TO_OPTICAL.T, normals @ TO_OPTICAL.T)
    made = dict(component.handle("points", cloud))
    (body,) = made["bodies"].bodies
    assert (body.id, made["bodies"].header.frame_id) == ("someone", "depth_optical_frame")
    assert made["/tf"].transforms[0].child_frame_id == "body_someone"
    expected = places(second.bodies[0]) @ TO_OPTICAL.T
    assert np.linalg.norm(places(body) - expected, axis=1).mean() < 0.03
    q = made["/tf"].transforms[0].transform.rotation
    axes = rotation_matrix((q.x, q.y, q.z, q.w))
    assert axes[:, 2] @ [0, -1, 0] > 0.9, "z of the body frame points to the head"


@pytest.mark.slow
def test_each_body_of_the_start_is_fitted_and_a_lost_one_is_deleted(inputs: dict[str, list[Any]]) -> None:
    component = fitter()
    for name in ("body_meshes", "body_vertices", "part_poses"):
        component.set_subscribed(name, True)
    hull, joints = inputs["/hull"][1], inputs["/hull/joints"][1]
    points, _ = decode_cloud(hull)
    header = make_header(FACTORY, stamp_ns(hull), "world")
    aside = np.array([0, 1.5, 0])
    two = make_cloud(FACTORY, header, np.vstack([points, points + aside]))
    start = [joints.bodies[0], moved_body(joints.bodies[0], "someone", np.eye(3), aside)]
    component.handle("initial", FACTORY.make(BODIES, header=header, bodies=start))
    made = dict(component.handle("points", two))
    one, another = made["bodies"].bodies
    assert [one.id, another.id] == [inputs["/hull/joints"][0].bodies[0].id, "someone"]
    np.testing.assert_allclose((places(another) - places(one)).mean(axis=0), aside, atol=0.05)
    assert [marker.id for marker in made["body_meshes"].markers] == [1, 2]
    assert len(made["part_poses"].poses) == 32
    later = make_header(FACTORY, stamp_ns(hull) + 10**9, "world")
    empty = make_cloud(FACTORY, later, np.zeros((0, 3)))
    component.handle("initial", FACTORY.make(BODIES, header=later))
    lost = dict(component.handle("points", empty))
    assert lost["bodies"].bodies == []
    assert [(marker.id, marker.action) for marker in lost["body_meshes"].markers] == [(1, 2), (2, 2)]


def test_a_cloud_waits_for_its_joints_but_not_for_ever(inputs: dict[str, list[Any]]) -> None:
    component = fitter()
    assert component.handle("points", inputs["/hull"][0]) == []
    stamps = [stamp_ns(hull) for hull in inputs["/hull"]]
    empty = make_cloud(FACTORY, make_header(FACTORY, stamps[0] - 5, "world"), np.zeros((0, 3)))
    component.reset()
    assert component.handle("points", empty) == []
    assert component.handle("points", inputs["/hull"][0])[0][1].bodies == []
    assert len(dict(component.handle("initial", inputs["/hull/joints"][0]))["bodies"].bodies) == 1
