# SPDX-License-Identifier: Apache-2.0
"""Files of depth images and organised clouds: every point with its pixel and the camera that saw it.

A depth image is a 16-bit PNG, TIFF or PGM, a TIFF or PFM of floats, or a two-dimensional .npy or .npz; its camera comes
as `fx,fy,cx,cy` or in a file with the fields of a CameraInfo, as `ros2 topic echo --once` prints them or as a
calibration's YAML. An organised .pcd, one with several rows, tells its camera itself.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.body.scans.formats.pcd import read_pcd
from flowing_puppet_ros.body.scans.names import UNITS
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.range_image import RangeImage
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorProjection
from flowing_puppet_ros.multiview.camera import Camera

IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".pfm", ".exr")
"""Of files that are depth images and nothing else."""

MAX_DEPTH_M = 20.0  # beyond, no camera measures people
MIN_DEPTHS = 200  # known ones, of an image that may show somebody
MAX_INFO_BYTES = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """What a depth camera saw.

    Attributes:
        points: (N, 3) metres in the camera's frame, where the depth is known.
        camera: projects points of that frame.
        image: the range image of the points.
        rgb: (H, W, 3) the colours of the same pixels, or None.
        up: name of the axis of the frame that points up while the camera is level.
        note: what was supposed, a sentence for the user; empty if nothing.
    """

    points: F64
    camera: Camera
    image: RangeImage
    rgb: U8 | None
    up: str
    note: str = ""

    def paint(self, rgb: U8) -> DepthView:
        """Return the view with the colours (H, W, 3) of its pixels."""
        return replace(self, rgb=rgb)

    def turn_camera(self, rotation: F64) -> Camera:
        """Return the camera for points that `rotation` (3, 3) has turned."""
        return replace(self.camera, rotation=self.camera.rotation @ rotation.T)


def is_depth_image(path: Path, has_camera: bool) -> bool:
    """Return whether a file is read as a depth image: by its suffix or, for arrays, because its camera is given."""
    suffix = path.suffix.lower()
    return suffix in IMAGE_SUFFIXES or (suffix in (".npy", ".npz") and has_camera)


def read_depth_view(path: Path, intrinsics: str | None, unit: str) -> DepthView:
    """Read a depth image; `intrinsics` are numbers or a file, see `parse_intrinsics`, `unit` a unit of depth or auto.

    Raises:
        InputError: when file or camera cannot be used, or the image holds no depth.
    """
    if intrinsics is None:
        raise InputError(f"{path} is a depth image; give --camera-info, a file or fx,fy,cx,cy in pixels")
    depth = _read_pixels(path)
    height, width = depth.shape
    camera = parse_intrinsics(intrinsics, (width, height))
    name = _guess_unit(depth) if unit == "auto" else unit
    metres = depth.astype(np.float64) * UNITS[name]
    with np.errstate(invalid="ignore"):
        known = np.isfinite(metres) & (metres > 0)
    if np.count_nonzero(known) < MIN_DEPTHS:
        raise InputError(
            f"{path} has a depth at {np.count_nonzero(known)} of {depth.size} pixels, too few for a person"
        )
    middle = float(np.median(metres[known]))
    if not 0.1 <= middle <= MAX_DEPTH_M:
        raise InputError(f"the depths of {path} are about {middle:.3g} m if they are in {name}; name --unit")
    known &= metres < MAX_DEPTH_M
    rows, columns = np.nonzero(known)
    plane = camera.undistort(np.stack([columns, rows], axis=1).astype(np.float64))
    z = metres[rows, columns]
    points = np.concatenate([plane * z[:, None], z[:, None]], axis=1)
    k = camera.matrix
    projection = SensorProjection.pinhole(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    image = RangeImage.of_camera(projection, points, rows * width + columns, (height, width))
    note = (
        f"the depths of {path} were taken as {name}; name --unit if they are not"
        if unit == "auto" and name == "mm"
        else ""
    )
    return DepthView(points, camera, image, None, "-y", note)


def read_organised(path: Path, metres: float) -> DepthView | None:
    """Read an organised .pcd whose unit is so many metres; None for another cloud, or where no pinhole camera fits."""
    cloud = read_pcd(path)
    shape = cloud.shape
    if min(shape) < 2:
        return None
    points = metres * cloud.points
    pixel = np.flatnonzero(np.isfinite(points).all(axis=1) & points.any(axis=1))
    image = RangeImage.of_organised(points[pixel], pixel, shape)
    if image is None:
        return None
    scale, offset, axes = image.projection.scale, image.projection.offset, image.projection.axes
    matrix = [scale[0], 0, offset[0], 0, scale[1], offset[1], 0, 0, 1]
    camera = Camera.from_info(matrix, (), shape[1], shape[0], axes, np.zeros(3))
    rgb = None if cloud.rgb is None else cloud.rgb.reshape((*shape, 3))
    return DepthView(points[pixel], camera, image, rgb, "-y" if np.allclose(axes, np.eye(3)) else "z")


def read_colour(path: Path, size: tuple[int, int]) -> U8:
    """Read the colour image (H, W, 3) RGB that belongs to a depth image of `size` (width, height)."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB) if path.is_file() else None
    if image is None:
        raise InputError(f"{path} cannot be read as an image; give --color the colour image of the same camera")
    if image.shape[1::-1] != tuple(size):
        raise InputError(
            f"the colour image {path} is {image.shape[1]}x{image.shape[0]}, the depth {size[0]}x{size[1]}; register the"
            " depth to the colour image first"
        )
    return np.asarray(image, np.uint8)


def parse_intrinsics(given: str, size: tuple[int, int]) -> Camera:
    """Return the camera of an image of `size` (width, height) from `fx,fy,cx,cy` px or from a file (YAML or JSON).

    The file has the fields of a CameraInfo (`k` or `K` or `camera_matrix`, `width`, `height`, `d`), or `fx`, `fy`,
    `cx` and `cy`. Depth images are rectified, so the projection matrix `p` counts where it is given, without the lens.

    Raises:
        InputError: when it is neither, or belongs to images of another size.
    """
    words = given.split(",")
    if len(words) == 4:
        try:
            fx, fy, cx, cy = (float(word) for word in words)
        except ValueError:
            raise InputError(f"--camera-info {given} is not four numbers fx,fy,cx,cy") from None
        return _make_pinhole((fx, fy, cx, cy), size, given)
    data = _read_info(Path(given))
    told = (_find(data, "width", "image_width"), _find(data, "height", "image_height"))
    if None not in told and (int(told[0]), int(told[1])) != size:
        raise InputError(f"{given} belongs to images of {told[0]}x{told[1]}, the depth image is {size[0]}x{size[1]}")
    if all(name in data for name in ("fx", "fy", "cx", "cy")):
        return _make_pinhole(tuple(data[name] for name in ("fx", "fy", "cx", "cy")), size, given)
    p = _list_numbers(_find(data, "p", "P", "projection_matrix"))
    k = _list_numbers(_find(data, "k", "K", "camera_matrix", "intrinsic_matrix"))
    if len(p) == 12 and p[0]:
        return _make_pinhole((p[0], p[5], p[2], p[6]), size, given)
    if len(k) != 9:
        raise InputError(f"{given} has no camera matrix; wanted is a CameraInfo with k, or fx, fy, cx and cy")
    if _find(data, "intrinsic_matrix") is not None and k[6]:  # Open3D writes it column by column
        k = list(np.reshape(k, (3, 3)).T.ravel())
    return _make_pinhole((k[0], k[4], k[2], k[5]), size, given)


def _make_pinhole(values: Any, size: tuple[int, int], given: str) -> Camera:
    try:
        fx, fy, cx, cy = (float(value) for value in values)
    except (TypeError, ValueError):
        raise InputError(f"{given} has intrinsics that are not numbers: {values}") from None
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0 and -size[0] < cx < 2 * size[0]):
        raise InputError(
            f"the intrinsics {fx:g},{fy:g},{cx:g},{cy:g} are not those of an image of {size[0]}x{size[1]} pixels"
        )
    return Camera.from_info([fx, 0, cx, 0, fy, cy, 0, 0, 1], (), *size, np.eye(3), np.zeros(3))


def _read_info(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > MAX_INFO_BYTES:
            raise InputError(f"{path} is too large for a camera_info")
        # `ros2 topic echo` ends a message with a line of dashes: the first one is taken.
        text = path.read_text("utf8").strip().removeprefix("---").split("\n---")[0]
        data = YAML(typ="safe", pure=True).load(text)
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}; give --camera-info a file or fx,fy,cx,cy"
        ) from error
    except (YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is neither YAML nor JSON; give the fields of a CameraInfo") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} has no camera matrix; wanted is a CameraInfo with k, or fx, fy, cx and cy")
    return data


def _find(data: Mapping[str, Any], *names: str) -> Any:
    return next((data[name] for name in names if data.get(name) is not None), None)


def _list_numbers(value: Any) -> list[float]:
    """Return the numbers of a list, of rows, or of the `data` of a calibration's matrix; none of anything else."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        return [float(each) for each in np.asarray(value, dtype=np.float64).ravel()] if value is not None else []
    except (TypeError, ValueError):
        return []


def _guess_unit(depth: np.ndarray) -> str:
    """Return mm for whole numbers, and for others whose middle is no distance in metres at which people are seen."""
    if depth.dtype.kind in "ui":
        return "mm"
    known = depth[np.isfinite(depth) & (depth > 0)]
    return "mm" if len(known) and np.median(known) > MAX_DEPTH_M else "m"


def _read_pixels(path: Path) -> np.ndarray:
    """Return the pixels (H, W) of a depth image as they are."""
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file; give a depth image")
    if path.suffix.lower() in (".npy", ".npz"):
        pixels = _load_array(path)
    else:
        image = None
        with suppress(cv2.error):  # not every OpenCV reads .exr
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None and path.suffix.lower() == ".exr":
            raise InputError(f"{path} is not read by this OpenCV; convert it to .npy or a float .tiff, in metres")
        if image is None:
            raise InputError(f"{path} is not an image, or damaged; give a 16-bit depth image")
        pixels = image
        if pixels.ndim == 3:
            raise InputError(f"{path} is a picture, not depth; give the 16-bit depth image, and this one as --color")
        if pixels.dtype == np.uint8:
            raise InputError(f"{path} has 8 bits a pixel, which is a picture of depth; give the 16-bit depth image")
    pixels = np.squeeze(pixels)
    if pixels.ndim != 2 or pixels.dtype.kind not in "uif" or min(pixels.shape) < 16:
        raise InputError(f"{path} holds {pixels.dtype} of shape {pixels.shape}; a depth image has rows and columns")
    return np.asarray(pixels)


def _load_array(path: Path) -> np.ndarray:
    """Return the array of a .npy, or the one of a .npz that is called depth or has no other beside it."""
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            if not isinstance(loaded, np.lib.npyio.NpzFile):
                return np.asarray(loaded)
            name = "depth" if "depth" in loaded.files or len(loaded.files) != 1 else loaded.files[0]
            if name not in loaded.files:
                raise InputError(f"{path} has the arrays {', '.join(loaded.files)}; call the depth image depth")
            return np.asarray(loaded[name])
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as an array: {error}") from error
