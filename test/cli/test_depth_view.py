# SPDX-License-Identifier: Apache-2.0
"""Depth images and organised clouds from files: places of pixels, cameras of every form, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

from flowing_puppet_ros.cli.scans import fit_depth
from flowing_puppet_ros.cli.scans.depth_view import parse_intrinsics, read_colour, read_depth_view, read_organised
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.rgbd.depth_sensor import to_millimetres
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.evaluate.rgbd.views import RgbdStudio
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson

K = (300.0, 310.0, 81.5, 58.25)
SIZE = (160, 120)


def plane_depth() -> np.ndarray:
    """Return the depth in metres of the plane z = 2 + 0.5 y of the camera's frame, with a border without depth."""
    row = (np.arange(SIZE[1]) - K[3]) / K[1]
    depth = np.tile((2.0 / (1 - 0.5 * row))[:, None], (1, SIZE[0]))
    depth[:, :5] = 0
    return depth


@pytest.mark.parametrize(
    ("suffix", "unit"),
    [(".png", "auto"), (".tif", "mm"), (".pgm", "mm"), (".pfm", "auto"), (".npy", "auto"), (".npz", "auto")],
)
def test_pixels_become_the_places_that_they_show(tmp_path: Path, suffix: str, unit: str) -> None:
    path = tmp_path / f"depth{suffix}"
    if suffix == ".npy":
        np.save(path, plane_depth().astype(np.float32))
    elif suffix == ".npz":  # millimetres with a fraction
        np.savez(path, depth=1000 * plane_depth(), confidence=np.zeros(3))
    elif suffix == ".pfm":
        cv2.imwrite(str(path), plane_depth().astype(np.float32))
    else:
        cv2.imwrite(str(path), np.rint(1000 * plane_depth()).astype(np.uint16))
    view = read_depth_view(path, ",".join(map(str, K)), unit)
    assert len(view.points) == SIZE[1] * (SIZE[0] - 5)
    np.testing.assert_allclose(view.points[:, 2], 2 + 0.5 * view.points[:, 1], atol=1e-3)
    first = view.points[0]  # pixel (5, 0)
    assert first[:2] / first[2] == pytest.approx([(5 - K[2]) / K[0], -K[3] / K[1]])
    assert view.image.bounds.tolist()[:2] == [4.5, -0.5]
    assert ("taken as mm" in view.note) == (suffix in (".png", ".npz"))


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"fx": 300, "fy": 310, "cx": 81.5, "cy": 58.25}),
        json.dumps({"k": [300, 0, 81.5, 0, 310, 58.25, 0, 0, 1], "width": 160, "height": 120}),
        "height: 120\nwidth: 160\nk:\n- 300.0\n- 0.0\n- 81.5\n- 0.0\n- 310.0\n- 58.25\n- 0\n- 0\n- 1\n---\nheight: 3\n",
        "image_width: 160\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [300, 0, 81.5, 0, 310, 58.25, 0, 0, 1]\n",
        "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nP: [300, 0, 81.5, 0, 0, 310, 58.25, 0, 0, 0, 1, 0]\n",
        json.dumps({"intrinsic_matrix": [300, 0, 0, 0, 310, 0, 81.5, 58.25, 1], "width": 160, "height": 120}),
    ],
)
def test_cameras_are_read_as_others_write_them(tmp_path: Path, text: str) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(text)
    matrix = parse_intrinsics(str(path), SIZE).matrix
    assert (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]) == K


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("k: [300, 0, 80, 0, 300, 60, 0, 0, 1]\nwidth: 640\nheight: 480\n", "belongs to images of 640x480"),
        ("k: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n", "are not those of an image"),
        ("a: 1\n", "no camera matrix"),
        ("- 3\n", "no camera matrix"),
        ("{", "neither YAML nor JSON"),
        ("fx: wide\nfy: 3\ncx: 3\ncy: 3\n", "not numbers"),
    ],
)
def test_cameras_that_do_not_belong_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        parse_intrinsics(str(path), SIZE)


@pytest.mark.parametrize("given", ["1,2,3", "none.yaml", "a,b,c,d", "-1,300,80,60", "nan,300,80,60"])
def test_numbers_that_are_no_camera_are_refused(given: str) -> None:
    with pytest.raises(InputError):
        parse_intrinsics(given, SIZE)


def test_what_is_no_depth_is_refused(tmp_path: Path) -> None:
    def refuse(name: str, pixels: np.ndarray, says: str, unit: str = "auto") -> None:
        path = tmp_path / name
        if path.suffix == ".npy":
            np.save(path, pixels)
        else:
            cv2.imwrite(str(path), pixels)
        with pytest.raises(InputError, match=says):
            read_depth_view(path, "300,300,80,60", unit)

    refuse("zero.png", np.zeros((120, 160), np.uint16), "a depth at 0 of 19200 pixels")
    refuse("colour.png", np.zeros((120, 160, 3), np.uint8), "is a picture")
    refuse("grey.png", np.full((120, 160), 80, np.uint8), "8 bits a pixel")
    refuse("cloud.npy", np.zeros((120, 3), np.float32), "has rows and columns")
    refuse("nan.npy", np.full((120, 160), np.nan, np.float32), "a depth at 0 of")
    refuse("um.npy", np.full((120, 160), 2.5e6, np.float32), "about 2.5e[+]03 m if they are in mm")
    (tmp_path / "a.exr").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"convert it to .npy or a float .tiff"):
        read_depth_view(tmp_path / "a.exr", "300,300,80,60", "auto")
    np.savez(tmp_path / "two.npz", a=np.ones((120, 160)), b=np.ones((120, 160)))
    with pytest.raises(InputError, match="has the arrays a, b; call the depth image depth"):
        read_depth_view(tmp_path / "two.npz", "300,300,80,60", "auto")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InputError, match="not an image"):
        read_depth_view(tmp_path / "broken.png", "300,300,80,60", "auto")
    with pytest.raises(InputError, match="give --camera-info"):
        read_depth_view(tmp_path / "zero.png", None, "auto")


def test_colours_of_another_size_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(InputError, match="is 320x240, the depth 160x120"):
        read_colour(tmp_path / "c.png", SIZE)


def test_an_organised_cloud_tells_its_camera_and_colours(tmp_path: Path) -> None:
    depth = plane_depth()
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    points = np.stack([(u - K[2]) / K[0] * depth, (v - K[3]) / K[1] * depth, depth], axis=2)
    points[depth == 0] = np.nan
    red = np.where(u < 80, 200, 10).astype(np.uint32)
    rows = np.zeros(depth.size, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    rows["x"], rows["y"], rows["z"] = points.reshape(-1, 3).T
    rows["rgb"] = (red << 16 | 30 << 8 | 60).ravel()
    header = (
        "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {SIZE[0]}\nHEIGHT {SIZE[1]}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {depth.size}\nDATA binary\n"
    )
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header.encode() + rows.tobytes())
    view = read_organised(path, 1.0)
    assert view is not None and view.rgb is not None and view.up == "-y"
    np.testing.assert_allclose(view.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], K, rtol=1e-4)
    assert view.rgb[60, 79].tolist() == [200, 30, 60] and view.rgb[60, 80].tolist() == [10, 30, 60]
    path.write_bytes(header.replace(f"HEIGHT {SIZE[1]}", "HEIGHT 1").encode() + rows.tobytes())
    assert read_organised(path, 1.0) is None


@pytest.mark.slow
def test_people_in_depth_and_colours_get_their_bodies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The networks are replaced by the true joints, so that the test needs none."""
    source = BodySource()
    studio = RgbdStudio(source, sensor="tof")
    body = pose_motion(source, "waving", np.random.default_rng(4), 1, 15.0)[0]
    rng = np.random.default_rng(5)
    cameras = studio.place_cameras(rng, [body], "knees", np.array([1.0, 0.0, 0.0]))
    frame = studio.look(rng, [body], studio.furnish(rng, [body], cameras), cameras)
    cv2.imwrite(str(tmp_path / "d.png"), to_millimetres(frame.depth))
    cv2.imwrite(str(tmp_path / "c.png"), frame.rgb[:, :, ::-1])
    seen = frame.keypoints[0]

    class TrueJoints:
        def find(self, image: np.ndarray) -> list[FoundPerson]:
            assert image.shape == (480, 640, 3)
            return [FoundPerson(Keypoints(LIMB_JOINTS, seen.pixels, seen.confidence), 0.9)]

    monkeypatch.setattr(fit_depth, "are_installed", lambda: True)
    monkeypatch.setattr(fit_depth, "load_networks", lambda *_, **__: TrueJoints())
    camera = ("--camera-info", "525,525,319.5,239.5")
    arguments = (tmp_path / "d.png", *camera, "--color", tmp_path / "c.png", "--out", tmp_path / "o", *FAST)
    status, (summary,), _ = fitted(capsys, *arguments)
    assert status == 0 and len(summary["people"]) == 1
    with np.load(summary["people"][0]["output"]) as archive:
        names, joints = archive["joint_names"].tolist(), archive["joints"]
    truth = cameras.depth.to_camera(frame.joints[0])
    error = np.linalg.norm(joints[[names.index(name) for name in LIMB_JOINTS]] - truth, axis=1)
    assert error[frame.seen[0].visible].mean() < 0.05
    status, _, (sentence,) = fitted(capsys, tmp_path / "d.png", "--out", tmp_path / "o", *FAST)
    assert status == 2 and "give --camera-info" in sentence
