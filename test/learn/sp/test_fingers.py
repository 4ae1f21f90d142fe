# SPDX-License-Identifier: Apache-2.0
"""Fingers of the training bodies: from the resting hand to a fist (needs the extra for learning)."""

from importlib.util import find_spec

import numpy as np
import pytest

from flowing_puppet_ros.learn.anny.body import AnnyBody, RestBody
from flowing_puppet_ros.learn.sp.fingers import CLOSED_DEG, FINGERS, THUMB_CLOSED_DEG, Fingers

# Only looked for: importing anny itself would need torch.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn"),
]
MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def fingers(body: AnnyBody) -> Fingers:
    return Fingers(body)


def fists() -> np.ndarray:
    angles = np.zeros((1, 2, FINGERS, 4))
    angles[..., :3] = np.radians(CLOSED_DEG)
    angles[:, :, 0, :3] = np.radians(THUMB_CLOSED_DEG)
    return angles


def test_fingers_at_rest_leave_the_body_at_rest(body: AnnyBody, fingers: Fingers) -> None:
    rest = body.make_rest_body(body.mean_phenotype()).vertices
    np.testing.assert_allclose(fingers.deform_body(np.zeros((1, 2, FINGERS, 4)))[0], rest, atol=1e-12)


def test_only_fingers_move_and_both_hands_alike(body: AnnyBody, fingers: Fingers) -> None:
    rest, closed = body.make_rest_body(body.mean_phenotype()).vertices, fingers.deform_body(fists())[0]
    moved = np.linalg.norm(closed - rest, axis=1) > 1e-9
    assert np.all(fingers.share[moved] > 0)
    assert 0.02 < moved.mean() < 0.3
    np.testing.assert_allclose(closed[body.mirror_vertex], closed * MIRROR, atol=1e-6)


def test_a_fist_brings_the_tips_to_the_palm(body: AnnyBody, fingers: Fingers) -> None:
    rest, closed = body.make_rest_body(body.mean_phenotype()).vertices, fingers.deform_body(fists())[0]
    wrist = body.make_rest_body(body.mean_phenotype()).joints[body.bone_index("LeftHand")]
    left = fingers.vertices
    farthest = [np.linalg.norm(vertices[left] - wrist, axis=1).max() for vertices in (rest, closed)]
    assert farthest[0] > 0.15
    assert farthest[1] < 0.7 * farthest[0]


def test_hands_vary_from_flat_to_closed_and_the_same_seed_gives_the_same(body: AnnyBody, fingers: Fingers) -> None:
    poses = np.tile(np.eye(3), (300, len(body.bone_names), 1, 1))
    turned = poses.copy()
    finger = body.bone_index("LeftHandFinger1")
    turned[:, finger] = np.diag([-1.0, -1.0, 1.0])
    angles = fingers.replace_finger_bends(np.random.default_rng(4), turned)
    assert angles.tobytes() == fingers.replace_finger_bends(np.random.default_rng(4), poses.copy()).tobytes()
    bends = np.degrees(angles[:, 0, 2, 1])
    assert bends.min() < 0 and bends.max() > 75
    kept = np.all(angles[:, 0] == 0, axis=(1, 2))
    assert 0.2 < kept.mean() < 0.5
    np.testing.assert_array_equal(turned[kept, finger], np.tile(np.diag([-1.0, -1.0, 1.0]), (int(kept.sum()), 1, 1)))
    np.testing.assert_array_equal(turned[~kept, finger], np.tile(np.eye(3), (int((~kept).sum()), 1, 1)))


def test_every_pose_may_have_another_rest_shape(body: AnnyBody, fingers: Fingers) -> None:
    rest = body.make_rest_body(body.mean_phenotype())
    shapes = np.concatenate([rest.vertices[None], fingers.deform_body(fists())])
    still = np.tile(np.eye(3), (2, len(body.bone_names), 1, 1))
    vertices, _ = body.pose(RestBody(shapes, rest.joints), still, fingers.vertices)
    np.testing.assert_allclose(vertices, shapes[:, fingers.vertices], atol=1e-6)
