# SPDX-License-Identifier: Apache-2.0
"""Pose in one image on people painted part by part: the search must put right what the detector has wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.pose.estimator import PoseEstimator
from flowing_puppet_ros.image.pose.evidence import KeypointPerson
from flowing_puppet_ros.image.pose.result import PosedPuppet
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels

MODEL = DeformableStructures.load()
NAMES = MODEL.joint_names
UPPER = [name for name in NAMES if not name.endswith(("knee", "ankle"))]
SCALE = 110.0
WRIST, ELBOW = NAMES.index("right_wrist"), NAMES.index("right_elbow")
QUICK = PoseSettings(particles=60, iterations=8)


def painted(joints: np.ndarray, size: tuple[int, int] = (320, 320)) -> np.ndarray:
    """An image whose red value names the part: (H,W,3) uint8."""
    puppet = MODEL.puppet_from_joints(joints, SCALE)
    labels = render_labels(puppet.contours, depth_order(MODEL), size)
    return np.repeat((labels * 20)[..., None], 3, axis=2)


@dataclass(frozen=True)
class PaintedScene:
    """Parts are likely where the inner half of their outline shows their own paint; hands where lower arms end."""

    image: np.ndarray

    def log_likelihood(self, part: int, contours: np.ndarray, scale: np.ndarray) -> np.ndarray:
        middle = contours.mean(axis=1, keepdims=True)
        x, y = np.moveaxis(np.rint(middle + 0.6 * (contours - middle)).astype(int), -1, 0)
        inside = (x >= 0) & (y >= 0) & (x < self.image.shape[1]) & (y < self.image.shape[0])
        seen = self.image[np.where(inside, y, 0), np.where(inside, x, 0), 0]
        return 15 * ((seen == 20 * (part + 1)) & inside).mean(axis=1) - 15

    def with_torso(self, torso: np.ndarray, head: np.ndarray) -> PaintedScene:
        assert torso.ndim == head.ndim == 2
        return self

    def hand_map(self, scale: float) -> np.ndarray:
        arms = [20 * (MODEL.tree.index(f"{side}_lower_arm") + 1) for side in ("left", "right")]
        return np.isin(self.image[..., 0], arms).astype(float)


class PaintedLikelihood:
    """Makes painted scenes."""

    def prepare(self, image: np.ndarray) -> PaintedScene:
        return PaintedScene(image)


@dataclass(frozen=True)
class Guess:
    """A detector's answer whose score is blind to the right arm."""

    keypoints: Keypoints
    confidence: float = 0.8

    def modes(self, count: int) -> list[tuple[Keypoints, float]]:
        return [(self.keypoints, 0.0)]

    @property
    def joints_are_independent(self) -> bool:
        return False

    def joint_score(self, joint: str, xy: np.ndarray) -> np.ndarray:
        if joint in ("right_elbow", "right_wrist"):
            return np.zeros(len(xy))
        return KeypointPerson(self.keypoints, 0.3 * SCALE).joint_score(joint, xy)


@dataclass(frozen=True)
class GuessingDetector:
    """Says what it is told."""

    people: tuple[Guess, ...]

    def detect(self, image: np.ndarray) -> tuple[Guess, ...]:
        assert image.dtype == np.uint8 and image.ndim == 3 and image.flags.c_contiguous
        return self.people


def standing() -> np.ndarray:
    """Joints (15,2) of a person who stands in the middle of a 320 x 320 image, the right arm held up sideways."""
    joints = MODEL.likely_puppet().joints * SCALE + [160, 110]
    shoulder = joints[NAMES.index("right_shoulder")]
    joints[ELBOW] = shoulder + np.array([-28, 5])
    joints[WRIST] = joints[ELBOW] + [-8, -26]
    return joints


def keypoints(joints: np.ndarray, names: list[str] = UPPER, confidence: float = 1.0) -> Keypoints:
    chosen = np.array([joints[NAMES.index(name)] for name in names])
    return Keypoints(tuple(names), chosen, np.full(len(names), confidence))


def with_wrong_arm(joints: np.ndarray) -> np.ndarray:
    wrong = joints.copy()
    wrong[ELBOW] = joints[NAMES.index("right_shoulder")] + [-4, 30]
    wrong[WRIST] = wrong[ELBOW] + [0, 27]
    return wrong


def estimator(joints: np.ndarray, settings: PoseSettings = QUICK, likelihood: bool = True) -> PoseEstimator:
    detector = GuessingDetector((Guess(keypoints(with_wrong_arm(joints))),))
    return PoseEstimator([MODEL], detector, PaintedLikelihood() if likelihood else None, settings)


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return standing()


@pytest.fixture(scope="module")
def posed(joints: np.ndarray) -> PosedPuppet:
    (person,) = estimator(joints).estimate(painted(joints))
    return person


def wrist_error(person: PosedPuppet, joints: np.ndarray) -> float:
    return float(np.linalg.norm(person.joints[WRIST] - joints[WRIST]))


def test_search_moves_a_wrong_arm_onto_the_image(joints: np.ndarray, posed: PosedPuppet) -> None:
    assert np.linalg.norm(with_wrong_arm(joints)[WRIST] - joints[WRIST]) > 60
    assert wrist_error(posed, joints) < 16
    assert np.linalg.norm(posed.joints[ELBOW] - joints[ELBOW]) < 12
    others = [NAMES.index(name) for name in UPPER if not name.startswith("right_")]
    assert np.linalg.norm((posed.joints - joints)[others], axis=1).max() < 12


def test_without_likelihood_the_image_says_nothing(joints: np.ndarray) -> None:
    settings = replace(QUICK, likelihood=False)
    first, other = (
        estimator(joints, settings).estimate(image)[0] for image in (painted(joints), np.zeros((320, 320), np.uint8))
    )
    np.testing.assert_array_equal(first.joints, other.joints)
    assert wrist_error(first, joints) > 20


def test_parts_keep_their_mean_shape_when_told(joints: np.ndarray) -> None:
    start = estimator(joints, replace(QUICK, shape=False))
    (person,) = start.estimate(painted(joints))
    forearm = np.linalg.norm(person.joints[WRIST] - person.joints[ELBOW]) / person.scale
    part = MODEL.shapes[MODEL.tree.index("right_lower_arm")]
    assert forearm == pytest.approx(np.ptp(part.mean[-2:, 0]), rel=0.25)


def test_solutions_are_diverse_and_in_the_order_of_their_energy(joints: np.ndarray, posed: PosedPuppet) -> None:
    energies = [one.energy for one in posed.solutions]
    assert len(energies) == 10 and energies == sorted(energies)
    np.testing.assert_array_equal(posed.solutions[0].joints, posed.joints)
    wrists = np.array([one.joints[[WRIST, NAMES.index("left_wrist")]] for one in posed.solutions])
    apart = np.linalg.norm(wrists[:, None] - wrists[None], axis=3).max(axis=2)[np.triu_indices(10, 1)]
    assert np.median(apart) > 0.1 * SCALE
    assert len(estimator(joints, replace(QUICK, solutions=3)).estimate(painted(joints))[0].solutions) == 3


def test_answer_repeats_itself_and_follows_the_seed(joints: np.ndarray, posed: PosedPuppet) -> None:
    (again,) = estimator(joints).estimate(painted(joints))
    np.testing.assert_array_equal(again.joints, posed.joints)
    (other,) = estimator(joints, replace(QUICK, seed=1)).estimate(painted(joints))
    assert (other.joints != posed.joints).any()
    assert (posed.id, other.id) == ("a1", "b1")


def test_confidence_tells_searched_joints_from_guessed_ones(posed: PosedPuppet) -> None:
    confidence = posed.confidence
    assert ((confidence >= 0) & (confidence <= 1)).all()
    legs = [NAMES.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("knee", "ankle")]
    assert confidence[legs].max() < 0.1 < confidence[NAMES.index("face")] <= 0.8


def test_plain_and_diverse_particles_both_find_a_person(joints: np.ndarray) -> None:
    (plain,) = estimator(joints, replace(QUICK, diverse=False)).estimate(painted(joints))
    assert np.linalg.norm(plain.joints[NAMES.index("neck")] - joints[NAMES.index("neck")]) < 8


def test_refining_betters_the_best_pose(joints: np.ndarray) -> None:
    coarse, fine = (
        estimator(joints, replace(QUICK, particles=24, refinements=rounds)).estimate(painted(joints))[0]
        for rounds in (0, 4)
    )
    assert fine.solutions[0].energy < coarse.solutions[0].energy
    assert len(fine.solutions) == len(coarse.solutions)


def test_given_keypoints_stand_in_for_the_detector(joints: np.ndarray) -> None:
    alone = PoseEstimator([MODEL], None, None, QUICK)
    (person,) = alone.estimate(np.zeros((320, 320, 3), np.uint8), [keypoints(joints, list(NAMES))])
    assert np.linalg.norm(person.joints - joints, axis=1).max() < 8
    assert alone.estimate(np.zeros((320, 320, 3), np.uint8), []) == []
    with pytest.raises(InputError, match="needs keypoints"):
        alone.estimate(np.zeros((320, 320, 3), np.uint8))


def test_seen_from_behind_left_is_left(joints: np.ndarray) -> None:
    flipped = joints * [-1, 1] + [319, 0]
    (person,) = PoseEstimator([MODEL], None, None, QUICK).estimate(
        np.zeros((320, 320), np.uint8), [keypoints(flipped, list(NAMES))]
    )
    assert person.view == "back"
    assert np.linalg.norm(person.joints - flipped, axis=1).max() < 8


def test_someone_seen_from_the_side_gets_that_view() -> None:
    sides = MultiViewStructures.load()
    profile = sides.at("E").likely_puppet().joints * SCALE + [160, 110]
    given = [keypoints(profile, list(NAMES))]
    image = np.zeros((320, 320), np.uint8)
    (person,) = PoseEstimator([MODEL], None, None, QUICK, [sides]).estimate(image, given)
    (front,) = PoseEstimator([MODEL], None, None, QUICK).estimate(image, given)
    width = np.ptp(person.contours[0][:, 0])
    assert width < 0.8 * np.ptp(front.contours[0][:, 0]), "a torso in profile is narrow"
    depth = dict(zip(MODEL.tree.names, person.depth, strict=True))
    assert depth["left_upper_arm"] < depth["torso"] < depth["right_upper_arm"]


def test_likeliest_gender_is_told(joints: np.ndarray) -> None:
    models = [DeformableStructures.load(gender) for gender in ("neutral", "female", "male")]
    (person,) = PoseEstimator(models, None, None, QUICK).estimate(
        np.zeros((320, 320), np.uint8), [keypoints(joints, list(NAMES))]
    )
    assert sum(person.gender_probability.values()) == pytest.approx(1)
    best = max(person.gender_probability, key=lambda name: person.gender_probability[name])
    assert person.model == f"{best}-10"


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (1, 1, 3), (3, 200), (240, 320)])
def test_images_that_show_little_give_the_model_s_guess(joints: np.ndarray, shape: tuple[int, ...]) -> None:
    (person,) = estimator(joints).estimate(np.full(shape, 7, np.uint8))
    assert np.isfinite(person.joints).all()
    assert person.confidence.max() <= 0.8


def test_large_image_is_shrunk_and_answered_in_its_own_pixels(joints: np.ndarray) -> None:
    factor = 8000 / 320
    image = np.zeros((8000, 12000), np.uint8)
    given = keypoints((joints + 0.5) * factor - 0.5, list(NAMES))
    (person,) = PoseEstimator([MODEL], None, None, QUICK).estimate(image, [given])
    assert person.scale == pytest.approx(SCALE * factor, rel=0.15)
    assert np.linalg.norm(person.joints - given.xy, axis=1).max() < 8 * factor


@pytest.mark.parametrize("image", [np.zeros((4, 4)), np.zeros((0, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)])
def test_what_is_no_image_is_refused(joints: np.ndarray, image: np.ndarray) -> None:
    with pytest.raises(InputError, match="an image must be"):
        estimator(joints).estimate(image)


def test_ten_people_and_half_people(joints: np.ndarray) -> None:
    crowd = [keypoints(joints + np.array([12.0 * turn, 0])) for turn in range(10)]
    half = keypoints(joints, ["face", "neck", "belly", "left_shoulder", "left_elbow"])
    one_dot = keypoints(joints, ["face"])
    people = PoseEstimator([MODEL], None, None, PoseSettings(particles=12, iterations=1)).estimate(
        painted(joints), [*crowd, half, one_dot]
    )
    assert [person.id for person in people] == [f"a{k}" for k in range(1, 12)]
    assert all(np.isfinite(person.joints).all() for person in people)


def test_doubtful_people_are_left_out_beside_a_sure_one(joints: np.ndarray) -> None:
    sure, doubtful = (Guess(keypoints(joints), confidence) for confidence in (0.9, 0.22))
    quick = PoseSettings(particles=12, iterations=1)
    for people, settings, count in (
        ((sure, doubtful), quick, 1),
        ((doubtful,), quick, 1),
        ((sure, sure), quick, 2),
        ((sure, doubtful), replace(quick, others=0.2), 2),
    ):
        found = PoseEstimator([MODEL], GuessingDetector(people), None, settings).estimate(painted(joints))
        assert len(found) == count
