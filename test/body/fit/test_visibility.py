# SPDX-License-Identifier: Apache-2.0
"""What a sensor in front of a standing body saw of it, where the legs are missing from the cloud."""

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.fit.quality import assess_fit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility, judge_visibility
from flowing_puppet_ros.model.sp import StitchedPuppet

SENSOR = np.array([4.0, 0.0, 0.3])


@pytest.fixture(scope="module")
def vertices(model: StitchedPuppet) -> np.ndarray:
    return np.asarray(model.vertices(model.rest_state()))


@pytest.fixture(scope="module")
def facing(model: StitchedPuppet, vertices: np.ndarray) -> np.ndarray:
    return np.asarray(((SENSOR - vertices) * vertex_normals(vertices, model.faces)).sum(axis=1) > 0)


def judge(model: StitchedPuppet, vertices: np.ndarray, cloud: np.ndarray) -> BodyVisibility:
    return look(model, vertices, Cloud.of(cloud, np.zeros_like(cloud), SENSOR))


def look(model: StitchedPuppet, vertices: np.ndarray, cloud: Cloud) -> BodyVisibility:
    return judge_visibility(model, vertices, cloud, assess_fit(model, vertices, cloud).surface)


def test_a_body_cut_off_above_the_knees_has_inferred_feet(
    model: StitchedPuppet, vertices: np.ndarray, facing: np.ndarray
) -> None:
    knees = model.joints(vertices)[model.joint_names.index("left_knee"), 2]
    cloud = vertices[facing & (vertices[:, 2] > knees + 0.15)]
    found = judge(model, vertices, cloud)
    gap = np.linalg.norm(vertices[:, None] - cloud[None], axis=2).min(axis=1)
    assert (found.vertices[gap > 0.1] == Visibility.INFERRED).all()
    assert (found.vertices[~facing & (gap < 0.1)] == Visibility.NEAR).all()
    assert (found.vertices[facing & (gap < 0.04)] == Visibility.SEEN).all()
    joints = dict(zip(model.joint_names, found.joints, strict=True))
    for side in ("left", "right"):
        assert joints[f"{side}_ankle"] == joints[f"{side}_knee"] == joints[f"{side}_toe"] == Visibility.INFERRED
        assert joints[f"{side}_wrist"] == joints[f"{side}_shoulder"] == joints[f"{side}_hip"] == Visibility.SEEN
    parts = dict(zip(model.tree.names, found.parts, strict=True))
    assert parts["left_foot"] == parts["right_lower_leg"] == Visibility.INFERRED
    assert parts["torso"] == parts["left_upper_leg"] == parts["right_hand"] == Visibility.SEEN


def test_what_is_close_to_the_cloud_and_faces_away_is_near(
    model: StitchedPuppet, vertices: np.ndarray, facing: np.ndarray
) -> None:
    arm = model.part_of_vertex == model.tree.index("left_lower_arm")
    back = arm & ~facing
    found = judge(model, vertices, vertices[facing])
    assert back.sum() > 20 and (found.vertices[back] == Visibility.NEAR).all()
    # Without the front of the arm the same vertices are the model's guess.
    away = judge(model, vertices, vertices[facing & (vertices[:, 1] < 0)])
    assert (away.vertices[arm] == Visibility.INFERRED).all()
    assert away.parts[model.tree.index("left_lower_arm")] == Visibility.INFERRED


def test_all_of_a_whole_cloud_is_seen(model: StitchedPuppet, vertices: np.ndarray) -> None:
    found = look(model, vertices, Cloud.of(vertices, np.zeros_like(vertices)))
    for state in (found.vertices, found.joints, found.parts):
        assert (state == Visibility.SEEN).all()
