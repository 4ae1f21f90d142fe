# SPDX-License-Identifier: Apache-2.0
"""The folder of images: what its items are, and that nothing else is ever read."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.annotate.folder import MAX_SHOWN_PIXELS, ImageFolder, split_key
from flowing_puppet_ros.errors import InputError


def write_image(path: Path, value: int = 128, size: tuple[int, int] = (20, 30)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((*size, 3), value, np.uint8))


def write_video(path: Path, values: list[int]) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (32, 32))
    for value in values:
        writer.write(np.full((32, 32, 3), value, np.uint8))
    writer.release()


def test_items_are_in_natural_order_with_the_frames_of_videos(tmp_path: Path) -> None:
    for name in ("b10.png", "b9.png", "sub/a.jpg"):
        write_image(tmp_path / name)
    write_video(tmp_path / "v.avi", [0, 50, 100])
    (tmp_path / "notes.txt").write_text("no image")
    folder = ImageFolder(tmp_path)
    images = [key for key in folder.items if "#" not in key]
    assert images.index("b9.png") < images.index("b10.png")
    assert set(folder.items) == {"b9.png", "b10.png", "sub/a.jpg", "v.avi#0", "v.avi#1", "v.avi#2"}


def test_the_item_before_is_of_the_same_video_or_folder(tmp_path: Path) -> None:
    write_image(tmp_path / "a1.png")
    write_image(tmp_path / "a2.png")
    write_video(tmp_path / "b.avi", [0, 50])
    folder = ImageFolder(tmp_path)
    assert folder.previous("a1.png") is None
    assert folder.previous("a2.png") == "a1.png"
    assert folder.previous("b.avi#0") is None
    assert folder.previous("b.avi#1") == "b.avi#0"


def test_frames_are_read_forwards_and_backwards(tmp_path: Path) -> None:
    values = [10, 60, 110, 160, 210, 250]
    write_video(tmp_path / "v.avi", values)
    folder = ImageFolder(tmp_path)
    for index in (0, 1, 4, 2, 5, 3, 0):
        assert abs(int(folder.load_image(f"v.avi#{index}").mean()) - values[index]) < 6


def test_images_come_as_rgb(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "red.png"), np.full((8, 9, 3), (0, 0, 255), np.uint8))
    np.testing.assert_array_equal(ImageFolder(tmp_path).load_image("red.png")[0, 0], [255, 0, 0])


@pytest.mark.slow
def test_a_12_megapixel_image_is_shown_whole_and_a_larger_one_reduced(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", size=(3000, 4000))
    write_image(tmp_path / "b.png", size=(5000, 4000))
    folder = ImageFolder(tmp_path)
    shown = []
    for key in folder.items:
        picture = cv2.imdecode(np.frombuffer(folder.encode_jpeg(key), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        shown.append(picture.shape)
    assert shown[0] == (3000, 4000, 3)
    assert 0.98 * MAX_SHOWN_PIXELS < shown[1][0] * shown[1][1] <= MAX_SHOWN_PIXELS
    assert folder.load_image("b.png").shape == (5000, 4000, 3)


@pytest.mark.parametrize("key", ["../secret.png", "/etc/passwd", "sub/../../secret.png", "", "link.png", "a.png#0"])
def test_only_items_are_read(tmp_path: Path, key: str) -> None:
    write_image(tmp_path / "secret.png")
    inside = tmp_path / "in"
    write_image(inside / "a.png")
    (inside / "link.png").symlink_to(tmp_path / "secret.png")
    folder = ImageFolder(inside)
    assert folder.items == ("a.png",)
    with pytest.raises(InputError, match="is not an image of this folder"):
        folder.load_image(key)


def test_an_item_that_becomes_a_link_out_of_the_folder_is_not_read(tmp_path: Path) -> None:
    write_image(tmp_path / "secret.png")
    inside = tmp_path / "in"
    write_image(inside / "a.png")
    folder = ImageFolder(inside)
    (inside / "a.png").unlink()
    (inside / "a.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="no longer in the folder"):
        folder.load_image("a.png")


def test_what_cannot_be_decoded_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no png")
    with pytest.raises(InputError, match="cannot be decoded"):
        ImageFolder(tmp_path).load_image("a.png")


def test_a_video_that_ends_early_is_one_sentence(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", [0, 50, 100, 150])
    folder = ImageFolder(tmp_path)
    write_video(tmp_path / "v.avi", [0])
    with pytest.raises(InputError, match="cannot be decoded"):
        folder.load_image("v.avi#3")
    assert folder.load_image("v.avi#0").shape == (32, 32, 3)


@pytest.mark.parametrize("make", ["missing", "empty", "file"])
def test_a_folder_without_images_is_one_sentence(tmp_path: Path, make: str) -> None:
    path = tmp_path / "f"
    if make == "empty":
        path.mkdir()
    elif make == "file":
        path.write_text("")
    with pytest.raises(InputError):
        ImageFolder(path)


@pytest.mark.parametrize(("key", "parts"), [("a.png", ("a.png", None)), ("v#1.avi#12", ("v#1.avi", 12))])
def test_keys(key: str, parts: tuple[str, int | None]) -> None:
    assert split_key(key) == parts
