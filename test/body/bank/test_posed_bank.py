# SPDX-License-Identifier: Apache-2.0
"""The bank of those who do not just stand: on their feet or seat, as people are, and told from those who stand."""

import numpy as np
import pytest

from flowing_puppet_ros.body.bank.posed_bank import is_posed, make_posed_bank
from flowing_puppet_ros.body.bank.upright_bank import make_upright_bank
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

pytestmark = pytest.mark.slow


def locate(model: StitchedPuppet, state: BodyState) -> dict[str, np.ndarray]:
    return dict(zip(model.joint_names, model.joints(model.vertices(state)), strict=True))


def test_hardly_anybody_of_the_posed_bank_stands_and_hardly_anybody_of_the_upright_one_does_not() -> None:
    model = StitchedPuppet.load()
    posed, upright = (
        np.mean([is_posed(locate(model, state)) for state in make(model).states])
        for make in (make_posed_bank, make_upright_bank)
    )
    assert posed > 0.9 and upright < 0.05


def test_seats_are_as_high_as_chairs_are_and_nobody_is_in_the_floor() -> None:
    model = StitchedPuppet.load()
    bank = make_posed_bank(model)
    low = [model.vertices(state)[:, 2].min() for state in bank.states]
    assert min(low) > -1e-9 and max(low) < 0.21
    joints = [locate(model, state) for state in bank.states[:50]]
    hips = np.array([(each["left_hip"] + each["right_hip"])[2] / 2 for each in joints])
    assert hips.min() > 0.3 and hips.max() < 0.8 and 0.45 < np.median(hips) < 0.6
    assert all(abs(each["left_hip"][0] + each["right_hip"][0]) < 1e-6 for each in joints)


def test_a_cloud_of_who_sits_is_explained_by_who_sits_there() -> None:
    """Placed by the top: what the person sits on is in the cloud, too."""
    from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
    from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud

    model = StitchedPuppet.load()
    bank = make_posed_bank(model)
    vertices = model.vertices(bank.states[3]) + np.array([4.0, 0.5, -1.2])
    seen = vertices[vertex_normals(vertices, model.faces)[:, 0] < -0.3][::8]
    rng = np.random.default_rng(0)
    stool = np.column_stack([rng.uniform(3.8, 4.1, 60), rng.uniform(0.9, 1.3, 60), rng.uniform(-1.0, -0.75, 60)])
    cloud = SingleViewCloud.seen_from(np.concatenate([seen, stool]), None, np.zeros(3))
    best = bank.find_best(cloud, -1.2, 8, by_top=True)[0][1]
    truth = model.joints(vertices)
    assert np.linalg.norm(model.joints(model.vertices(best)) - truth, axis=1).mean() < 0.12
