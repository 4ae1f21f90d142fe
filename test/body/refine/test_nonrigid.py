# SPDX-License-Identifier: Apache-2.0
"""The non-rigid refinement on surfaces that the body model cannot express, and where there is nothing to follow."""

from __future__ import annotations

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.refine.nonrigid import NonRigidRefinement, NonRigidWeights, umbrella_laplacian
from flowing_puppet_ros.model.sp import StitchedPuppet


@pytest.fixture(scope="module")
def nonrigid(model: StitchedPuppet) -> NonRigidRefinement:
    return NonRigidRefinement(model.faces, len(model.part_of_vertex), NonRigidWeights())


def swollen(model: StitchedPuppet) -> tuple[np.ndarray, np.ndarray]:
    """A sampled body, and the same body with waves of 1 cm along its normals that are about 40 cm long."""
    vertices = model.vertices(model.sample(np.random.default_rng(3), pose_scale=0.5))
    normals = vertex_normals(vertices, model.faces)
    return vertices, vertices + 0.01 * np.sin(vertices @ [9.0, 7.0, 15.0])[:, None] * normals


def cloud_on(vertices: np.ndarray, faces: np.ndarray, count: int) -> Cloud:
    """Random points on the faces, which are not the mesh's vertices."""
    rng = np.random.default_rng(0)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), count), corners[chosen])
    return Cloud.of(points, cross[chosen] / area[chosen, None])


def test_umbrella_takes_the_mean_of_the_neighbours() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    values = np.array([1.0, 5.0, -2.0, 7.0, 4.0])
    expected = [1 - (5 - 2 + 7) / 3, 5 - (1 - 2) / 2, -2 - (1 + 5 + 7) / 3, 7 - (1 - 2) / 2, 0.0]
    np.testing.assert_allclose(umbrella_laplacian(faces, 5) @ values, expected)


def test_what_the_model_cannot_express_is_followed(model: StitchedPuppet, nonrigid: NonRigidRefinement) -> None:
    start, truth = swollen(model)
    cloud = cloud_on(truth, model.faces, 12000)
    refined = nonrigid.run(start, cloud)
    before, after = (np.linalg.norm(vertices - truth, axis=1).mean() for vertices in (start, refined))
    assert before > 0.006
    assert after < 0.75 * before
    assert two_way_distance(refined, model.faces, cloud) < two_way_distance(start, model.faces, cloud) - 0.002


def test_holes_follow_their_surroundings(model: StitchedPuppet, nonrigid: NonRigidRefinement) -> None:
    start = model.vertices(model.rest_state())
    truth = start + np.array([0.01, 0.0, 0.01])
    whole = cloud_on(truth, model.faces, 12000)
    low, high = np.quantile(start[:, 2], [0.35, 0.42])
    kept = (whole.points[:, 2] < low) | (whole.points[:, 2] > high)
    refined = nonrigid.run(start, Cloud.of(whole.points[kept], whole.normals[kept]))
    inside = (start[:, 2] > low + 0.01) & (start[:, 2] < high)
    assert inside.sum() > 30
    assert np.linalg.norm(refined - truth, axis=1)[inside].mean() < 0.006


def test_a_cloud_that_is_elsewhere_moves_nothing(model: StitchedPuppet, nonrigid: NonRigidRefinement) -> None:
    start = model.vertices(model.rest_state())
    elsewhere = Cloud.of(start + np.array([20.0, 0.0, 0.0]), vertex_normals(start, model.faces))
    assert np.abs(nonrigid.run(start, elsewhere) - start).max() < 1e-3


def test_the_same_cloud_gives_the_same_bytes(model: StitchedPuppet, nonrigid: NonRigidRefinement) -> None:
    start, truth = swollen(model)
    cloud = cloud_on(truth, model.faces, 2000)
    assert nonrigid.run(start, cloud).tobytes() == nonrigid.run(start.copy(), cloud).tobytes()
