# SPDX-License-Identifier: Apache-2.0
"""People of scenes keep their ids from cloud to cloud, and the component fits each of them."""

from __future__ import annotations

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.people import ExtractionSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.clouds import make_cloud
from flowing_puppet_ros.stream.scenes import FORGOTTEN, ScenePeople


@pytest.fixture(scope="module")
def person() -> np.ndarray:
    model = StitchedPuppet.load("neutral")
    vertices = model.vertices(model.rest_state())
    return vertices - [0, 0, vertices[:, 2].min()]


@pytest.fixture(scope="module")
def floor() -> np.ndarray:
    return np.pad(np.random.default_rng(0).uniform(-4, 4, (9000, 2)), ((0, 0), (0, 1)))


def test_ids_follow_people_who_move_leave_and_come(person: np.ndarray, floor: np.ndarray) -> None:
    scene = ScenePeople(ExtractionSettings())

    def ids(*places: tuple[float, float]) -> dict[tuple[float, float], str]:
        cloud = np.concatenate([floor, *(person + np.array([x, y, 0.0]) for x, y in places)])
        found = scene.find(cloud, None, None)
        middles = {identity: cloud.points[:, :2].mean(axis=0) for identity, cloud in found}
        return {place: min(middles, key=lambda one: float(np.linalg.norm(middles[one] - place))) for place in places}

    first = ids((0, 0), (2, 0))
    assert set(first.values()) == {"b1", "b2"}
    second = ids((0.4, 0.3), (2.4, -0.2))
    assert list(second.values()) == list(first.values())
    assert ids((2.6, -0.2)) == {(2.6, -0.2): first[2, 0]}
    assert ids((0.5, 0.3), (-2.5, -2)) == {(0.5, 0.3): first[0, 0], (-2.5, -2): "b3"}
    for _ in range(FORGOTTEN + 1):
        ids((-2.5, -2))
    assert ids((0.5, 0.3)) == {(0.5, 0.3): "b4"}
    scene.reset()
    assert ids((0.5, 0.3)) == {(0.5, 0.3): "b1"}


def test_the_component_fits_everybody_or_nobody(person: np.ndarray, floor: np.ndarray) -> None:
    quick = BodyFitterSettings(
        scene=True, particles=4, iterations=1, local_particles=4, local_iterations=0, restarts=0, lm_steps=1,
        refine_iterations=3, cloud_points=1000, surface_finish=False, limb_rounds=0,
    )  # fmt: skip
    factory = BagMessageFactory()
    component = BodyFitterComponent(quick, factory)
    header = factory.make("std_msgs/msg/Header", frame_id="map")
    cloud = np.concatenate([floor, person, person + np.array([2.0, 1.0, 0.0])])
    message, fits = component.fit(make_cloud(factory, header, cloud), None, seed=0)
    assert sorted(body.id for body in message.bodies) == ["b1", "b2"]
    middles = sorted(tuple(np.round(fit.vertices[:, :2].mean(axis=0))) for _, fit in fits)
    assert middles == [(0.0, 0.0), (2.0, 1.0)]
    message, fits = component.fit(make_cloud(factory, header, floor), None, seed=0)
    assert not message.bodies and not fits
    with pytest.raises(InputError):
        BodyFitterComponent(BodyFitterSettings(), factory).fit(make_cloud(factory, header, floor[:3]), None, seed=0)
