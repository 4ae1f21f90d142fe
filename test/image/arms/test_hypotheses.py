# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of arms over time: the path against brute force, and a detector that is right in its second guess."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowing_puppet_ros.image.arms.evidence import ArmEvidence
from flowing_puppet_ros.image.arms.hypotheses import (
    MAX_LIVE,
    MIN_DISTINCT_WIDTHS,
    ArmFilter,
    ArmSmoother,
    joint_correctness,
)
from flowing_puppet_ros.image.arms.viterbi import ArmHypotheses, ArmPathSettings, max_marginals
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from test.helpers.drawn_people import CapsuleModel
from test.helpers.guessing_detector import Guesser

SETTINGS = ArmPathSettings(evidence_weight=0.0)
GRID = ImageScale((64, 48), (64, 48))


def path_cost(arms: list[ArmHypotheses], chosen: tuple[int, ...], width: float) -> float:
    """Cost of a path, term by term."""
    cost = -sum(float(arm.score[k]) for arm, k in zip(arms, chosen, strict=True))
    for t in range(len(arms) - 1):
        gap = arms[t].places[chosen[t]] + arms[t].motion[chosen[t]] - arms[t + 1].places[chosen[t + 1]]
        elbow, wrist = np.linalg.norm(gap, axis=1)
        distance = (0.4 * elbow + 1.0 * wrist) / 1.4
        cost += SETTINGS.flow_strength * min(distance / width, SETTINGS.max_step)
    return cost


@given(st.integers(0, 10_000), st.integers(1, 4))
def test_max_marginals_are_those_of_brute_force(seed: int, images: int) -> None:
    rng = np.random.default_rng(seed)
    arms = []
    for _ in range(images):
        count = int(rng.integers(1, 4))
        shape = (count, 2, 2)
        arms.append(ArmHypotheses(rng.uniform(0, 60, shape), rng.normal(0, 2, count), rng.normal(0, 5, shape)))
    every = {chosen: path_cost(arms, chosen, 30.0) for chosen in product(*(range(len(arm.score)) for arm in arms))}
    for t, cost in enumerate(max_marginals(arms, 30.0, SETTINGS)):
        for k in range(len(arms[t].score)):
            expected = min(value for chosen, value in every.items() if chosen[t] == k)
            assert cost[k] == pytest.approx(expected)


def arm_evidence(guesser: Guesser | None, joints: np.ndarray) -> ArmEvidence:
    return ArmEvidence(CapsuleModel(), joints, 160.0, "front", guesser, None)  # type: ignore[arg-type]


def still() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((48, 64, 2), np.float32), np.zeros((48, 64, 2), np.float32)


def test_correctness_grows_with_the_scores_of_arm_and_pose() -> None:
    poor, good, better = (joint_correctness(*scores) for scores in ((-6.0, 1.0), (-1.0, 1.0), (-1.0, 4.0)))
    assert ((poor > 0) & (poor < good) & (good < better) & (better < 1)).all()
    assert np.isnan(joint_correctness(0.0, arm_evidence(None, np.zeros((15, 2))).pose_score)).all()


def test_a_guess_that_one_image_lacks_is_carried_into_it() -> None:
    joints = np.full((15, 2), 20.0)
    true, false = np.array([[20.0, 20.0], [30.0, 30.0]]), np.array([[20.0, 20.0], [10.0, 40.0]])
    history = ArmSmoother(SETTINGS)
    for t in range(3):
        guesses = np.array([false]) if t == 1 else np.array([true, false])
        both = {"left": guesses, "right": guesses}
        scores = np.array([-0.1]) if t == 1 else np.array([0.0, -3.0])
        history.add(arm_evidence(Guesser(joints, both, scores), joints), still() if t else None, GRID)
    arm = history.resolve(40.0)["left"]
    np.testing.assert_allclose(arm.places, [true] * 3)
    assert ((arm.certainty >= 0.5) & (arm.certainty < 1)).all()


def test_hypotheses_move_with_the_flow() -> None:
    joints = np.full((15, 2), 20.0)
    start = np.array([[20.0, 20.0], [24.0, 28.0]])
    forth = np.full((48, 64, 2), (3.0, 1.0), np.float32)
    history = ArmSmoother(SETTINGS)
    for t in range(3):
        guesses = np.array([start + t * np.array([3.0, 1.0])])
        history.add(
            arm_evidence(Guesser(joints, {"left": guesses, "right": guesses}, np.zeros(1)), joints),
            (forth, -forth) if t else None, GRID,
        )  # fmt: skip
    arm = history.resolve(40.0)["right"]
    np.testing.assert_allclose(arm.motion[:2], np.full((2, 2, 2), (3.0, 1.0)), atol=1e-5)
    np.testing.assert_allclose(arm.places[2], start + np.array([6.0, 2.0]))


def test_an_image_without_a_detection_takes_the_tracked_arm_or_the_carried_one() -> None:
    joints = np.full((15, 2), 5.0)
    true = np.array([[20.0, 20.0], [30.0, 30.0]])
    history = ArmSmoother(SETTINGS)
    history.add(
        arm_evidence(Guesser(joints, {"left": true[None], "right": true[None]}, np.zeros(1)), joints), None, GRID
    )
    history.add(arm_evidence(None, joints), still(), GRID)
    np.testing.assert_allclose(history.resolve(40.0)["left"].places, [true, true])
    alone = ArmSmoother(SETTINGS)
    alone.add(arm_evidence(None, joints), None, GRID)
    np.testing.assert_allclose(alone.resolve(40.0)["left"].places, np.full((1, 2, 2), 5.0))


def test_a_filter_agrees_with_the_best_path_that_ends_now() -> None:
    joints = np.full((15, 2), 20.0)
    rng = np.random.default_rng(3)
    arms = ArmFilter(SETTINGS)
    history: list[ArmHypotheses] = []
    for t in range(5):
        guesses = rng.uniform(10, 40, (3, 2, 2))
        person = arm_evidence(Guesser(joints, {"left": guesses, "right": guesses}, rng.normal(0, 0.3, 3)), joints)
        arms.propagate(still() if t else None, GRID)
        found, right = arms.step(person)["left"]
        if t:
            before: list[np.ndarray] = []
            for k in np.argsort(max_marginals(history, person.shoulder_width_px, SETTINGS)[-1], kind="stable"):
                place = history[-1].places[k]
                if len(before) < MAX_LIVE and all(
                    np.hypot(*(place - b).T).max() >= MIN_DISTINCT_WIDTHS * person.shoulder_width_px for b in before
                ):
                    before.append(place)
            guesses = np.concatenate([guesses, before])
        history.append(ArmHypotheses(guesses, person.score("left", guesses, SETTINGS), np.zeros_like(guesses)))
        cost = max_marginals(history, person.shoulder_width_px, SETTINGS)[-1]
        np.testing.assert_allclose(found, guesses[cost.argmin()])
        assert ((right > 0.0) & (right < 1.0)).all()


def test_a_filter_is_carried_through_images_without_a_look() -> None:
    joints, forth = np.full((15, 2), 20.0), np.full((48, 64, 2), (3.0, 0.0), np.float32)
    start = np.array([[20.0, 20.0], [24.0, 28.0]])
    arms = ArmFilter(SETTINGS)
    for t in (0, 2):
        guesses = np.array([start + np.array([3.0 * t, 0.0]), start + np.array([0.0, 15.0])])
        scores = np.array([0.0, -0.1]) if t == 0 else np.array([-0.2, 0.0])
        person = arm_evidence(Guesser(joints, {"left": guesses, "right": guesses}, scores), joints)
        found, _ = arms.step(person)["right"]
        for _image in range(2):
            arms.propagate((forth, -forth), GRID)
    np.testing.assert_allclose(found, start + np.array([6.0, 0.0]), atol=1e-5)
