# SPDX-License-Identifier: Apache-2.0
"""Bodies over images: where the lens shows them, of the nearest cloud, and not of clouds that are far in time."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.draw.palette import NEUTRAL
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.report.data import gather_data
from flowing_puppet_ros.report.pictures.bag_pictures import BodyMesh, ImageBox
from flowing_puppet_ros.report.pictures.bodies_over_colour import (
    PAIR_HEIGHT,
    BodiesAtStamp,
    draw_bodies,
    find_everybody_box,
    find_nearest_stamp,
)

type Replay = Callable[..., tuple[Path, Path]]

SIZE = (320, 240)
MATRIX = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
LENS = np.array([-0.35, 0.12, 0.001, -0.002, 0.0])
BOX = np.array([[x, y, z] for x in (0.5, 0.8) for y in (-0.6, 0.6) for z in (2.0, 2.2)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = np.array([corner for a, b, c, d in QUADS for corner in ((a, b, c), (a, c, d))])


def make_bodies(vertices: np.ndarray, stamp: int = 0) -> BodiesAtStamp:
    mesh = BodyMesh(vertices, TRIANGLES, np.tile(np.array(NEUTRAL, float), (len(vertices), 1)), np.zeros((0, 3)))
    return BodiesAtStamp(stamp, ["a1"], [mesh])


def test_a_body_lies_where_the_lens_shows_it() -> None:
    """The outline of a box at the side of a strongly distorted image, against OpenCV's own projection."""
    camera = Camera.from_info(MATRIX.ravel(), LENS, *SIZE, np.eye(3), np.zeros(3))
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    whole = ImageBox(0, 0, *SIZE)
    drawn = cv2.resize(draw_bodies(image, camera, make_bodies(BOX), whole), SIZE, interpolation=cv2.INTER_AREA)
    drawn[:34] = 0  # the id
    rows, columns = np.nonzero(drawn.max(axis=2) > 20)
    pixels = cv2.projectPoints(BOX, np.zeros(3), np.zeros(3), MATRIX, LENS)[0].reshape(-1, 2)
    found = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
    np.testing.assert_allclose(found, [*pixels.min(axis=0), *pixels.max(axis=0)], atol=1.5)
    straight = cv2.projectPoints(BOX, np.zeros(3), np.zeros(3), MATRIX, np.zeros(5))[0].reshape(-1, 2)
    assert abs(straight.max(axis=0)[0] - pixels.max(axis=0)[0]) > 6  # without the lens it would be elsewhere


def test_pictures_have_everybody_and_stay_in_the_image() -> None:
    camera = Camera.from_info(MATRIX.ravel(), np.zeros(5), *SIZE, np.eye(3), np.zeros(3))
    left, right = make_bodies(BOX - [1.2, 0, 0]), make_bodies(BOX)
    pixels = np.concatenate([camera.project(each.meshes[0].vertices)[0] for each in (left, right)])
    box = find_everybody_box(camera, [left, right], [], (SIZE[1], SIZE[0], 3))
    assert box.left <= pixels[:, 0].min() and box.right >= pixels[:, 0].max()
    assert box.top >= 0 and box.bottom <= SIZE[1]
    image = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    nobody = draw_bodies(image, camera, None, box)
    assert nobody.shape[0] == PAIR_HEIGHT and (nobody == 90).all()


def test_each_image_has_the_bodies_of_the_nearest_cloud() -> None:
    second = 1_000_000_000
    assert find_nearest_stamp([0, second], second // 5) == 0
    assert find_nearest_stamp([0, second], 7 * second // 10) == second
    assert find_nearest_stamp([0, second], second // 2) is None
    assert find_nearest_stamp([], 0) is None


@pytest.mark.slow
def test_the_report_shows_bodies_beside_the_puppets(replay: Replay) -> None:
    """Of five images every second one has a cloud; the others show the bodies of a cloud 0.1 s away."""
    data = gather_data(*replay())
    stamps = [stamp for stamp, _ in data.strip]
    assert len(stamps) == 5 and sorted(data.overlaid) == stamps
    apart = [abs(stamp - (data.overlaid[stamp][1] or 0)) for stamp in stamps]
    assert apart == [0, 100_000_000, 0, 100_000_000, 0]
    for stamp, picture in data.strip:
        assert picture.shape == data.overlaid[stamp][0].shape
        assert np.abs(picture.astype(int) - data.overlaid[stamp][0]).max() > 40


@pytest.mark.slow
def test_without_bodies_there_is_nothing_beside_the_puppets(replay: Replay) -> None:
    data = gather_data(*replay(bodies=False))
    assert len(data.strip) == 5 and not data.overlaid
