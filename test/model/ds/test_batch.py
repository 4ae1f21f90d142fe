# SPDX-License-Identifier: Apache-2.0
"""A batch of puppets equals the puppets one by one."""

import numpy as np
import pytest

from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

MODEL = DeformableStructures.load()


@pytest.mark.parametrize("view", ["front", "back"])
def test_contours_and_energies_of_a_batch_are_those_of_each_puppet(view: View) -> None:
    rng = np.random.default_rng(0)
    sign = np.array([1.0 if view == "front" else -1.0, 1.0])
    scale = rng.uniform(60, 300, 12)
    joints = np.array([MODEL.sample(rng).joints for _ in range(12)]) * sign * scale[:, None, None] + 100.0
    joints[3] += rng.normal(0, 20, joints[3].shape)
    joints[4, MODEL.joint_names.index("left_wrist")] = joints[4, MODEL.joint_names.index("left_elbow")]
    contours, energy = MODEL.puppets_from_joints(joints, scale, view)
    each = [MODEL.puppet_from_joints(one, size, view) for one, size in zip(joints, scale, strict=True)]
    for part, found in enumerate(contours):
        np.testing.assert_allclose(found, [shape.contours[part] for shape in each], atol=1e-6)
    single = np.array([MODEL.energy(shape) for shape in each])
    np.testing.assert_allclose(energy - energy[0], single - single[0], atol=1e-6)
    some = MODEL.puppets_from_joints(joints, scale, view, edges=[0, 1])[1]
    rest = MODEL.puppets_from_joints(joints, scale, view, edges=range(2, len(MODEL.tree.edges)))[1]
    np.testing.assert_allclose(some + rest, energy, rtol=1e-9)
