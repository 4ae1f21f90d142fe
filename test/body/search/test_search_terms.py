# SPDX-License-Identifier: Apache-2.0
"""Terms and moves of the search against brute force and known answers."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import farthest_points, vertex_normals
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, flip_heading, make_joint_targets
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles, stitching_costs
from flowing_puppet_ros.body.search.part_points import PartPoints
from flowing_puppet_ros.body.search.particles import Particles, particles_to_state, states_to_particles
from flowing_puppet_ros.body.search.proposals import Conditional, Proposer, WalkNoise
from flowing_puppet_ros.body.search.schedule import four_stages, local_stages
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.gaussian import Gaussian
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

UPPER_LEG = 10


def copies(model: StitchedPuppet, count: int) -> list[Particles]:
    return states_to_particles(model, [model.rest_state()] * count)


def test_stitching_costs_equal_the_sum_of_eq_48() -> None:
    rng = np.random.default_rng(0)
    weight, parent, child = rng.uniform(0.5, 1, 7), rng.normal(size=(4, 7, 3)) + 9, rng.normal(size=(5, 7, 3)) + 9
    centers = rng.uniform(0, 0.06, (4, 3)), rng.uniform(0, 0.06, (5, 3))
    costs = stitching_costs(weight, parent, child, centers, 3.0)
    for p in range(4):
        for q in range(5):
            gap = (weight * ((parent[p] - child[q]) ** 2).sum(axis=1)).sum() / weight.sum()
            close = np.linalg.norm(centers[0][p] - centers[1][q]) < 0.05
            assert costs[p, q] == pytest.approx(3.0 * gap + close)


def test_points_of_parts_equal_the_model(model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
    body = model.sample(np.random.default_rng(1))
    meshes, joints = model.parts(body), model.joints(model.vertices(model.rest_state()))
    rest = states_to_particles(model, [model.rest_state()])
    for part, group in enumerate(states_to_particles(model, [body])):
        surface = points[part].surface.to_world(group)[0]
        distance = np.linalg.norm(surface[:, None] - meshes[part], axis=2).min(axis=1)
        assert distance.max() < 1e-9
        own = points[part].joints.to_world(rest[part])[0]
        np.testing.assert_allclose(own, joints[points[part].joint_index], atol=1e-6)
    for edge, (parent, child) in enumerate(model.tree.edges):
        interface = model.interfaces[edge]
        at_child = points[child].interfaces[edge].to_world(states_to_particles(model, [body])[child])[0]
        np.testing.assert_allclose(at_child, meshes[child][interface.child_index])
        assert parent == model.tree.parents[child]


def test_farthest_points_spread_and_are_different() -> None:
    cloud = np.random.default_rng(0).uniform(size=(300, 3))
    chosen = farthest_points(cloud, 30)
    assert len(set(chosen.tolist())) == 30
    gaps = np.linalg.norm(cloud[chosen][:, None] - cloud[chosen], axis=2) + np.eye(30)
    assert gaps.min() > 0.2
    assert sorted(farthest_points(cloud[:5], 30).tolist()) == [0, 1, 2, 3, 4]


def test_normals_of_the_template_point_outward(model: StitchedPuppet) -> None:
    vertices = model.vertices(model.rest_state())
    normals = vertex_normals(vertices, model.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    corners = vertices[model.faces]
    volume = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6
    moved = (vertices + 0.01 * normals)[model.faces]
    assert (np.cross(moved[:, 0], moved[:, 1]) * moved[:, 2]).sum() / 6 > volume + 0.01


def test_scored_particles_survive_taking_and_joining(model: StitchedPuppet, points: tuple[PartPoints, ...]) -> None:
    rng = np.random.default_rng(0)
    group = Proposer(model, points).random_walk(copies(model, 6)[UPPER_LEG], WalkNoise(0.1, 0.3, 1.0, 1.0), rng)
    vertices = model.vertices(model.rest_state())
    grid = CloudGrid.build(vertices, vertex_normals(vertices, model.faces))
    targets = JointTargets(np.zeros((len(model.joint_names), 3)), np.ones(len(model.joint_names)))
    whole = ScoredParticles.score(points[UPPER_LEG], group, grid, targets)
    order = np.array([4, 0, 5, 1])
    again = whole.take(order[:2]).extend(whole.take(order[2:]))
    direct = ScoredParticles.score(points[UPPER_LEG], group.take(order), grid, targets)
    for name in ("distance", "mismatch", "joint_cost"):
        np.testing.assert_allclose(getattr(again, name), getattr(direct, name))
    for edge, interface in direct.interfaces.items():
        np.testing.assert_allclose(again.interfaces[edge], interface)
    knee = model.joint_names.index("right_knee")
    assert knee in points[UPPER_LEG].joint_index.tolist()


def test_conditional_samples_have_the_gaussian_s_moments() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(5, 5))
    joint = Gaussian(rng.normal(size=5), factor @ factor.T)
    kept, given, values = np.array([1, 3]), np.array([0, 4]), np.array([0.5, -1.0])
    sampled = Conditional.of(joint, kept, given).sample(rng, np.tile(values, (40000, 1)))
    exact = joint.condition(kept, given, values)
    np.testing.assert_allclose(sampled.mean(axis=0), exact.mean, atol=0.05)
    np.testing.assert_allclose(np.cov(sampled.T), exact.covariance, atol=0.05 * np.abs(exact.covariance).max())


def test_neighbours_propose_parts_that_are_stitched_to_them(
    model: StitchedPuppet, points: tuple[PartPoints, ...]
) -> None:
    vertices = model.vertices(model.rest_state())
    grid = CloudGrid.build(vertices, vertex_normals(vertices, model.faces))
    none = JointTargets.none(model)
    scored = [ScoredParticles.score(p, group, grid, none) for p, group in zip(points, copies(model, 12), strict=True)]
    proposer, noise = Proposer(model, points), WalkNoise(0.04, 0.25, 0.5, 0.3)
    new = proposer.propose(UPPER_LEG, scored, noise, 1.0, np.random.default_rng(0))
    assert len(new) == 12
    moved = ScoredParticles.score(points[UPPER_LEG], new, grid, none)
    gaps = [
        np.linalg.norm(moved.interfaces[edge] - scored[other].interfaces[edge][:1], axis=2).mean(axis=1)
        for edge, other in (
            (UPPER_LEG - 1, 0),
            (model.tree.children(UPPER_LEG)[0] - 1, model.tree.children(UPPER_LEG)[0]),
        )
    ]
    assert np.minimum(*gaps).max() < 0.03
    np.testing.assert_allclose(
        new.rotation @ new.rotation.transpose(0, 2, 1), np.tile(np.eye(3), (12, 1, 1)), atol=1e-9
    )


def test_states_and_particles_are_inverse(model: StitchedPuppet) -> None:
    bodies = [model.sample(np.random.default_rng(seed)) for seed in range(3)]
    back = particles_to_state(model, states_to_particles(model, bodies), np.full(16, 2))
    for name in ("center", "rotation", "pose", "shape"):
        np.testing.assert_array_equal(getattr(back, name), getattr(bodies[2], name))


def test_flipping_the_heading_twice_restores_the_body(model: StitchedPuppet) -> None:
    body = model.sample(np.random.default_rng(0))
    once = flip_heading(model, body)
    hand, other = model.tree.index("left_hand"), model.tree.index("right_hand")
    np.testing.assert_array_equal(once.center[hand], body.center[other])
    np.testing.assert_allclose(once.rotation[0, :2, 0], -body.rotation[0, :2, 0])
    twice = flip_heading(model, once)
    np.testing.assert_allclose(twice.center, body.center)
    np.testing.assert_allclose(twice.rotation, body.rotation)


def test_stages_end_with_all_parts_counting(model: StitchedPuppet) -> None:
    for stages in (four_stages(model.tree), local_stages(model.tree)):
        assert stages[-1].until == 1.0 and stages[-1].greedy
        assert np.all(stages[-1].data == 1.0)
    first = four_stages(model.tree)[0]
    assert first.data[model.tree.index("left_foot")] == 0.001
    assert first.stitch[model.tree.index("left_foot") - 1] == 0.001
    assert first.stitch[model.tree.index("left_upper_leg") - 1] == 0.5


def squatting(model: StitchedPuppet) -> dict[str, np.ndarray]:
    """Joints of an invented person: knees and elbows bent at right angles, longer limbs than the template's."""
    joints = dict(zip(model.joint_names, model.joints(model.vertices(model.rest_state())), strict=True))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        joints[f"{side}_knee"] = joints[f"{side}_hip"] + 0.45 * np.array([0.8, 0.3 * sign, -0.5])
        joints[f"{side}_ankle"] = joints[f"{side}_knee"] + [-0.1, 0.0, -0.42]
        joints[f"{side}_toe"] = joints[f"{side}_ankle"] + [0.15, 0.02 * sign, -0.05]
        joints[f"{side}_elbow"] = joints[f"{side}_shoulder"] + [0.0, 0.2 * sign, -0.2]
        joints[f"{side}_wrist"] = joints[f"{side}_elbow"] + [0.24, 0.0, 0.05]
    names = ("neck", "face", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe")
    return {name: at for name, at in joints.items() if name.endswith(names)}


def test_body_is_placed_on_joints(model: StitchedPuppet) -> None:
    turn, shift = so3.exp(np.array([0.0, 0.0, 2.5])), np.array([3.0, 1.0, 0.5])
    goal = {name: turn @ at + shift for name, at in squatting(model).items()}
    targets = make_joint_targets(model, {name: (at[0], at[1], at[2], 1.0) for name, at in goal.items()})
    body = body_from_joints(model, GaussNewton(model), targets)
    found = dict(zip(model.joint_names, model.joints(model.vertices(body)), strict=True))
    errors = {name: np.linalg.norm(found[name] - at) for name, at in goal.items()}
    assert max(errors.values()) < 0.08
    assert sum(errors.values()) < 0.03 * len(errors)


def test_too_few_joints_are_refused(model: StitchedPuppet) -> None:
    with pytest.raises(InputError, match="1 of the 3"):
        make_joint_targets(model, {"neck": (0, 0, 0, 1), "face": (np.nan, 0, 0, 1), "wing": (0, 0, 0, 1)})


def test_a_trunk_on_a_line_faces_where_the_limbs_say(model: StitchedPuppet) -> None:
    turn = so3.exp(np.array([0.0, 0.0, 2.5]))
    spine = ("neck", "belly", "pelvis")
    goal = {name: turn @ at for name, at in squatting(model).items() if "shoulder" not in name and "hip" not in name}
    rest = dict(zip(model.joint_names, model.joints(model.vertices(model.rest_state())), strict=True))
    goal = {name: at for name, at in goal.items() if name != "face"} | {name: turn @ rest[name] for name in spine}
    body = body_from_joints(
        model, GaussNewton(model), make_joint_targets(model, {name: (*at, 1.0) for name, at in goal.items()})
    )
    assert (body.rotation[0] @ [1, 0, 0]) @ (turn @ [1, 0, 0]) > 0.9
    with pytest.raises(InputError, match="on a line"):
        make_joint_targets(model, {name: (0, 0, float(k), 1) for k, name in enumerate((*spine, "face"))})


def test_gauss_newton_moves_a_perturbed_body_to_the_surface_of_another_shape(model: StitchedPuppet) -> None:
    rng = np.random.default_rng(2)
    truth = model.sample(rng, shape_scale=1.0, pose_scale=0.5)
    vertices = model.vertices(truth)
    cloud = Cloud.of(vertices, vertex_normals(vertices, model.faces))
    center = truth.center + rng.normal(0, 0.02, truth.center.shape)
    rotation = so3.exp(rng.normal(0, 0.1, (16, 3))) @ truth.rotation
    start = BodyState(center, rotation, np.zeros_like(truth.pose), np.zeros_like(truth.shape))
    refined = GaussNewton(model).run(start, cloud, JointTargets.none(model), RefineWeights())
    before = np.linalg.norm(model.vertices(start) - vertices, axis=1).mean()
    after = np.linalg.norm(model.vertices(refined) - vertices, axis=1).mean()
    assert before > 0.02
    assert after < 0.008
    meshes = model.parts(refined)
    for edge, (parent, child) in enumerate(model.tree.edges):
        interface = model.interfaces[edge]
        gap = meshes[parent][interface.parent_index] - meshes[child][interface.child_index]
        assert np.linalg.norm(gap, axis=1).mean() < 0.006
