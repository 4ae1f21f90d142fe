# SPDX-License-Identifier: Apache-2.0
"""Learned backgrounds against brute force, and silhouettes of a drawn person before a textured wall."""

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.background import Background, BackgroundSettings
from flowing_puppet_ros.multiview.silhouette import SilhouetteEstimator, SilhouetteSettings

SCALE = 200.0  # pixels per metre of the drawn person
SHAPE = (480, 360)


def texture(seed: int, colour: tuple[int, int, int], contrast: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(*SHAPE, 3)), (0, 0), 6)
    return np.clip(np.array(colour) + contrast * noise / noise.std(), 0, 255)


WALL = texture(1, (120, 130, 140), 25)
SKIN = texture(2, (190, 120, 90), 30)
SKIN[230:] = texture(3, (60, 60, 70), 15)[230:]
WALL[:200, 180:] = texture(4, (190, 130, 100), 20)[:200, 180:]  # much like the person's upper half
WALL[300:] = texture(5, (70, 70, 70), 10)[300:]  # much like the legs
POLE = slice(140, 225), slice(250, 257)  # where the walk below ends, beside the trunk, within the fringe
WALL[POLE] = SKIN[POLE]


def person(x: float, grow: float = 0.0, lift: float = 0.3) -> np.ndarray:
    """Labels of head, trunk, legs and a lifted arm at column `x`; `grow` in metres thickens or thins them."""
    labels = np.zeros(SHAPE, np.uint8)
    parts = [
        ((x, 80), (x, 90), 0.1),
        ((x, 130), (x, 220), 0.16),
        ((x - 20, 240), (x - 35, 400), 0.07),
        ((x + 20, 240), (x + 30, 400), 0.07),
        ((x + 25, 130), (x + 95, 130 - 150 * lift), 0.045),
    ]
    for index, (start, end, radius) in enumerate(parts):
        ends = [tuple(round(v) for v in point) for point in (start, end)]
        cv2.line(labels, ends[0], ends[1], index + 1, int(2 * (radius + grow) * SCALE))
    return labels


def frame(labels: np.ndarray, seed: int, wall: np.ndarray = WALL) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(scale=2, size=(*SHAPE, 3))
    return np.clip(np.where(labels[..., None] > 0, SKIN, wall) + noise, 0, 255).astype(np.uint8)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero((a > 0) & (b > 0)) / np.count_nonzero((a > 0) | (b > 0))


def walk(estimator: SilhouetteEstimator, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The person walks to and fro; returns the last mask, true labels and a coarse puppet (2 cm thinner, 2 cm off)."""
    for index in range(frames):
        x = 170 + 60 * np.sin(0.3 * index)
        truth = person(x, lift=0.3 + 0.2 * np.cos(0.3 * index))
        puppet = np.roll(person(x, grow=-0.02, lift=0.3 + 0.2 * np.cos(0.3 * index)), 4, axis=1)
        observation = estimator.update_background(frame(truth, index), puppet, SCALE)
    silhouette = estimator.segment(observation)
    assert silhouette.problem == ""
    return silhouette.mask, truth, puppet


def test_background_is_the_masked_mean_and_variance() -> None:
    rng = np.random.default_rng(0)
    images = (rng.integers(4, 252, (6, 5, 3)) + rng.integers(-4, 5, (12, 6, 5, 3))).astype(np.uint8)
    bare = rng.random((12, 6, 5)) < 0.6
    background = Background(BackgroundSettings(min_frames=4))
    for image, outside in zip(images, bare, strict=True):
        background.update(image, outside)
    for y in range(6):
        for x in range(5):
            seen = images[bare[:, y, x], y, x].astype(float)
            np.testing.assert_allclose(background.mean[y, x], seen.mean(axis=0), rtol=1e-4)
            np.testing.assert_allclose(background.variance[y, x], seen.var(axis=0), rtol=1e-3)
            assert background.known[y, x] == (len(seen) >= 4)
    levels, spread = background.difference(images[0])
    every = np.abs(images[0] - background.mean)
    np.testing.assert_allclose(levels, every.max(axis=2), rtol=1e-5)
    chosen = np.take_along_axis(np.sqrt(background.variance), every.argmax(axis=2)[..., None], axis=2)[..., 0]
    np.testing.assert_allclose(spread, chosen, rtol=1e-5)


def test_background_follows_slow_change_and_forgets_after_a_cut() -> None:
    everywhere = np.ones((4, 4), bool)
    background = Background(BackgroundSettings(memory=10))
    for grey in range(100, 150):
        background.update(np.full((4, 4, 3), grey, np.uint8), everywhere)
    assert 135 < background.mean.min() <= background.mean.max() < 150
    for _ in range(2):  # a flash is not a new scene
        background.update(np.full((4, 4, 3), 250, np.uint8), everywhere)
    background.update(np.full((4, 4, 3), 150, np.uint8), everywhere)
    assert background.known.all()
    for _ in range(5):
        background.update(np.full((4, 4, 3), 10, np.uint8), everywhere)
    assert background.mean.max() == pytest.approx(10)


def test_a_passing_limb_that_the_puppet_misses_leaves_little_trace() -> None:
    everywhere = np.ones((4, 40), bool)
    background = Background()
    rng = np.random.default_rng(0)
    for index in range(60):
        image = rng.integers(97, 104, (4, 40, 3)).astype(np.uint8)
        if 10 <= index < 50:
            image[:, index - 10 : index - 5] = 200
        background.update(image, everywhere)
    assert np.abs(background.mean - 100).max() < 6
    assert np.sqrt(background.variance).max() < 12


def test_a_shadow_is_darker_by_one_factor_in_all_channels() -> None:
    background = Background()
    wall = np.empty((1, 4, 3), np.uint8)
    wall[:] = (200, 150, 100)
    for _ in range(3):
        background.update(wall, np.ones((1, 4), bool))
    image = wall.copy()
    image[0, 1] = (120, 90, 60)
    image[0, 2] = (120, 140, 60)
    image[0, 3] = (10, 8, 5)
    assert background.find_shadows(image).tolist() == [[False, True, False, False]]


def test_silhouette_is_much_better_than_the_puppet() -> None:
    mask, truth, puppet = walk(SilhouetteEstimator(), 25)
    assert overlap(puppet, truth) < 0.8
    assert overlap(mask, truth) > 0.95


def test_a_learned_background_keeps_out_what_looks_like_the_person() -> None:
    learned, truth, puppet = walk(SilhouetteEstimator(), 25)
    fresh = SilhouetteEstimator()
    alone = fresh.segment(fresh.update_background(frame(truth, 24), puppet, SCALE)).mask
    pole = truth[POLE] == 0
    assert (alone[POLE][pole] > 0).mean() > 0.7
    assert (learned[POLE][pole] > 0).mean() < 0.1


def test_a_standing_person_does_not_become_background() -> None:
    estimator = SilhouetteEstimator()
    truth = person(150)
    for index in range(30):
        observation = estimator.update_background(frame(truth, index), truth, SCALE)
    assert not estimator.background.known[truth > 0].any()
    assert overlap(estimator.segment(observation).mask, truth) > 0.9


def test_silhouettes_come_at_working_scale() -> None:
    estimator = SilhouetteEstimator(SilhouetteSettings(max_side=240))
    mask, truth, _ = walk(estimator, 15)
    assert mask.shape == (240, 180)
    assert set(np.unique(mask)) == {0, 255}
    assert overlap(mask, cv2.resize(truth, (180, 240), interpolation=cv2.INTER_NEAREST)) > 0.9


def test_an_arm_that_the_puppet_has_elsewhere_is_found() -> None:
    estimator = SilhouetteEstimator()
    walk(estimator, 25)
    truth, wrong = person(70, lift=0.2), person(70, lift=-0.7)
    mask = estimator.segment(estimator.update_background(frame(truth, 50), wrong, SCALE)).mask
    arm, ghost = (truth == 5), (wrong == 5) & (truth == 0)
    assert (mask[arm] > 0).mean() > 0.95
    assert (mask[ghost] > 0).mean() < 0.2


def test_other_people_are_neither_background_nor_silhouette() -> None:
    estimator = SilhouetteEstimator()
    walk(estimator, 25)
    left, right = person(100, lift=0.3), person(260, lift=-0.5)
    for index in range(5):
        both = np.maximum(left, right)
        observation = estimator.update_background(frame(both, 50 + index), both, SCALE, left)
    mask = estimator.segment(observation).mask
    assert overlap(mask, left) > 0.93
    assert not mask[:, 270:].any()
    assert estimator.background.mean[300, 275].max() < 110  # still the floor, not the other person's leg


def test_specks_far_from_the_puppet_are_dropped() -> None:
    estimator = SilhouetteEstimator()
    truth = person(120)
    for index in range(8):
        estimator.update_background(frame(person(120 + 10 * index), index), person(120 + 10 * index), SCALE)
    image = frame(truth, 99)
    image[300:320, 330:350] = 255
    mask = estimator.segment(estimator.update_background(image, truth, SCALE)).mask
    assert not mask[290:330, 320:].any()


def test_same_frames_same_bits() -> None:
    assert walk(SilhouetteEstimator(), 6)[0].tobytes() == walk(SilhouetteEstimator(), 6)[0].tobytes()


@pytest.mark.slow
def test_a_mask_unlike_the_recent_ones_raises_the_alarm() -> None:
    estimator = SilhouetteEstimator()
    truth = person(150)
    for index in range(8):
        assert estimator.segment(estimator.update_background(frame(truth, index), truth, SCALE)).problem == ""
    legs_only = np.where((truth == 3) | (truth == 4), truth, 0).astype(np.uint8)
    alarmed = estimator.segment(estimator.update_background(frame(legs_only, 9), legs_only, SCALE))
    assert "of its running median" in alarmed.problem
    assert estimator.segment(estimator.update_background(frame(truth, 10), truth, SCALE)).problem == ""


def test_frames_without_a_puppet_teach_nothing_and_give_an_empty_mask() -> None:
    estimator = SilhouetteEstimator()
    truth = person(150)
    for index in range(6):
        observation = estimator.update_background(frame(truth, index), np.zeros(SHAPE, np.uint8), SCALE)
    assert not estimator.background.known.any()
    silhouette = estimator.segment(observation)
    assert silhouette.problem == "no puppet in the image" and not silhouette.mask.any()


def test_a_puppet_that_fills_the_image_is_cut_without_fuss() -> None:
    estimator = SilhouetteEstimator()
    everywhere = np.ones(SHAPE, np.uint8)
    for index in range(4):
        silhouette = estimator.segment(estimator.update_background(frame(everywhere, index), everywhere, SCALE))
    assert (silhouette.mask == 255).all()


def test_another_image_size_starts_afresh() -> None:
    estimator = SilhouetteEstimator()
    walk(estimator, 5)
    labels = person(150)[:300]
    observation = estimator.update_background(frame(person(150), 0)[:300], labels, SCALE)
    assert estimator.background.count.max() == 1
    assert estimator.segment(observation).mask.shape == (300, 360)


def test_images_and_labels_that_do_not_fit_are_refused() -> None:
    estimator = SilhouetteEstimator()
    labels = person(150)
    image = frame(labels, 0)
    with pytest.raises(InputError, match="RGB image"):
        estimator.update_background(image[..., 0], labels, SCALE)
    with pytest.raises(InputError, match="RGB image"):
        estimator.update_background(image[:0], labels[:0], SCALE)
    with pytest.raises(InputError, match="part labels"):
        estimator.update_background(image, labels[:-1], SCALE)
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="scale"):
            estimator.update_background(image, labels, scale)
    with pytest.raises(InputError, match="part labels"):
        estimator.update_background(image, labels, SCALE, labels[:-1])
