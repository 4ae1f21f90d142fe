# SPDX-License-Identifier: Apache-2.0
"""The recipes of the documentation: people as solids for MoveIt."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.stream.messages.puppets import make_body

RECIPES = Path(__file__).resolve().parent.parent / "docs" / "recipes"


@pytest.fixture(scope="module")
def recipe() -> ModuleType:
    """Return the recipe as a module; it makes messages of ROS."""
    specification = importlib.util.spec_from_file_location("people_in_moveit", RECIPES / "people_in_moveit.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def somebody() -> tuple[StitchedPuppet, BodyState, Any]:
    """Return the female model, a random person's state, and their Body message."""
    model = StitchedPuppet.load("female")
    state = model.sample(np.random.default_rng(5))
    vertices = model.vertices(state)
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, np.int8))
    fit = BodyFit(state, vertices, model.joints(vertices), 1.0, np.ones(16), 0.8, True, 0.01, seen)
    return model, state, make_body(BagMessageFactory(), model, TrackedBody("abcde", fit))


def is_inside(shape: Any, pose: Any, points: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) a solid contains, as shape_msgs defines it: cylinders lie along z."""
    w, x, y, z = (getattr(pose.orientation, name) for name in "wxyz")
    turn = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    local = (points - [pose.position.x, pose.position.y, pose.position.z]) @ turn
    if shape.type == shape.SPHERE:
        return np.linalg.norm(local, axis=1) <= shape.dimensions[0] + 1e-5
    height, radius = shape.dimensions
    return (np.abs(local[:, 2]) <= height / 2 + 1e-5) & (np.linalg.norm(local[:, :2], axis=1) <= radius + 1e-5)


@pytest.mark.ros
def test_the_capsules_of_a_person_contain_them_closely(recipe: ModuleType, somebody: Any) -> None:
    model, state, body = somebody
    found = recipe.capsules(body)
    assert [capsule.part for capsule in found] == list(model.tree.names)
    volume = 0.0
    for i, capsule in enumerate(found):
        surface = state.center[i] + model.local_vertices(i, state.pose[i], state.shape[i]) @ state.rotation[i].T
        solids = zip(*recipe.make_shapes(capsule), strict=True)
        assert np.any([is_inside(shape, pose, surface) for shape, pose in solids], axis=0).all(), capsule.part
        assert 0.02 < capsule.radius < 0.35
        length = np.linalg.norm(capsule.end - capsule.start)
        volume += np.pi * capsule.radius**2 * (length + 4 / 3 * capsule.radius)
    (padded,) = (each for each in recipe.capsules(body, padding=0.02) if each.part == "torso")
    assert padded.radius == pytest.approx(found[0].radius + 0.02)
    vertices = model.vertices(state)
    a, b, c = (vertices[model.faces[:, k]] for k in range(3))
    own = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
    assert own < volume < 4 * own, "capsules about bent parts are wide, and parts overlap"


@pytest.mark.ros
def test_a_capsule_of_known_points(recipe: ModuleType) -> None:
    rng = np.random.default_rng(2)
    angle, along = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-0.3, 0.3, 4000)
    points = np.stack([1 + 0.1 * np.cos(angle), 2 + along, 3 + 0.1 * np.sin(angle)], axis=1)
    capsule = recipe.enclose("stick", points, 0.0)
    assert capsule.radius == pytest.approx(0.1, abs=0.005)
    ends = sorted([capsule.start, capsule.end], key=lambda end: end[1])
    np.testing.assert_allclose(ends, [[1, 1.7, 3], [1, 2.3, 3]], atol=0.03)
    ball = recipe.enclose("ball", np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]), 0.5)
    assert len(recipe.make_shapes(ball)[0]) in (2, 3) and ball.radius >= 1.4
    assert recipe.capsules(BagMessageFactory().make("flowing_puppet_msgs/msg/Body", id="joints")) == []
