# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of arms over time: the path against brute force, and a detector that is right in its second guess."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowing_puppet_ros.image.arms.evidence import ArmEvidence, ArmEvidenceModel
from flowing_puppet_ros.image.arms.hypotheses import MAX_KEPT, MIN_DISTANCE, ArmFilter, ArmSmoother, joint_correctness
from flowing_puppet_ros.image.arms.viterbi import ArmHypotheses, PathSettings, max_marginals
from flowing_puppet_ros.image.detector.detection import PersonCandidate
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.propagation import ImageScale
from flowing_puppet_ros.image.tracking.smoothing import SmoothingSettings
from flowing_puppet_ros.image.video.offline_smoother import OfflineSmoother
from flowing_puppet_ros.image.video.tracking_by_detection import DetectingTracker, DetectionSettings
from test.helpers.drawn_people import NAMES, CapsuleModel, draw, pose, tracker

SETTINGS = PathSettings(evidence_weight=0.0)
GRID = ImageScale((64, 48), (64, 48))


def path_cost(arms: list[ArmHypotheses], chosen: tuple[int, ...], width: float) -> float:
    """Cost of a path, term by term."""
    cost = -sum(float(arm.score[k]) for arm, k in zip(arms, chosen, strict=True))
    for t in range(len(arms) - 1):
        gap = arms[t].places[chosen[t]] + arms[t].motion[chosen[t]] - arms[t + 1].places[chosen[t + 1]]
        elbow, wrist = np.linalg.norm(gap, axis=1)
        distance = (0.4 * elbow + 1.0 * wrist) / 1.4
        cost += SETTINGS.flow_strength * min(distance / width, SETTINGS.longest_step)
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


@dataclass
class Guesser:
    """A detection whose arms and scores are given; the scores fall with the distance from the nearest guess."""

    joints: np.ndarray
    guesses: dict[str, np.ndarray]
    scores: np.ndarray
    confidence: float = 0.9
    scale: float = 50.0
    score: float = 3.0

    @property
    def keypoints(self) -> Keypoints:
        return Keypoints(NAMES, self.joints, np.full(len(self.joints), self.confidence))

    @property
    def place(self) -> PersonCandidate:
        neck, face = (self.joints[NAMES.index(name)] for name in ("neck", "face"))
        return PersonCandidate(neck, face, self.scale, 2.0)

    def arms(self, side: str, count: int) -> np.ndarray:
        return self.guesses[side][:count]

    def joint_score(self, joint: str, xy: np.ndarray) -> np.ndarray:
        side, _, name = joint.partition("_")
        at = self.guesses[side][:, ("elbow", "wrist").index(name)]
        distance = np.linalg.norm(np.asarray(xy)[:, None] - at, axis=2)
        return np.asarray((self.scores - 0.02 * distance).max(axis=1))


def sight(guesser: Guesser | None, joints: np.ndarray) -> ArmEvidence:
    return ArmEvidence(CapsuleModel(), joints, 160.0, "front", guesser, None)  # type: ignore[arg-type]


def still() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((48, 64, 2), np.float32), np.zeros((48, 64, 2), np.float32)


def test_the_better_an_arm_and_its_pose_fit_the_surer_they_are() -> None:
    poor, good, better = (joint_correctness(*scores) for scores in ((-6.0, 1.0), (-1.0, 1.0), (-1.0, 4.0)))
    assert ((poor > 0) & (poor < good) & (good < better) & (better < 1)).all()
    assert np.isnan(joint_correctness(0.0, sight(None, np.zeros((15, 2))).pose_score)).all()


def test_a_guess_that_one_image_lacks_is_carried_into_it() -> None:
    joints = np.full((15, 2), 20.0)
    true, false = np.array([[20.0, 20.0], [30.0, 30.0]]), np.array([[20.0, 20.0], [10.0, 40.0]])
    history = ArmSmoother(SETTINGS)
    for t in range(3):
        guesses = np.array([false]) if t == 1 else np.array([true, false])
        both = {"left": guesses, "right": guesses}
        scores = np.array([-0.1]) if t == 1 else np.array([0.0, -3.0])
        history.add(sight(Guesser(joints, both, scores), joints), still() if t else None, GRID)
    arm = history.resolve(40.0)["left"]
    np.testing.assert_allclose(arm.places, [true] * 3)
    assert ((arm.sure >= 0.5) & (arm.sure < 1)).all()


def test_hypotheses_move_with_the_flow() -> None:
    joints = np.full((15, 2), 20.0)
    start = np.array([[20.0, 20.0], [24.0, 28.0]])
    forth = np.full((48, 64, 2), (3.0, 1.0), np.float32)
    history = ArmSmoother(SETTINGS)
    for t in range(3):
        guesses = np.array([start + t * np.array([3.0, 1.0])])
        history.add(
            sight(Guesser(joints, {"left": guesses, "right": guesses}, np.zeros(1)), joints),
            (forth, -forth) if t else None, GRID,
        )  # fmt: skip
    arm = history.resolve(40.0)["right"]
    np.testing.assert_allclose(arm.motion[:2], np.full((2, 2, 2), (3.0, 1.0)), atol=1e-5)
    np.testing.assert_allclose(arm.places[2], start + np.array([6.0, 2.0]))


def test_an_image_without_a_detection_takes_the_tracked_arm_or_the_carried_one() -> None:
    joints = np.full((15, 2), 5.0)
    true = np.array([[20.0, 20.0], [30.0, 30.0]])
    history = ArmSmoother(SETTINGS)
    history.add(sight(Guesser(joints, {"left": true[None], "right": true[None]}, np.zeros(1)), joints), None, GRID)
    history.add(sight(None, joints), still(), GRID)
    np.testing.assert_allclose(history.resolve(40.0)["left"].places, [true, true])
    alone = ArmSmoother(SETTINGS)
    alone.add(sight(None, joints), None, GRID)
    np.testing.assert_allclose(alone.resolve(40.0)["left"].places, np.full((1, 2, 2), 5.0))


class Finder:
    """A detector that finds the walking person of `pose`, and every third time takes the left arm for another."""

    def __init__(self) -> None:
        self.images = self.searches = 0

    def propose(self, image: np.ndarray) -> list[PersonCandidate]:
        self.searches += 1
        truth = pose(self.images)
        return [PersonCandidate(truth[NAMES.index("neck")], truth[NAMES.index("face")], 50.0, 3.0)]

    def detect_at(self, image: np.ndarray, places: list[PersonCandidate]) -> list[Guesser]:
        neck = pose(self.images)[NAMES.index("neck")]
        assert len(places) == 1 and np.linalg.norm(places[0].neck - neck) < 20
        return self.found()

    def found(self) -> list[Guesser]:
        truth = pose(self.images)
        rows = {side: [NAMES.index(f"{side}_{name}") for name in ("elbow", "wrist")] for side in ("left", "right")}
        right = truth[rows["right"]][None]
        true = truth[rows["left"]]
        wrong = true + np.array([[0.0, -25.0], [15.0, -60.0]])
        slips = self.images % 3 == 2
        self.images += 1
        found = truth.copy()
        found[rows["left"]] = wrong if slips else true
        guesses = np.array([wrong, true] if slips else [true, wrong])
        return [Guesser(found, {"left": guesses, "right": right}, np.array([0.0, -0.3]))]


class NoEvidence:
    """An image that says nothing of any part."""

    def scene(self, image: np.ndarray) -> "NoEvidence":
        return self

    def with_torso(self, torso: np.ndarray, head: np.ndarray) -> "NoEvidence":
        return self

    def log_likelihood(self, part: int, contours: np.ndarray, scale: np.ndarray) -> np.ndarray:
        return np.zeros(len(contours))

    def hand_map(self, scale: float) -> np.ndarray:
        return np.ones((1, 1))


EYES = ArmEvidenceModel(CapsuleModel(), NoEvidence())  # type: ignore[arg-type]


def test_a_clip_joins_the_guesses_that_move_with_the_person() -> None:
    video = DetectingTracker(tracker(), Finder(), EYES, DetectionSettings())  # type: ignore[arg-type]
    path = PathSettings()
    clip = OfflineSmoother(CapsuleModel(), SmoothingSettings(), path)  # type: ignore[arg-type]
    for t in range(9):
        image = draw(pose(t))
        result, found = video.step(image, t)
        clip.add(result, video.arm_evidence(image, result, found))
    wrist = NAMES.index("left_wrist")
    for t, people in enumerate(clip.people()):
        (puppet,) = people
        assert np.linalg.norm(puppet.joints[wrist] - pose(t)[wrist]) < 6, t
        told = [joint_correctness(score, Guesser.score)[1] for score in (-4.0, 0.0)]
        assert told[0] < puppet.confidence[wrist] <= told[1], t


def test_between_runs_of_the_detector_people_are_carried() -> None:
    finder = Finder()
    settings = DetectionSettings(detect_every=4)
    video = DetectingTracker(tracker(), finder, EYES, settings)  # type: ignore[arg-type]
    for t in range(6):
        result, found = video.step(draw(pose(0)), t)
        sights = video.arm_evidence(draw(pose(0)), result, found)
        assert [puppet.id for puppet in result.puppets] == ["a1"] == list(sights)
        assert (sights["a1"].detection is None) == (t % 4 > 0)
    assert finder.images == 2


def test_live_arms_follow_the_guesses_that_move_with_the_person() -> None:
    finder = Finder()
    video = DetectingTracker(tracker(), finder, EYES, DetectionSettings())  # type: ignore[arg-type]
    wrist = NAMES.index("left_wrist")
    for t in range(9):
        result, _ = video.step(draw(pose(t)), t)
        assert np.linalg.norm(result.puppets[0].joints[wrist] - pose(t)[wrist]) < 8, t


def test_live_only_the_place_of_a_known_person_is_looked_at_between_searches() -> None:
    finder = Finder()
    settings = DetectionSettings(renew_every=5)
    video = DetectingTracker(tracker(), finder, EYES, settings)  # type: ignore[arg-type]
    searches = []
    for t in range(11):
        video.step(draw(pose(t)), t)
        searches.append(finder.searches)
    assert searches == [1, 2, 3, 4, 5, 6, 6, 6, 6, 6, 7]


def test_live_a_cut_makes_it_search_anew_and_nobody_is_left_behind() -> None:
    finder = Finder()
    video = DetectingTracker(tracker(), finder, EYES, DetectionSettings())  # type: ignore[arg-type]
    for t in range(8):
        before, _ = video.step(draw(pose(t)), t)
    assert finder.searches == 5
    after, _ = video.step(255 - draw(pose(8)), 8)
    assert after.restarted and finder.searches == 6 and any("cut" in warning for warning in after.warnings)
    assert [puppet.id for puppet in before.puppets] != [puppet.id for puppet in after.puppets]
    assert len(after.puppets) == 1


def test_a_filter_agrees_with_the_best_path_that_ends_now() -> None:
    joints = np.full((15, 2), 20.0)
    rng = np.random.default_rng(3)
    arms = ArmFilter(SETTINGS)
    history: list[ArmHypotheses] = []
    for t in range(5):
        guesses = rng.uniform(10, 40, (3, 2, 2))
        person = sight(Guesser(joints, {"left": guesses, "right": guesses}, rng.normal(0, 0.3, 3)), joints)
        arms.propagate(still() if t else None, GRID)
        found, right = arms.step(person)["left"]
        if t:
            before: list[np.ndarray] = []
            for k in np.argsort(max_marginals(history, person.width, SETTINGS)[-1], kind="stable"):
                place = history[-1].places[k]
                if len(before) < MAX_KEPT and all(
                    np.hypot(*(place - b).T).max() >= MIN_DISTANCE * person.width for b in before
                ):
                    before.append(place)
            guesses = np.concatenate([guesses, before])
        history.append(ArmHypotheses(guesses, person.score("left", guesses, SETTINGS), np.zeros_like(guesses)))
        cost = max_marginals(history, person.width, SETTINGS)[-1]
        np.testing.assert_allclose(found, guesses[cost.argmin()])
        assert ((right > 0.0) & (right < 1.0)).all()


def test_a_filter_is_carried_through_images_without_a_look() -> None:
    joints, forth = np.full((15, 2), 20.0), np.full((48, 64, 2), (3.0, 0.0), np.float32)
    start = np.array([[20.0, 20.0], [24.0, 28.0]])
    arms = ArmFilter(SETTINGS)
    for t in (0, 2):
        guesses = np.array([start + np.array([3.0 * t, 0.0]), start + np.array([0.0, 15.0])])
        scores = np.array([0.0, -0.1]) if t == 0 else np.array([-0.2, 0.0])
        person = sight(Guesser(joints, {"left": guesses, "right": guesses}, scores), joints)
        found, _ = arms.step(person)["right"]
        for _image in range(2):
            arms.propagate((forth, -forth), GRID)
    np.testing.assert_allclose(found, start + np.array([6.0, 0.0]), atol=1e-5)
