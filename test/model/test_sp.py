# SPDX-License-Identifier: Apache-2.0
"""The Stitched Puppet: topology, equations against loops, stitching, mirror symmetry and plausible samples."""

import numpy as np
import pytest

from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import MAX_DEVIATIONS, POSE_WIDTH, BodyState, StitchedPuppet

MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module", params=["neutral", "female", "male"])
def model(request: pytest.FixtureRequest) -> StitchedPuppet:
    return StitchedPuppet.load(request.param)


@pytest.fixture(scope="module")
def neutral() -> StitchedPuppet:
    return StitchedPuppet.load("neutral")


def random_state(model: StitchedPuppet, seed: int, batch: tuple[int, ...] = ()) -> BodyState:
    """Make a state that is not stitched: every part is anywhere."""
    rng, parts = np.random.default_rng(seed), len(model.tree)
    pose = rng.normal(size=(*batch, parts, POSE_WIDTH))
    for i in range(parts):
        pose[..., i, model.pose_count(i) :] = 0
    turned = rotation.exp(rng.normal(size=(*batch, parts, 3)))
    shape = rng.normal(size=(*batch, parts, model.shape_count))
    return BodyState(rng.normal(size=(*batch, parts, 3)), turned, pose, shape)


def gaps(model: StitchedPuppet, state: BodyState) -> np.ndarray:
    """Return the mean distance of the interface points of every edge."""
    parts = model.parts(state)
    pairs = zip(model.interfaces, model.tree.edges, strict=True)
    return np.array(
        [np.linalg.norm(parts[i][s.parent_index] - parts[j][s.child_index], axis=1).mean() for s, (i, j) in pairs]
    )


def directed_edges(faces: np.ndarray) -> np.ndarray:
    """Return the edges of faces (F,3) in the direction they are walked."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def test_template_is_a_closed_oriented_surface(model: StitchedPuppet) -> None:
    edges = directed_edges(model.faces)
    assert len(np.unique(edges, axis=0)) == len(edges), "two faces walk an edge in the same direction"
    assert {tuple(e) for e in edges} == {tuple(e) for e in edges[:, ::-1]}, "an edge has one face only"
    assert len(model.part_of_vertex) - len(edges) // 2 + len(model.faces) == 2, "not a sphere"
    assert len(np.unique(model.faces)) == len(model.part_of_vertex)


def test_template_points_outwards_and_has_the_volume_of_a_person(model: StitchedPuppet) -> None:
    a, b, c = model.vertices(model.rest_state())[model.faces].transpose(1, 0, 2)
    assert 0.03 < np.einsum("ij,ij->", a, np.cross(b, c)) / 6 < 0.12


def test_parts_cover_the_template_once(model: StitchedPuppet) -> None:
    faces = np.concatenate([ids[local] for ids, local in zip(model.part_vertices, model.part_faces, strict=True)])
    assert sorted(map(tuple, faces)) == sorted(map(tuple, model.faces))


def test_parts_are_rings_and_caps(model: StitchedPuppet) -> None:
    openings = [len(model.tree.neighbours(i)) for i in range(len(model.tree))]
    for local, opened in zip(model.part_faces, openings, strict=True):
        edges = np.unique(np.sort(directed_edges(local), axis=1), axis=0)
        assert len(np.unique(local)) - len(edges) + len(local) == 2 - opened, "a part is torn or has a hole"


def test_only_neighbours_share_vertices(model: StitchedPuppet) -> None:
    for i in range(len(model.tree)):
        for j in range(i):
            shared = np.intersect1d(model.part_vertices[i], model.part_vertices[j])
            if model.tree.parents[i] == j:
                interface = model.interfaces[i - 1]
                np.testing.assert_array_equal(model.part_vertices[j][interface.parent_index], shared)
                np.testing.assert_array_equal(model.part_vertices[i][interface.child_index], shared)
                assert len(shared) >= 8
            else:
                assert len(shared) == 0, f"{model.tree.names[i]} touches {model.tree.names[j]}"


def test_only_knees_and_elbows_stretch(model: StitchedPuppet) -> None:
    rest = model.vertices(model.rest_state())
    for (parent, child), interface in zip(model.tree.edges, model.interfaces, strict=True):
        soft = np.isclose(interface.weight, 0.8)
        assert np.all(soft | (interface.weight == 1))
        assert soft.any() == model.tree.names[child].endswith(("lower_leg", "lower_arm"))
        if model.tree.names[child].endswith("lower_leg"):
            points = rest[model.part_vertices[parent][interface.parent_index]]
            assert points[soft, 0].mean() > points[~soft, 0].mean(), "the front of the knee stretches"


def test_part_mesh_is_equations_45_to_47(neutral: StitchedPuppet) -> None:
    state = random_state(neutral, 3)
    for i in (0, 5, 11):
        d, s = state.pose[i], state.shape[i]
        mesh = neutral.part_mesh(i, state.center[i], state.rotation[i], d, s)
        for k in (0, 17, len(mesh) - 1):
            q = neutral.mean_shape[i][k] + sum(neutral.shape_basis[i][k, :, c] * s[c] for c in range(len(s)))
            p = q + neutral.mean_pose[i][k]
            p = p + sum(neutral.pose_basis[i][k, :, c] * d[c] for c in range(neutral.pose_count(i)))
            np.testing.assert_allclose(mesh[k], state.rotation[i] @ p + state.center[i], atol=1e-12)


def test_whole_body_is_the_mean_of_its_parts(neutral: StitchedPuppet) -> None:
    state = random_state(neutral, 4)
    parts, vertices = neutral.parts(state), neutral.vertices(state)
    for v in (0, 1000, *neutral.part_vertices[3][neutral.interfaces[2].child_index]):
        copies = [m[ids == v] for m, ids in zip(parts, neutral.part_vertices, strict=True)]
        np.testing.assert_allclose(vertices[v], np.concatenate(copies).mean(axis=0), atol=1e-12)


def test_batches_are_the_same_as_one_by_one(neutral: StitchedPuppet) -> None:
    batch = random_state(neutral, 5, (2, 3))
    vertices = neutral.vertices(batch)
    one = BodyState(batch.center[1, 2], batch.rotation[1, 2], batch.pose[1, 2], batch.shape[1, 2])
    np.testing.assert_allclose(vertices[1, 2], neutral.vertices(one), atol=1e-12)
    np.testing.assert_allclose(neutral.joints(vertices)[1, 2], neutral.joints(vertices[1, 2]), atol=1e-12)
    far = np.array([5e5, 5.5e6, 300.0])
    np.testing.assert_allclose(neutral.joints(vertices + far) - far, neutral.joints(vertices), atol=1e-7)


def test_stitch_undoes_a_motion(neutral: StitchedPuppet) -> None:
    rng = np.random.default_rng(6)
    child = neutral.tree.index("left_lower_arm")
    parent = neutral.tree.parents[child]
    d, s = rng.normal(size=POSE_WIDTH), rng.normal(size=neutral.shape_count)
    turned, centre = rotation.exp(np.array([0.3, 2.0, -0.5])), np.array([1.0, -2.0, 0.5])
    target = neutral.part_mesh(child, centre, turned, d, s)[neutral.interfaces[child - 1].child_index]
    found, at = neutral.stitch(child, parent, target, d, s)
    np.testing.assert_allclose(found, turned, atol=1e-9)
    np.testing.assert_allclose(at, centre, atol=1e-9)
    with pytest.raises(ValueError, match="not the parent"):
        neutral.stitch(child, 0, target, d, s)


def test_template_pose_has_no_gaps_and_its_sides_are_right(model: StitchedPuppet) -> None:
    state = model.rest_state()
    assert gaps(model, state).max() < 0.01
    vertices = model.vertices(state)
    joints = dict(zip(model.joint_names, model.joints(vertices), strict=True))
    left = [name for name in joints if name.startswith("left_")]
    assert len(left) >= 10
    for name in left:
        assert joints[name][1] > 0.02
        np.testing.assert_allclose(joints["right_" + name[5:]] * MIRROR, joints[name], atol=1e-5)
    assert joints["nose"][0] > joints["face"][0] + 0.05, "the person faces forward"
    assert joints["left_toe"][0] > joints["left_heel"][0] + 0.15
    heights = [joints[n][2] for n in ("head_top", "face", "neck", "belly", "left_hip", "left_knee", "left_ankle")]
    assert np.all(np.diff(heights) < -0.05)
    assert 1.5 < np.ptp(vertices[:, 2]) < 1.85


def test_mirror_image_of_a_body(model: StitchedPuppet) -> None:
    other = model.mirror_vertex
    np.testing.assert_array_equal(other[other], np.arange(len(other)))
    state = random_state(model, 7)
    image = model.vertices(state)[other] * MIRROR
    np.testing.assert_allclose(model.vertices(model.mirror(state)), image, atol=1e-6)


def test_relative_rotations_are_as_likely_in_the_mirror(model: StitchedPuppet) -> None:
    for edge, (_, child) in enumerate(model.tree.edges):
        other = model.tree.mirror[child] - 1
        np.testing.assert_allclose(model.limit_low[other][[0, 2]], -model.limit_high[edge][[0, 2]], atol=0.02)
        mean = model.pairwise[edge].mean[:3] * [-1, 1, -1]
        np.testing.assert_allclose(model.pairwise[other].mean[:3], mean, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_samples_are_stitched_and_within_limits(model: StitchedPuppet, seed: int) -> None:
    state = model.sample(np.random.default_rng(seed))
    assert gaps(model, state).mean() < 0.012
    assert gaps(model, state).max() < 0.06
    assert np.abs(state.pose).max() <= 3
    assert np.abs(state.shape).max() <= 3
    for edge, (parent, child) in enumerate(model.tree.edges):
        relative = rotation.log(state.rotation[parent].T @ state.rotation[child])
        assert np.all(relative > model.limit_low[edge] - 1e-6)
        assert np.all(relative < model.limit_high[edge] + 1e-6)


def test_samples_depend_on_the_seed_alone(neutral: StitchedPuppet) -> None:
    first, second, third = (neutral.sample(np.random.default_rng(seed)) for seed in (8, 8, 9))
    np.testing.assert_array_equal(first.center, second.center)
    np.testing.assert_array_equal(first.pose, second.pose)
    assert np.abs(first.pose - third.pose).max() > 0.1


def test_many_samples_are_those_drawn_one_by_one(neutral: StitchedPuppet) -> None:
    rng = np.random.default_rng(4)
    single = [neutral.sample(rng, 0.7, 0.9) for _ in range(5)]
    many = neutral.sample_many(np.random.default_rng(4), 5, 0.7, 0.9)
    for name in ("center", "rotation", "pose", "shape"):
        np.testing.assert_allclose(getattr(many, name), [getattr(each, name) for each in single], atol=1e-9)
    assert (neutral.sample_many(rng, 3, 0.0).shape == 0).all()


def test_poses_of_neighbours_are_drawn_with_their_covariance(neutral: StitchedPuppet) -> None:
    """The torso's coefficients are standard normal, and the upper leg's follow from them by the pairwise Gaussian."""
    child = neutral.tree.names.index("left_upper_leg")
    parent, pair = neutral.tree.parents[child], neutral.pairwise[child - 1]
    given, own = neutral.pose_count(parent), neutral.pose_count(child)
    drawn = neutral.sample_many(np.random.default_rng(6), 4000, 0.0)
    inside = (np.abs(drawn.pose[:, parent]) < MAX_DEVIATIONS).all(axis=1)
    poses = np.concatenate([drawn.pose[inside, parent, :given], drawn.pose[inside, child, :own]], axis=1)
    residual = [
        pose[given:] - pair.condition(np.arange(3 + given, 3 + given + own), np.arange(3, 3 + given), pose[:given]).mean
        for pose in poses
    ]
    expected = pair.condition(np.arange(3 + given, 3 + given + own), np.arange(3, 3 + given), np.zeros(given))
    np.testing.assert_allclose(np.mean(residual, axis=0), 0, atol=0.06)
    np.testing.assert_allclose(np.cov(residual, rowvar=False), expected.covariance, atol=0.08)


def test_people_differ_in_stature_and_bulk(model: StitchedPuppet) -> None:
    rest, rng, statures, volumes = model.rest_state(), np.random.default_rng(10), [], []
    for _ in range(40):
        shape = np.tile(np.clip(rng.normal(size=model.shape_count), -3, 3), (len(model.tree), 1))
        state = BodyState(rest.center.copy(), rest.rotation.copy(), rest.pose, shape)
        for parent, child in model.tree.edges:
            interface = model.interfaces[child - 1]
            mesh = model.part_mesh(parent, state.center[parent], state.rotation[parent], rest.pose[parent], shape[0])
            points = mesh[interface.parent_index]
            placed = model.stitch(child, parent, points, rest.pose[child], shape[0])
            state.rotation[child], state.center[child] = placed
        vertices = model.vertices(state)
        a, b, c = vertices[model.faces].transpose(1, 0, 2)
        statures.append(np.ptp(vertices[:, 2]))
        volumes.append(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
    assert 1.35 < min(statures) < max(statures) < 2.1
    assert np.ptp(statures) > 0.2
    assert max(volumes) > 1.6 * min(volumes)


def test_men_are_taller_than_women() -> None:
    woman, man = (StitchedPuppet.load(name) for name in ("female", "male"))
    stature = [np.ptp(m.vertices(m.rest_state())[:, 2]) for m in (woman, man)]
    assert stature[1] > stature[0] + 0.05
    np.testing.assert_array_equal(woman.faces, man.faces)


def test_height_is_that_of_the_template_pose(model: StitchedPuppet) -> None:
    rng = np.random.default_rng(3)
    for scale in (0.0, 1.0, 3.0):
        shape = scale * rng.standard_normal((len(model.tree), model.shape_count))
        z = model.vertices(model.rest_state(shape))[:, 2]
        assert model.measure_height(shape) == pytest.approx(z.max() - z.min(), abs=1e-9)
