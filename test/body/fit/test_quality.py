# SPDX-License-Identifier: Apache-2.0
"""The quality of bodies with known faults: a hand in the air, an unexplained limb, an arm in an arm."""

from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.quality import KERNEL_WIDTH_M, assess_fit
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


@pytest.fixture(scope="module")
def body(model: StitchedPuppet) -> BodyState:
    return model.sample(np.random.default_rng(3), pose_scale=0.3)


@pytest.fixture(scope="module")
def cloud(model: StitchedPuppet, body: BodyState) -> Cloud:
    vertices = model.vertices(body)
    return Cloud.of(vertices, vertex_normals(vertices, model.faces))


def moved(body: BodyState, parts: tuple[int, ...], by: tuple[float, float, float]) -> BodyState:
    center = body.center.copy()
    center[list(parts)] += by
    return replace(body, center=center)


def test_nothing_speaks_against_the_body_itself(model: StitchedPuppet, body: BodyState, cloud: Cloud) -> None:
    quality = assess_fit(model, model.vertices(body), cloud)
    np.testing.assert_allclose(quality.part_confidence, 1.0)
    assert quality.seen.all() and quality.reliable and not quality.limb_suspect
    assert quality.explained == pytest.approx(1.0) and quality.confidence == pytest.approx(1.0)
    assert quality.uncovered == 0 and quality.self_intersections == 0
    assert quality.distance == quality.cost < 0.01


@pytest.mark.slow
def test_a_hand_in_the_air_is_seen_both_ways(model: StitchedPuppet, body: BodyState, cloud: Cloud) -> None:
    hand = model.tree.index("left_hand")
    vertices = model.vertices(moved(body, (hand,), (0.0, 0.6, 0.6)))
    quality = assess_fit(model, vertices, cloud)
    assert quality.part_confidence[hand] < 0.05
    assert np.delete(quality.part_confidence, [hand, model.tree.parents[hand]]).min() > 0.95
    gap = np.linalg.norm(cloud.points[:, None] - vertices[None, ::1], axis=2).min(axis=1)
    assert quality.uncovered == pytest.approx((gap > 0.04).mean())
    assert quality.explained == pytest.approx(((KERNEL_WIDTH_M**2 / (KERNEL_WIDTH_M**2 + gap**2)) ** 2).mean())
    assert quality.limb_suspect and not quality.reliable
    lowered = (1 + quality.part_confidence[hand] / 0.3) / 2
    mean = np.sqrt(quality.part_confidence.mean() * quality.explained)
    assert quality.confidence == pytest.approx(mean * lowered)


def test_a_leg_on_the_other_one_leaves_its_cloud_uncovered(
    model: StitchedPuppet, body: BodyState, cloud: Cloud
) -> None:
    names = ("upper_leg", "lower_leg", "foot")
    left, right = ([model.tree.index(f"{side}_{name}") for name in names] for side in ("left", "right"))
    center, rotation = body.center.copy(), body.rotation.copy()
    center[right], rotation[right] = center[left], rotation[left]
    quality = assess_fit(model, model.vertices(replace(body, center=center, rotation=rotation)), cloud)
    assert quality.part_confidence[right].min() > 0.4
    assert quality.uncovered > 0.05
    assert quality.limb_suspect


def test_an_arm_in_an_arm_is_a_fold_that_costs(model: StitchedPuppet, body: BodyState, cloud: Cloud) -> None:
    upper, lower = model.tree.index("left_upper_arm"), model.tree.index("left_lower_arm")
    away = tuple(body.center[upper] - body.center[lower] + 0.01)
    quality = assess_fit(model, model.vertices(moved(body, (lower,), away)), cloud)
    assert quality.self_intersections == 1
    assert quality.cost > quality.distance
    assert quality.limb_suspect and not quality.reliable


def test_parts_that_the_sensor_cannot_see_are_not_held_against_the_body(
    model: StitchedPuppet, body: BodyState, cloud: Cloud
) -> None:
    sensor = np.array([4.0, 0.0, 0.5])
    facing = cloud.sees(cloud.points, cloud.normals) & (((sensor - cloud.points) * cloud.normals).sum(axis=1) > 0)
    half = Cloud.of(cloud.points[facing], cloud.normals[facing], sensor)
    quality = assess_fit(model, model.vertices(body), half)
    assert quality.reliable and quality.confidence > 0.95
    none = Cloud.of(cloud.points, cloud.normals, np.array([0.0, 0.0, 0.0]))
    inside = assess_fit(model, model.vertices(body), none)
    assert not inside.seen.all()


def test_points_that_the_noise_of_the_sensor_explains_are_not_stray(model: StitchedPuppet, body: BodyState) -> None:
    sensor, rng = np.array([4.0, 0.0, 0.5]), np.random.default_rng(0)
    points, normals = sample_surface(model.vertices(body), model.faces, rng, 20000)
    facing = ((sensor - points) * normals).sum(axis=1) > 0
    points, normals = points[facing], normals[facing]
    ray = (points - sensor) / np.linalg.norm(points - sensor, axis=1, keepdims=True)
    noisy = points + 0.032 * rng.standard_normal((len(points), 1)) * ray
    seen = SingleViewCloud.seen_from(noisy, normals, sensor)
    quality = assess_fit(model, model.vertices(body), seen)
    assert quality.uncovered > 0.05 > quality.stray
    assert quality.reliable
    assert not assess_fit(model, model.vertices(body), replace(seen, plane_noise=0.0)).reliable
