# SPDX-License-Identifier: Apache-2.0
"""Outputs of every kind of network, made by hand, and the people they stand for."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.decoders import DECODERS

SIZE = (64, 48)


def decode(kind: str, *outputs: Any, joints: int = 2, size: tuple[int, int] = SIZE) -> list[Any]:
    return DECODERS[kind]([np.asarray(output, np.float32) for output in outputs], size, joints)


def yolo_row(
    x: float, score: float, joints: Sequence[tuple[float, float, float]] = ((1, 2, 0.5), (3, 4, 0.6))
) -> list[float]:
    """Return a person whose box is 20 px wide and 30 high about (x, 24)."""
    return [x, 24.0, 20.0, 30.0, score, *(value for joint in joints for value in joint)]


@pytest.mark.parametrize("transposed", [False, True])
def test_yolo_gives_boxes_once_most_certain_first_in_either_layout(transposed: bool) -> None:
    rows = np.array([
        yolo_row(20, 0.6), yolo_row(21, 0.9, ((7, 8, 0.9), (9, 10, 0.8))), yolo_row(50, 0.7), yolo_row(40, 0.01)
    ])  # fmt: skip
    people = decode("yolo", (rows.T if transposed else rows)[None])
    assert [round(score, 3) for _, _, score in people] == [0.9, 0.7], "one of two boxes in one place; none of no score"
    np.testing.assert_allclose(people[0][0], [(7, 8), (9, 10)])
    np.testing.assert_allclose(people[0][1], (0.9, 0.8), rtol=1e-6)


def test_yolo_keeps_two_people_whose_boxes_overlap_by_half() -> None:
    assert len(decode("yolo", [[yolo_row(20, 0.6), yolo_row(26, 0.9)]])) == 2  # 14 of 26 px in common


def test_yolo_without_people_and_with_as_many_rows_as_columns() -> None:
    assert decode("yolo", np.zeros((1, 11, 0))) == [] == decode("yolo", np.zeros((1, 11, 30)))
    square = np.array([yolo_row(10.0 * k, 0.9 - 0.05 * k) for k in range(11)])
    assert len(decode("yolo", square[None])) == 11


def test_movenet_gives_people_in_pixels_of_the_input() -> None:
    person = [0.5, 0.25, 0.9, 0.75, 0.5, 0.4, 0, 0, 0, 0, 0.8]  # (y, x, score) of two joints, a box, a score
    ((joints, scores, score),) = decode("movenet", [[person, [0.0] * 11]])
    np.testing.assert_allclose(joints, [(15.5, 23.5), (31.5, 35.5)])  # a quarter of 64 is the edge of pixels 15 and 16
    np.testing.assert_allclose(scores, (0.9, 0.4), rtol=1e-6)
    assert score == pytest.approx(0.8)


def test_movenet_of_a_single_person_has_the_mean_score() -> None:
    ((joints, _, score),) = decode("movenet", [[[[0.5, 0.25, 0.9], [0.75, 0.5, 0.4]]]])
    np.testing.assert_allclose(joints, [(15.5, 23.5), (31.5, 35.5)])
    assert score == pytest.approx(0.65)


def test_simcc_takes_the_largest_bins_of_x_and_y() -> None:
    across, down = np.zeros((1, 2, 128)), np.zeros((1, 2, 96))
    across[0, 0, 100], down[0, 0, 31], across[0, 1, 3], down[0, 1, 95] = 0.9, 0.7, 1.4, 2.0
    ((joints, scores, score),) = decode("simcc", across, down)
    np.testing.assert_allclose(joints, [(50, 15.5), (1.5, 47.5)])
    np.testing.assert_allclose(scores, (0.7, 1.0), rtol=1e-6)
    assert score == pytest.approx(0.85)


def test_heat_maps_have_their_place_between_pixels_towards_the_larger_neighbour() -> None:
    maps = np.zeros((1, 2, 12, 16))  # each pixel is four by four of the input
    maps[0, 0, 5, 8], maps[0, 0, 5, 9], maps[0, 0, 4, 8] = 0.8, 0.5, 0.2
    maps[0, 1, 0, 15] = 0.6
    ((joints, scores, score),) = decode("heatmap", maps)
    np.testing.assert_allclose(joints[0], ((8 + 0.25 + 0.5) * 4 - 0.5, (5 - 0.25 + 0.5) * 4 - 0.5))
    assert np.abs(joints[1] - (15.5 * 4 - 0.5, 0.5 * 4 - 0.5)).max() <= 1.0
    np.testing.assert_allclose(scores, (0.8, 0.6), rtol=1e-6)
    assert score == pytest.approx(0.7)


def test_a_soft_heat_map_is_found_within_a_quarter_of_its_pixels() -> None:
    x, y = np.meshgrid(np.arange(16), np.arange(12))
    for place in ((5.2, 6.4), (9.0, 3.3), (7.45, 7.6)):
        spot = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 2)
        ((joints, _, _),) = decode("heatmap", spot[None, None], joints=1)
        assert np.abs(joints[0] - ((np.array(place) + 0.5) * 4 - 0.5)).max() <= 0.26 * 4


@pytest.mark.parametrize("kind", ["yolo", "movenet"])
def test_rows_with_unknown_numbers_are_nobody(kind: str) -> None:
    row = yolo_row(20, 0.6) if kind == "yolo" else [0.5, 0.25, 0.9, 0.75, 0.5, 0.4, 0, 0, 0, 0, 0.8]
    for value in (np.nan, np.inf):
        for place in range(11):
            broken = [*row]
            broken[place] = value
            assert len(decode(kind, [[broken, row]])) == 1


@pytest.mark.parametrize("kind", ["simcc", "heatmap"])
def test_one_joint_without_numbers_is_unknown_and_the_others_stay(kind: str) -> None:
    shapes = [(1, 2, 12, 16)] if kind == "heatmap" else [(1, 2, 32), (1, 2, 48)]
    outputs = [np.full(shape, 0.5) for shape in shapes]
    for output in outputs:
        output[0, 1] = np.nan
    ((_, scores, score),) = decode(kind, *outputs)
    np.testing.assert_allclose(scores, (0.5, 0.0))
    assert score == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("kind", "shapes", "needs"),
    [
        ("yolo", [(1, 12, 30)], "(1, 11, N) for 2 joints"),
        ("yolo", [(1, 2, 11, 30)], "2 sides after the first"),
        ("yolo", [(11,)], "2 sides after the first"),
        ("movenet", [(1, 6, 56)], "(1, N, 11) for 2 joints"),
        ("simcc", [(1, 2, 128)], "two outputs"),
        ("simcc", [(1, 2, 128), (1, 3, 96)], "(1, 2, bins)"),
        ("heatmap", [(1, 17, 12, 16)], "(1, 2, h, w)"),
        ("heatmap", [(1, 2, 0, 16)], "(1, 2, h, w)"),
        ("heatmap", [(2, 12)], "3 sides after the first"),
        ("simcc", [(1, 2, 0), (1, 2, 96)], "(1, 2, bins)"),
    ],
)
def test_another_shape_is_one_sentence(kind: str, shapes: list[tuple[int, ...]], needs: str) -> None:
    with pytest.raises(InputError, match=re.escape(needs)) as error:
        decode(kind, *(np.zeros(shape) for shape in shapes))
    assert "\n" not in str(error.value) and "`decoder` and `joints`" in str(error.value)
