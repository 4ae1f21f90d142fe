# SPDX-License-Identifier: Apache-2.0
"""The joint regressor finds the convex sums that joints were made with."""

import numpy as np

from flowing_puppet_ros.learn.sp.joints import regress_joints

MIRROR = np.array([1.0, -1.0, 1.0])


def test_made_joints_are_found_on_both_sides_and_the_midline() -> None:
    rng = np.random.default_rng(0)
    left = rng.normal([0, 2, 0], 1, size=(60, 40, 3))
    meshes = np.concatenate([left, left * MIRROR + 0.3 * rng.normal(size=left.shape)], axis=1)
    mirror = np.concatenate([np.arange(40, 80), np.arange(40)])
    made = {
        "left_knee": meshes[:, [3, 8, 11]],
        "right_knee": meshes[:, [43, 48, 51]],
        "neck": meshes[:, [5, 45]],
    }
    weights = {"left_knee": [0.2, 0.3, 0.5], "right_knee": [0.2, 0.3, 0.5], "neck": [0.5, 0.5]}
    joints = {name: np.einsum("k,nkx->nx", weights[name], points) for name, points in made.items()}
    names, index, weight = regress_joints(meshes, joints, mirror)
    assert names == tuple(joints)
    assert np.all(weight >= 0)
    np.testing.assert_allclose(weight.sum(axis=1), 1)
    for row, name in enumerate(names):
        found = (weight[row][:, None] * meshes[:, index[row]]).sum(axis=1)
        np.testing.assert_allclose(found, joints[name], atol=1e-3)
    np.testing.assert_array_equal(mirror[index[names.index("left_knee")]], index[names.index("right_knee")])
