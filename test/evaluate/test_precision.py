# SPDX-License-Identifier: Apache-2.0
"""OKS by hand, and average precision against what COCO's own program says of the same scene."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.precision import ScoredImage, measure_precision
from flowing_puppet_ros.evaluate.similarity import (
    SIGMAS,
    can_compare,
    estimate_area,
    measure_extent,
    measure_shares,
    measure_similarity,
    stand_on_anybody,
)

NAMES = tuple(SIGMAS)
COCO_ALL = [47.86433768292497, 60.11014511425806, 52.95507216038744, 53.16455696202532]
COCO_ARMS = [50.41204022818738, 59.224571958831596, 52.900822687821126, 56.83544303797468]
Person = dict[str, np.ndarray]


def draw(*numbers: float) -> float:
    """Return a fixed number in [0, 1) for some numbers, the same with every version of NumPy."""
    return float(np.sin(np.dot(numbers, (12.9898, 78.233, 37.719, 91.17)[: len(numbers)])) * 43758.5453 % 1.0)


def draw_scene(images: int) -> list[tuple[list[Person], list[Person], np.ndarray]]:
    """Return true people, found people and scores of each image: some missed, some twice, of all accuracies."""
    scene = []
    for image in range(images):
        true: list[Person] = []
        found: list[Person] = []
        score = []
        for who in range(1 + image % 3):
            size, left = 60 + 90 * draw(image, who, 1), 180 * who
            joints = {
                name: np.array([left, 50.0]) + size * np.array([draw(image, who, 2, k), 2 * draw(image, who, 3, k)])
                for k, name in enumerate(NAMES)
            }
            true.append({name: joints[name] for k, name in enumerate(NAMES) if draw(image, who, 4, k) < 0.8})
            for turn in range(int(3 * draw(image, who, 5))):
                off = 0.2 * size * draw(image, who, 6, turn) ** 2
                angle = 2 * np.pi * draw(image, who, 7, turn)
                move = off * np.array([np.cos(angle), np.sin(angle)])
                found.append({n: at + move for k, (n, at) in enumerate(joints.items()) if draw(image, who, k) < 0.95})
                score.append(round(1 - off / size + 0.05 * draw(image, who, 8, turn), 3))
        scene.append((true, found, np.array(score)))
    return scene


def body(x: float = 0.0, size: float = 100.0) -> Person:
    places = {
        "left_shoulder": (0.3, 0.0),
        "right_shoulder": (0.0, 0.0),
        "left_hip": (0.3, 0.6),
        "right_knee": (0.0, 1.0),
    }
    return {name: np.array(place) * size + [x, 0.0] for name, place in places.items()}


def test_similarity_by_hand() -> None:
    # The box of 30 x 100 px grows to 40 x 110, of which 0.53 are filled.
    assert estimate_area(body()) == pytest.approx(0.53 * 40 * 110)
    moved = body() | {"left_shoulder": body()["left_shoulder"] + [3.0, 4.0]}
    del moved["right_knee"]
    shoulder = np.exp(-(25.0 / (2 * 0.53 * 40 * 110 * (2 * 0.079) ** 2)))
    np.testing.assert_allclose(measure_similarity([body(), moved], [body()], NAMES), [[1.0], [(2 + shoulder) / 4]])
    np.testing.assert_allclose(measure_similarity([moved], [body()], ["left_shoulder"]), [[shoulder]])


def test_who_has_no_joint_or_no_extent_cannot_be_compared() -> None:
    alone = {"nose": np.zeros(2)}
    assert not can_compare(alone, NAMES) and not can_compare(body(), ["nose"]) and can_compare(body(), NAMES)
    assert np.isnan(measure_similarity([body()], [alone], NAMES)).all()
    assert np.isnan(measure_shares([body()], [alone], NAMES)).all()
    assert measure_extent({}) == 0 and estimate_area({}) == 0


def test_shares_are_medians_by_the_larger_side() -> None:
    moved = {name: point + np.array([0.0, k]) for k, (name, point) in enumerate(body().items())}
    assert measure_shares([moved], [body()], NAMES) == pytest.approx(np.array([[0.015]]))
    del moved["left_shoulder"], moved["right_shoulder"]
    assert np.isinf(measure_shares([moved], [body()], NAMES)).all(), "half of the joints are missing"
    assert stand_on_anybody([body(19.0), body(21.0)], [body(), body(300.0)], NAMES).tolist() == [True, False]


def rate(scene: list[tuple[list[Person], list[Person], np.ndarray]], names: tuple[str, ...]) -> list[ScoredImage]:
    return [ScoredImage(measure_similarity(found, true, names), score) for true, found, score in scene]


def test_precision_of_a_scene_is_that_of_pycocotools() -> None:
    """The figures are `COCOeval.stats[[0, 1, 2, 5]]` of pycocotools 2.0.11 on the same people, areas and deviations."""
    figures = measure_precision(rate(draw_scene(40), NAMES))
    np.testing.assert_allclose([*figures.values()], COCO_ALL, atol=1e-8)
    arms = tuple(name for name in NAMES if name.endswith(("shoulder", "elbow", "wrist")))
    np.testing.assert_allclose([*measure_precision(rate(draw_scene(40), arms)).values()], COCO_ARMS, atol=1e-8)


def test_precision_by_hand() -> None:
    perfect, nothing = np.array([[1.0]]), np.zeros((0, 1))
    assert set(measure_precision([ScoredImage(perfect, np.ones(1))]).values()) == {100.0}
    # Found: one of two; precision 1 up to a recall of 0.5, which are 51 of the 101 places.
    half = measure_precision([ScoredImage(perfect, np.ones(1)), ScoredImage(nothing, np.zeros(0))])
    assert half["OKS AP, %"] == pytest.approx(100 * 51 / 101) and half["OKS AR, %"] == 50
    # A ghost with a better score halves the precision everywhere, one with a lower score does nothing.
    for score, value in ((0.9, 50.0), (0.1, 100.0)):
        ghost = ScoredImage(np.array([[1.0], [0.0]]), np.array([0.5, score]))
        assert measure_precision([ghost])["OKS AP, %"] == pytest.approx(value)
    good = measure_precision([ScoredImage(np.array([[0.76]]), np.ones(1))])
    assert good == pytest.approx({"OKS AP, %": 60, "OKS AP50, %": 100, "OKS AP75, %": 100, "OKS AR, %": 60})
    assert set(measure_precision([ScoredImage(nothing, np.zeros(0))]).values()) == {0.0}
    assert np.isnan([*measure_precision([ScoredImage(np.zeros((1, 0)), np.ones(1))]).values()]).all()


def test_only_the_best_twenty_of_an_image_count() -> None:
    similarity = np.zeros((21, 1))
    similarity[20] = 1.0
    assert measure_precision([ScoredImage(similarity, np.arange(21, 0, -1.0))])["OKS AR, %"] == 0
    assert measure_precision([ScoredImage(similarity[1:], np.arange(20, 0, -1.0))])["OKS AR, %"] == 100
