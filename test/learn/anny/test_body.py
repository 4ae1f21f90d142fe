# SPDX-License-Identifier: Apache-2.0
"""The Anny body and its poses: frame, symmetry, stature, motion-capture directions (needs the extra for learning)."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import STATURE_LIMITS_M, AnnyBody
from flowing_puppet_ros.learn.anny.poses import FROM_MOCAP, MOCAP_JOINTS, PoseSampler
from flowing_puppet_ros.learn.anny.segmentation import assign_vertices_to_parts
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.model.tree import SP_PARENTS, PartTree
from flowing_puppet_ros.model.weights import load

# Only looked for: importing anny itself would need torch.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn"),
]
MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def poses(body: AnnyBody) -> PoseSampler:
    return PoseSampler(body)


def test_resting_bones_leave_the_body_at_rest(body: AnnyBody) -> None:
    rest = body.make_rest_body(body.mean_phenotype())
    vertices, joints = body.pose(rest, np.tile(np.eye(3), (len(body.bone_names), 1, 1)))
    np.testing.assert_allclose(vertices, rest.vertices, atol=1e-6)
    np.testing.assert_allclose(joints, rest.joints, atol=1e-12)


def test_people_face_forward_with_their_left_at_y(body: AnnyBody) -> None:
    rest = body.make_rest_body(body.sample_phenotype(np.random.default_rng(0)))
    named = body.locate_landmarks(rest.vertices, rest.joints)
    assert named["nose"][0] > named["left_ear"][0] + 0.05
    assert named["left_wrist"][1] > 0.2
    assert named["left_toe"][0] > named["left_heel"][0] + 0.15
    assert named["left_eye"][1] > 0.01
    np.testing.assert_allclose((named["left_hip"] + named["right_hip"]) / 2, 0, atol=1e-6)


def test_a_mirrored_pose_gives_the_mirror_image(body: AnnyBody, poses: PoseSampler) -> None:
    rest = body.make_rest_body(body.mean_phenotype())
    pose = poses.sample(np.random.default_rng(1), 1)[0]
    mirrored = (MIRROR[:, None] * pose * MIRROR)[body.mirror_bone]
    vertices, image = body.pose(rest, pose)[0], body.pose(rest, mirrored)[0]
    np.testing.assert_allclose(image, vertices[body.mirror_vertex] * MIRROR, atol=1e-6)


def test_a_chosen_subset_is_the_same_as_all(body: AnnyBody, poses: PoseSampler) -> None:
    rest, pose = body.make_rest_body(body.mean_phenotype()), poses.sample(np.random.default_rng(2), 2)
    ids = np.array([5, 700, 9000])
    np.testing.assert_allclose(body.pose(rest, pose, ids)[0], body.pose(rest, pose)[0][:, ids], atol=1e-12)


@pytest.mark.parametrize("gender", ["neutral", "female", "male"])
def test_people_are_adults(gender: str) -> None:
    body, rng = AnnyBody(gender), np.random.default_rng(3)
    statures = [body.make_rest_body(body.sample_phenotype(rng)).stature for _ in range(12)]
    assert STATURE_LIMITS_M[0] - 0.01 < min(statures) < max(statures) < STATURE_LIMITS_M[1] + 0.01


def test_unknown_gender_is_one_sentence() -> None:
    with pytest.raises(InputError, match="'robot'"):
        AnnyBody("robot")


def test_t_pose_of_the_motion_capture_stretches_the_arms(body: AnnyBody, poses: PoseSampler) -> None:
    rest = body.make_rest_body(body.mean_phenotype())
    rotations = poses.retarget(np.zeros((1, MOCAP_JOINTS, 3)))[0]
    joints = body.locate_landmarks(*body.pose(rest, rotations))
    for side, sign in (("left", 1), ("right", -1)):
        for upper, lower in (("shoulder", "elbow"), ("elbow", "wrist")):
            bone = joints[f"{side}_{lower}"] - joints[f"{side}_{upper}"]
            np.testing.assert_allclose(bone / np.linalg.norm(bone), [0, sign, 0], atol=1e-6)
        thigh = joints[f"{side}_knee"] - joints[f"{side}_hip"]
        np.testing.assert_allclose(thigh / np.linalg.norm(thigh), [0, sign * 0.342, -0.94], atol=1e-3)


def test_motion_capture_turns_the_same_limb_the_same_way(body: AnnyBody, poses: PoseSampler) -> None:
    frames = np.zeros((1, MOCAP_JOINTS, 3))
    frames[0, 3] = [np.radians(80), 0, 0]  # left knee, about the axis that points left; matrices act on row vectors
    rest = body.make_rest_body(body.mean_phenotype())
    before, after = (body.locate_landmarks(*body.pose(rest, poses.retarget(f)[0])) for f in (0 * frames, frames))
    shin = [j["left_ankle"] - j["left_knee"] for j in (before, after)]
    turn = FROM_MOCAP @ rotation.exp(frames[0, 3]).T @ FROM_MOCAP.T
    np.testing.assert_allclose(shin[1], turn @ shin[0], atol=1e-6)
    np.testing.assert_allclose(after["right_ankle"], before["right_ankle"], atol=1e-9)


def test_broken_motion_capture_is_one_sentence(body: AnnyBody, tmp_path: Path) -> None:
    for content in (b"", b"PK\x03\x04 not a zip"):
        (tmp_path / "broken.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"broken\.npz"):
            PoseSampler(body, tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", walk=np.zeros((5, 7)))
    with pytest.raises(InputError, match="expmap_20hz"):
        PoseSampler(body, tmp_path / "other.npz")


def test_segmentation_is_symmetric_and_whole(body: AnnyBody) -> None:
    part = assign_vertices_to_parts(body)
    assert set(part) == set(range(16))
    mirror = np.array(PartTree.from_parents(SP_PARENTS).mirror)
    np.testing.assert_array_equal(mirror[part[body.mirror_vertex]], part)


def test_stitched_puppet_can_be_any_anny_body(body: AnnyBody, poses: PoseSampler) -> None:
    """Least squares per part, without stitching: what the spaces leave out on bodies not learned from."""
    model, ids = StitchedPuppet.load("neutral"), load("sp", "neutral")["anny_vertex"]
    rng = np.random.default_rng(1234)
    for pose in poses.sample(rng, 4):
        target = body.pose(body.make_rest_body(body.sample_phenotype(rng)), pose, ids)[0]
        fitted = model.vertices(_closest_state(model, target))
        assert np.linalg.norm(fitted - target, axis=1).mean() < 0.008
        assert np.linalg.norm(fitted - target, axis=1).max() < 0.06


def _closest_state(model: StitchedPuppet, target: np.ndarray) -> BodyState:
    state = model.rest_state()
    for i, ids in enumerate(model.part_vertices):
        basis = np.concatenate([model.pose_basis[i], model.shape_basis[i]], axis=2).reshape((3 * len(ids), -1))
        mean, count = model.mean_shape[i] + model.mean_pose[i], model.pose_count(i)
        local = mean
        for _ in range(8):
            turned, centre = rotation.procrustes(local, target[ids])
            residual = ((target[ids] - centre) @ turned - mean).ravel()
            ridge = 1e-4 * np.eye(basis.shape[1])
            solved = np.linalg.solve(basis.T @ basis + ridge, basis.T @ residual)
            local = mean + (basis @ solved).reshape((-1, 3))
        state.rotation[i], state.center[i] = turned, centre
        state.pose[i] = np.pad(solved[:count], (0, state.pose.shape[1] - count))
        state.shape[i] = solved[count:]
    return state
