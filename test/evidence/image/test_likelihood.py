# SPDX-License-Identifier: Apache-2.0
"""The shipped likelihood: what it needs, and its values for contours that are out of the image or broken."""

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.image.contour import PLACES, describe, order_as_right, part_kind
from flowing_puppet_ros.evidence.image.likelihood import TERMS_OF, ImageEvidence, PartLikelihood, hand_points
from flowing_puppet_ros.evidence.image.outline import mirror_order
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import PuppetShape

SIZE = (200, 160)
UPPER = range(6)


@pytest.fixture(scope="module")
def model() -> DeformableStructures:
    return DeformableStructures.load()


@pytest.fixture(scope="module")
def likelihood() -> PartLikelihood:
    return PartLikelihood.load()


@pytest.fixture(scope="module")
def puppet(model: DeformableStructures) -> PuppetShape:
    return model.puppet_from_joints(130 * (model.mean_joints() - model.mean_joints()[0]) + (100, 55), 130.0)


@pytest.fixture(scope="module")
def image(puppet: PuppetShape) -> np.ndarray:
    """A person in a blue shirt with bare forearms before a mottled wall."""
    coarse = np.random.default_rng(3).integers(60, 160, (8, 10, 3)).astype(np.uint8)
    drawn = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)
    for part, contour in enumerate(puppet.contours):
        colour = (205, 150, 125) if part in (1, 4, 5) else (40, 60, 130)
        cv2.fillPoly(drawn, [np.round(contour).astype(np.int32)], colour, cv2.LINE_AA)
    return np.asarray(drawn)


@pytest.fixture(scope="module")
def evidence(likelihood: PartLikelihood, puppet: PuppetShape, image: np.ndarray) -> ImageEvidence:
    return likelihood.prepare(image).with_torso(*puppet.contours[:2])


def test_shipped_file_has_the_upper_body(model: DeformableStructures, likelihood: PartLikelihood) -> None:
    assert set(likelihood.terms) == set(TERMS_OF)
    for kind, terms in TERMS_OF.items():
        assert likelihood.terms[kind].shape == (len(terms),)
        assert likelihood.terms[kind][0] > 0 > likelihood.contour.filters[kind].calibration[0]
        assert likelihood.contour.filters[kind].weights.shape[1] == PLACES[kind]
    with pytest.raises(InputError, match="no likelihood model called '7'; installed are 10"):
        PartLikelihood.load(7)


def test_it_survives_saving_and_loading(likelihood: PartLikelihood, puppet: PuppetShape, image: np.ndarray) -> None:
    again = PartLikelihood.from_arrays(10, likelihood.to_arrays())
    for part in UPPER:
        contours = puppet.contours[part][None]
        ours, theirs = (some.prepare(image).log_likelihood(part, contours, 130.0) for some in (likelihood, again))
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("part", UPPER)
def test_right_contours_beat_moved_ones(evidence: ImageEvidence, puppet: PuppetShape, part: int) -> None:
    rng = np.random.default_rng(part)
    shifts = rng.choice([-1, 1], (40, 1, 2)) * rng.uniform(8, 40, (40, 1, 2))
    contours = np.concatenate([puppet.contours[part][None], puppet.contours[part] + shifts])
    scores = evidence.log_likelihood(part, contours, 130.0)
    assert np.sum(scores[1:] > scores[0]) <= 4


def test_a_batch_is_its_members(evidence: ImageEvidence, puppet: PuppetShape) -> None:
    scales = np.array([60.0, 130.0, 131.0, 290.0])
    contours = puppet.contours[4] + np.arange(4)[:, None, None]
    together = evidence.log_likelihood(4, contours, scales)
    alone = [evidence.log_likelihood(4, contours[k : k + 1], float(scales[k]))[0] for k in range(4)]
    np.testing.assert_array_equal(together, alone)
    assert evidence.log_likelihood(4, contours[:0], 130.0).shape == (0,)


def test_the_picture_in_a_mirror_has_the_other_limb(
    likelihood: PartLikelihood, evidence: ImageEvidence, puppet: PuppetShape, image: np.ndarray
) -> None:
    def mirrored(contour: np.ndarray) -> np.ndarray:
        return mirror_order(contour) * (-1, 1) + (SIZE[0] - 1, 0)

    other = likelihood.prepare(np.ascontiguousarray(image[:, ::-1]))
    other = other.with_torso(mirrored(puppet.contours[0]), mirrored(puppet.contours[1]))
    for right, left in ((2, 3), (4, 5)):
        found = evidence.log_likelihood(right, puppet.contours[right][None], 130.0)
        again = other.log_likelihood(left, mirrored(puppet.contours[right])[None], 130.0)
        np.testing.assert_allclose(again, found, atol=0.02)


def test_a_person_from_behind_has_the_same_contours(evidence: ImageEvidence, puppet: PuppetShape) -> None:
    """From behind the right arm is drawn as the left one is from the front, with mirrored points."""
    left = puppet.contours[5]
    as_right = mirror_order(left)
    one, other = (
        evidence.likelihood.contour.log_likelihood(evidence.features, name, contour[None], 130.0)
        for name, contour in (("left_lower_arm", left), ("right_lower_arm", as_right))
    )
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("part", UPPER)
def test_contours_outside_the_image_are_neutral(evidence: ImageEvidence, puppet: PuppetShape, part: int) -> None:
    contours = puppet.contours[part] + np.array([[5000, 0], [0, -9e6], [1e300, 3]])[:, None]
    terms = evidence.terms(part, contours, 130.0)
    known = evidence.likelihood.contour.filters[part_kind(evidence.names[part])]
    neutral = known.log_probability(np.array([known.unseen.sum() + known.bias]))
    np.testing.assert_allclose(terms[:, 0], np.repeat(neutral, 3), rtol=1e-4)
    assert not terms[:, 1:].any()
    assert (
        evidence.log_likelihood(part, puppet.contours[part][None], 130.0)[0]
        > (evidence.log_likelihood(part, contours[:1], 130.0)[0])
    )


def test_contours_half_outside_are_between(evidence: ImageEvidence, puppet: PuppetShape) -> None:
    contour = puppet.contours[0]
    half = contour - (contour[:, 0].mean(), 0)
    assert np.isfinite(evidence.log_likelihood(0, half[None], 130.0)).all()
    _, visible = describe(evidence.features, half[None], PLACES["torso"], np.array([130.0]))
    assert 0.2 < visible.mean() < 0.8


@pytest.mark.parametrize("part", range(10))
def test_broken_contours_are_impossible_and_spoil_no_others(
    evidence: ImageEvidence, puppet: PuppetShape, part: int
) -> None:
    contours = np.repeat(puppet.contours[part][None], 4, axis=0)
    contours[1, 5, 0], contours[2, 0, 1] = np.nan, np.inf
    scores = evidence.log_likelihood(part, contours, np.array([130.0, 130.0, 130.0, np.nan]))
    assert np.isfinite(scores[0]) and np.all(scores[1:] == -np.inf)
    assert np.all(evidence.log_likelihood(part, contours[:1], 0.0) == -np.inf)


def test_legs_are_neutral(evidence: ImageEvidence, puppet: PuppetShape) -> None:
    for part in range(6, 10):
        assert evidence.log_likelihood(part, puppet.contours[part][None], 130.0)[0] == 0.0


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 1), (160, 200), (3, 90, 3)])
def test_grey_and_tiny_images(likelihood: PartLikelihood, puppet: PuppetShape, shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    evidence = likelihood.prepare(image).with_torso(*puppet.contours[:2])
    for part in UPPER:
        assert np.isfinite(evidence.log_likelihood(part, puppet.contours[part][None], 130.0)).all()
    hands = evidence.hand_map(130.0)
    assert hands.shape == shape[:2] and hands.min() >= 0 and hands.sum() == pytest.approx(1.0)


def test_hand_map_finds_bare_forearms_and_not_the_face(evidence: ImageEvidence, puppet: PuppetShape) -> None:
    hands = evidence.hand_map(130.0)
    weight = {}
    for part in (0, 1, 4, 5):
        mask = cv2.fillPoly(np.zeros(hands.shape, np.uint8), [np.round(puppet.contours[part]).astype(np.int32)], 1)
        weight[part] = hands[mask > 0].mean()
    assert min(weight[4], weight[5]) > 3 * max(weight[0], hands.mean())
    assert weight[1] < 0.1 * weight[4]


def test_hand_map_of_an_enlarged_picture_is_the_enlarged_map(
    likelihood: PartLikelihood, evidence: ImageEvidence, puppet: PuppetShape, image: np.ndarray
) -> None:
    large = likelihood.prepare(cv2.resize(image, None, fx=5, fy=5, interpolation=cv2.INTER_NEAREST))
    hands = large.with_torso(*(5 * contour + 2 for contour in puppet.contours[:2])).hand_map(650.0)
    smaller = cv2.resize(hands, SIZE, interpolation=cv2.INTER_AREA)
    assert np.corrcoef(smaller.ravel(), evidence.hand_map(130.0).ravel())[0, 1] > 0.97


def test_the_hand_is_the_far_end_of_the_lower_arm(model: DeformableStructures) -> None:
    for name in ("right_lower_arm", "left_lower_arm"):
        shape = model.shapes[model.tree.index(name)]
        hand = hand_points(shape.mean[None, : -shape.joint_count])[0]
        wrist = shape.mean[-1, 0]
        assert hand[:, 0].min() == pytest.approx(wrist, abs=0.025)
        assert hand[:, 0].max() == shape.mean[:, 0].max()


def test_left_parts_run_as_right_ones_in_the_mirror(model: DeformableStructures) -> None:
    shapes = dict(zip(model.tree.names, model.shapes, strict=True))
    for kind in ("upper_arm", "lower_arm"):
        right, left = (shapes[f"{side}_{kind}"].mean[:-2] for side in ("right", "left"))
        np.testing.assert_allclose(order_as_right(f"left_{kind}", left) * (1, -1), right, atol=2e-3)
    assert order_as_right("torso", right) is right
