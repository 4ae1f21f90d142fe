# SPDX-License-Identifier: Apache-2.0
"""Sheets, captions and encodings."""

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.draw.palette import PART_COLOURS, part_colours
from flowing_puppet_ros.draw.pictures import add_caption, encode_data_uri, join_row, make_contact_sheet, save, shrink
from flowing_puppet_ros.errors import InputError


def test_contact_sheet_places_every_image() -> None:
    images = [np.full((10, 20, 3), value, np.uint8) for value in (10, 20, 30)]
    sheet = make_contact_sheet(images, columns=2, gap=2)
    assert sheet.shape == (2 * 12 + 2, 2 * 22 + 2, 3)
    for value in (10, 20, 30):
        assert (sheet[..., 0] == value).sum() == 200


def test_row_has_one_height() -> None:
    joined = join_row([np.zeros((40, 20, 3), np.uint8), np.zeros((20, 20, 3), np.uint8)], height=20, gap=4)
    assert joined.shape == (20, 10 + 4 + 20, 3)


def test_shrink_keeps_the_aspect_and_small_images() -> None:
    assert shrink(np.zeros((100, 50, 3), np.uint8), 40).shape == (40, 20, 3)
    small = np.zeros((10, 5, 3), np.uint8)
    assert shrink(small, 40) is small


def test_caption_leaves_the_original_alone() -> None:
    image = np.zeros((40, 120, 3), np.uint8)
    assert add_caption(image, "front").max() > 200 and image.max() == 0


def test_png_data_uri_holds_the_rgb_pixels() -> None:
    image = np.random.default_rng(0).integers(0, 255, (6, 5, 3), dtype=np.uint8)
    kind, data = encode_data_uri(image, "png").split(",", 1)
    assert kind == "data:image/png;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(np.asarray(decoded)[..., ::-1], image)


def test_save_refuses_other_names_and_places(tmp_path: Path) -> None:
    image = np.zeros((6, 5, 3), np.uint8)
    save(image, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[1:4] == b"PNG"
    with pytest.raises(InputError, match=r"end it in \.png"):
        save(image, tmp_path / "a.gif")
    with pytest.raises(InputError, match="cannot write"):
        save(image, tmp_path / "missing" / "a.png")


def test_every_part_of_every_tree_has_a_colour() -> None:
    from flowing_puppet_ros.model.tree import DS14_PARENTS, SP_PARENTS

    assert set(DS14_PARENTS) | set(SP_PARENTS) <= set(PART_COLOURS)
    assert part_colours(["torso", "unheard_of"]).tolist() == [[196, 200, 190], [170, 170, 170]]
