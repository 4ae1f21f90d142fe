# SPDX-License-Identifier: Apache-2.0
"""The skeleton of REP-155 in a body: angles that mean what their names say, and links where the limbs are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.stream.messages.bodies.ros4hri_skeleton import MOVING_JOINTS, Skeleton, link_frames


@pytest.fixture(scope="module")
def model() -> StitchedPuppet:
    return StitchedPuppet.load()


@pytest.fixture(scope="module")
def skeleton(model: StitchedPuppet) -> Skeleton:
    return Skeleton(model)


def angles(model: StitchedPuppet, skeleton: Skeleton, state: BodyState) -> dict[str, float]:
    return skeleton.joint_angles(model.joints(model.vertices(state)), state)


def turned(model: StitchedPuppet, state: BodyState, joint: str, parts: tuple[str, ...], axis: list[float]) -> BodyState:
    """The body with some parts turned about a joint by the vector `axis`, radians."""
    about = model.joints(model.vertices(state))[model.joint_names.index(joint)]
    turn = rotation.exp(np.array(axis))
    center, rotations = state.center.copy(), state.rotation.copy()
    for part in parts:
        index = model.tree.index(part)
        center[index] = about + turn @ (center[index] - about)
        rotations[index] = turn @ rotations[index]
    return replace(state, center=center, rotation=rotations)


ARM = ("upper_arm", "lower_arm", "hand")
LEG = ("upper_leg", "lower_leg", "foot")


@pytest.mark.parametrize(("side", "short", "sign"), [("left", "l", 1), ("right", "r", -1)])
def test_turned_parts_turn_the_joints_of_their_names(
    side: str, short: str, sign: int, model: StitchedPuppet, skeleton: Skeleton
) -> None:
    rest = model.rest_state()
    before = angles(model, skeleton, rest)
    assert before["waist"] == pytest.approx(0, abs=1e-6) and before["y_head"] == pytest.approx(0, abs=1e-6)

    def change(joint: str, parts: tuple[str, ...], axis: list[float]) -> dict[str, float]:
        sided = tuple(f"{side}_{part}" for part in parts)
        after = angles(model, skeleton, turned(model, rest, f"{side}_{joint}", sided, axis))
        return {name: after[name] - before[name] for name in MOVING_JOINTS}

    # The shank backward by half a radian more: a knee bends to negative angles; nothing else moves.
    knee = change("knee", ("lower_leg", "foot"), [0, 0.5, 0])
    assert knee[f"{short}_knee"] == pytest.approx(-0.5, abs=0.1)
    others = [abs(value) for name, value in knee.items() if name != f"{short}_knee" and "hip" not in name]
    assert max(others) < 0.02
    # The thigh outwards and forward.
    assert change("hip", LEG, [0.4 * sign, 0, 0])[f"{short}_p_hip"] == pytest.approx(0.4, abs=0.05)
    assert change("hip", LEG, [0, -0.4, 0])[f"{short}_r_hip"] == pytest.approx(0.4, abs=0.05)
    # The arm outwards.
    assert change("shoulder", ARM, [0.4 * sign, 0, 0])[f"{short}_p_shoulder"] == pytest.approx(0.4, abs=0.05)


def test_a_nod_a_shake_and_a_tilt_of_the_head(model: StitchedPuppet, skeleton: Skeleton) -> None:
    for axis, name, value in (
        ([0.3, 0, 0], "r_head", 0.3),
        ([0, 0.3, 0], "p_head", -0.3),
        ([0, 0, 0.3], "y_head", 0.3),
    ):
        state = turned(model, model.rest_state(), "neck", ("head",), axis)
        assert angles(model, skeleton, state)[name] == pytest.approx(value, abs=0.01)


def test_links_lie_on_the_limbs_of_any_body_anywhere(model: StitchedPuppet, skeleton: Skeleton) -> None:
    rng = np.random.default_rng(0)
    index = {name: row for row, name in enumerate(model.joint_names)}
    for _ in range(6):
        state = model.sample(rng)
        turn, step = rotation.exp(rng.normal(size=3)), rng.normal(size=3)
        state = replace(state, center=state.center @ turn.T + step, rotation=turn @ state.rotation)
        joints = model.joints(model.vertices(state))
        origin, axes = skeleton.body_frame(joints, state)
        placed = link_frames(skeleton.joint_origins(state.shape), skeleton.joint_angles(joints, state))
        for side, short in (("left", "l"), ("right", "r")):
            for first, second in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")):
                bone = axes.T @ (joints[index[f"{side}_{second}"]] - joints[index[f"{side}_{first}"]])
                link = placed[f"{short}_{second}"][0] - placed[f"{short}_{first}"][0]
                cosine = bone @ link / np.linalg.norm(bone) / np.linalg.norm(link)
                # The lower bones bend about the hinge of the upper only.
                assert cosine > (0.9999 if second in ("elbow", "knee") else 0.98), (side, second)
            wrist = axes.T @ (joints[index[f"{side}_wrist"]] - origin)
            assert np.linalg.norm(placed[f"{short}_wrist"][0] - wrist) < 0.12
        head = axes.T @ state.rotation[model.tree.index("head")]
        np.testing.assert_allclose(placed["head"][1], head, atol=1e-9)
