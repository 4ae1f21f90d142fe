# SPDX-License-Identifier: Apache-2.0
"""A person who moves: one shape, parts turned by smooth angles."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from moving_person import FRAMES, STEP_NS  # type: ignore[import-not-found]

from flowing_puppet_ros.exchange.motion import BodyMotion, make_motion
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


@pytest.fixture(scope="session")
def model() -> StitchedPuppet:
    return StitchedPuppet.load("neutral")


@pytest.fixture(scope="session")
def states(model: StitchedPuppet) -> list[BodyState]:
    """Return bodies of one shape between two poses: every 40 ms a twelfth of the way."""
    rng = np.random.default_rng(5)
    shape = np.broadcast_to(0.5 * rng.standard_normal(model.shape_count), (16, model.shape_count))
    target = model.sample(np.random.default_rng(8), 0.0, 0.6).pose
    found = []
    for share in np.linspace(0, 1, FRAMES):
        rest = model.rest_state()
        state = replace(rest, pose=(1 - share) * rest.pose + share * target, shape=shape.copy())
        for parent, child in model.tree.edges:
            above = model.part_mesh(
                parent, state.center[parent], state.rotation[parent], state.pose[parent], state.shape[parent]
            )[model.interfaces[child - 1].parent_index]
            turn, place = model.stitch(child, parent, above, state.pose[child], state.shape[child])
            state.rotation[child], state.center[child] = turn, place
        found.append(state)
    return found


@pytest.fixture(scope="session")
def motion(model: StitchedPuppet, states: list[BodyState]) -> BodyMotion:
    """Return the motion, from a frame with z up."""
    vertices = np.stack([model.vertices(state) for state in states])
    arrays: dict[str, Any] = {
        "vertices": vertices,
        "joints": model.joints(vertices),
        "part_rotation": np.stack([state.rotation for state in states]),
        "part_center": np.stack([state.center for state in states]),
        "shape": np.stack([state.shape for state in states]),
        "confidence": np.full(FRAMES, 0.75),
        "reliable": np.ones(FRAMES, bool),
    }
    return make_motion("walk", "b1", model, STEP_NS * np.arange(FRAMES), arrays, np.array([0.0, 0.0, 1.0]))


@pytest.fixture(scope="session")
def still(motion: BodyMotion) -> BodyMotion:
    """Return the last frame alone."""
    names = ("vertices", "joints", "part_rotation", "part_center", "shape", "confidence", "reliable", "stamps_ns")
    return replace(motion, name="still", **{name: getattr(motion, name)[-1:] for name in names})
