# SPDX-License-Identifier: Apache-2.0
"""Files with several people, stray points or a floor."""

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.body.segmentation.pieces import split_pieces
from flowing_puppet_ros.body.segmentation.up_axis import has_floor

RNG = np.random.default_rng(0)
MAN = cloud_of(joints_of(), 3000)[0]
BESIDE = MAN + np.array([0.3, 1.1, 0.0])


@pytest.mark.parametrize("scale", [1.0, 1000.0, 0.3])
@pytest.mark.parametrize("axes", [[0, 1, 2], [1, 2, 0]])
def test_people_apart_are_pieces(scale: float, axes: list[int]) -> None:
    both = scale * np.concatenate([MAN, BESIDE])[:, axes]
    pieces = split_pieces(Scan(both[RNG.permutation(len(both))]))
    assert pieces.are_people
    middles = sorted((piece.points.mean(axis=0) / scale).tolist() for piece in pieces.large)
    expected = sorted((points[:, axes].mean(axis=0)).tolist() for points in (MAN, BESIDE))
    np.testing.assert_allclose(middles, expected, atol=0.01)


def test_people_of_one_mesh_who_nearly_touch_are_pieces() -> None:
    boxes, faces = [], []
    for number in range(2):
        box = np.array([[x, y, z] for x in (0, 0.4) for y in (0, 0.3) for z in (0, 1.7)]) + np.array(
            [0.41 * number, 0, 0]
        )
        boxes.append(box)
        faces.append(8 * number + np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]))
        faces.append(8 * number + np.array([[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]))
    pieces = split_pieces(Scan(np.concatenate(boxes), np.concatenate(faces)))
    assert pieces.are_people
    assert sorted(piece.points[:, 0].min() for piece in pieces.large) == [0, 0.41]
    assert [piece.area for piece in pieces.large] == pytest.approx([2 * (0.12 + 0.68 + 0.51)] * 2)


def test_parts_of_one_person_are_no_people() -> None:
    waist = np.abs(MAN[:, 2] + 0.05) < 0.12
    pieces = split_pieces(Scan(MAN[~waist]))
    assert len(pieces.large) == 2 and not pieces.are_people
    assert len(pieces.scan.points) == (~waist).sum()
    assert split_pieces(Scan(MAN)).large == []


def test_stray_points_are_dropped_and_hands_are_not() -> None:
    stray = RNG.uniform(2, 5, (12, 3))
    wrist = (MAN[:, 1] > 0.3) & (MAN[:, 1] < 0.33) & (MAN[:, 2] < 0.2)
    given = np.concatenate([MAN[~wrist], stray])
    kept = split_pieces(Scan(given)).scan.points
    assert len(kept) == len(given) - len(stray)
    np.testing.assert_allclose(np.ptp(kept, axis=0), np.ptp(MAN[~wrist], axis=0))


@pytest.mark.parametrize("axes", [[0, 1, 2], [1, 2, 0], [2, 0, 1]])
def test_floors_are_noticed_and_people_are_none(axes: list[int]) -> None:
    floor = np.column_stack(
        [RNG.uniform(-1, 1, (2000, 2)), np.full(2000, MAN[:, 2].min()) + RNG.normal(0, 0.004, 2000)]
    )
    assert has_floor(np.concatenate([MAN, floor])[:, axes])
    for lift in (0.2, 1.5, 2.5):
        assert not has_floor(cloud_of(joints_of(raise_left=lift, raise_right=lift), 3000)[0][:, axes])
