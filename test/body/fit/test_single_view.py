# SPDX-License-Identifier: Apache-2.0
"""Bodies in clouds from one side: free space, what is hidden, and fits of a man made of capsules."""

from __future__ import annotations

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.single_view import MIN_DEPTH_TOLERANCE_M, SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.fit.pose_bank import CoarseCloud, PoseBank
from flowing_puppet_ros.body.search.part_points import build_part_points
from flowing_puppet_ros.body.search.particles import states_to_particles
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet

SENSOR = np.array([3.0, -1.0, 0.6])
LIMB_JOINTS = tuple(
    f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
)


@pytest.fixture(scope="module")
def fitter() -> BodyFitter:
    return BodyFitter(StitchedPuppet.load("neutral"), FitterSettings())


def one_side(lift: float, count: int, noise: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The points of a capsule man that the sensor sees, nearest in each direction, with noise along the ray."""
    rng = np.random.default_rng(5)
    joints = joints_of(raise_left=lift, bend=0.8)
    points, normals = cloud_of(joints, count)
    rays = points - SENSOR
    depth = np.linalg.norm(rays, axis=1)
    cell = np.round(rays / depth[:, None] / 0.012).astype(int)
    nearest: dict[tuple[int, ...], float] = {}
    for key, distance in zip(map(tuple, cell), depth, strict=True):
        nearest[key] = min(nearest.get(key, np.inf), distance)
    first = np.array([distance < nearest[key] + 0.03 for key, distance in zip(map(tuple, cell), depth, strict=True)])
    seen = first & ((rays * normals).sum(axis=1) < 0)
    return points[seen] + (rays / depth[:, None])[seen] * rng.normal(0, noise, (seen.sum(), 1)), joints


def errors_of(fitter: BodyFitter, fit: BodyFit, joints: dict[str, np.ndarray]) -> np.ndarray:
    found = dict(zip(fitter.model.joint_names, fit.joints, strict=True))
    return np.array([np.linalg.norm(found[name] - joints[name]) for name in LIMB_JOINTS])


@pytest.mark.slow
@pytest.mark.parametrize(("lift", "count", "noise"), [(1.4, 6000, 0.005), (0.4, 1200, 0.02)])
def test_depth_cameras_and_lidars_show_the_joints_and_the_sides(
    fitter: BodyFitter, lift: float, count: int, noise: float
) -> None:
    points, joints = one_side(lift, count, noise)
    assert (len(points) < 700) == (count == 1200)
    done: list[float] = []
    fit = fitter.fit(points, None, viewpoint=SENSOR, progress=done.append)
    errors = errors_of(fitter, fit, joints)
    assert errors.mean() < 0.07
    assert errors.max() < 0.2
    assert done == sorted(done) and done[-1] == 1.0
    if count == 1200:
        again = fitter.fit(points, None, viewpoint=SENSOR)
        assert again.vertices.tobytes() == fit.vertices.tobytes()


def test_free_space_draws_out_what_stands_in_it_and_nothing_else() -> None:
    points, _ = one_side(0.6, 6000, 0.0)
    cloud = SingleViewCloud.seen_from(points, np.zeros_like(points), SENSOR)
    forward = cloud.view.axes[2]
    side = cloud.view.axes[0]
    behind, before = points[::50] + 0.3 * forward, points[::50] - 0.05 * forward
    beside = points.mean(axis=0) + 1.5 * side
    assert not cloud.free_space_term(behind, 0.1).matrix.any()
    attracted = cloud.free_space_term(np.concatenate([before, beside[None]]), 0.1)
    # The step of a Gauss-Newton on each vertex alone, pseudo-inverse because other directions are free.
    steps = -np.einsum("vij,vj->vi", np.linalg.pinv(attracted.matrix), attracted.vector)
    assert np.median(np.abs(steps[:-1] @ forward - (0.05 - MIN_DEPTH_TOLERANCE_M))) < 0.01
    assert steps[-1] @ side < -0.5
    assert abs(steps[-1] @ (beside - SENSOR)) < 1e-9 * np.linalg.norm(beside - SENSOR) + 1e-9
    far = cloud.free_space_term(np.concatenate([before, beside[None]]), 0.01)
    assert np.trace(far.matrix[-1]) < 0.01 * np.trace(attracted.matrix[-1])


def test_hidden_vertices_are_not_seen(fitter: BodyFitter) -> None:
    model = fitter.model
    body = model.rest_state()
    vertices = model.vertices(body)
    normals = vertex_normals(vertices, model.faces)
    sensor = np.array([0.0, 3.0, 0.3])  # the left arm hides part of the trunk
    facing = ((sensor - vertices) * normals).sum(axis=1) > 0
    arm = np.isin(model.part_of_vertex, [model.tree.index(f"left_{part}") for part in ("upper_arm", "lower_arm")])
    cloud = SingleViewCloud.seen_from(vertices[facing & arm], normals[facing & arm], sensor)
    seen = cloud.sees(vertices, normals)
    assert seen[facing & arm].mean() > 0.97
    shadow = facing & cloud.view.find_hidden(vertices)
    assert shadow.sum() > 50 and not seen[shadow].any()
    assert not seen[~facing].any()
    with pytest.raises(InputError, match="within the cloud"):
        SingleViewCloud.seen_from(vertices, normals, vertices.mean(axis=0))


@pytest.mark.slow
def test_bank_scores_bodies_by_all_or_by_some_of_their_parts(fitter: BodyFitter) -> None:
    model = fitter.model
    bank = PoseBank(model, build_part_points(model))
    points, normals = cloud_of(joints_of(), 3000)
    coarse = CoarseCloud.of(Cloud.of(points, normals), 60)
    bodies = bank.find_best(coarse, 4)
    cost = [bank.cost(body, coarse) for body in bodies]
    assert cost == sorted(cost)
    groups = states_to_particles(model, bodies)
    whole = bank.coverage_cost(groups, coarse, range(16))
    np.testing.assert_allclose(whole.cost, cost)
    legs = [part for part in range(16) if "leg" in model.tree.names[part]]
    others = [part for part in range(16) if part not in legs]
    rest = bank.coverage_cost(groups, coarse, others)
    np.testing.assert_allclose(bank.coverage_cost(groups, coarse, legs, rest.distance).distance, whole.distance)


@pytest.mark.slow
def test_a_body_promises_more_upright_than_lying(fitter: BodyFitter) -> None:
    points, _ = cloud_of(joints_of(raise_left=0.3), 3000)
    upright = fitter.coarse_cost(points)
    assert upright < fitter.coarse_cost(points @ np.diag([1.0, -1.0, -1.0]))
    assert upright < 0.8 * fitter.coarse_cost(points[:, [2, 0, 1]])
