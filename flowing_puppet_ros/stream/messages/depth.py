# SPDX-License-Identifier: Apache-2.0
"""Depth images and their camera_info to point clouds, to which bodies are fitted."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F32
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.camera_info import describe_images
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.images import decode_depth
from flowing_puppet_ros.stream.messages.message_types import MessageFactory

MAX_POINTS = 80_000
"""Maximum points of a depth image: every n-th pixel of every n-th row is taken, with n as small as possible."""


def back_project(depth: F32, info: Any) -> F32:
    """Return the points (N, 3) in metres of the known pixels of a depth image; see `back_project_image`."""
    points = back_project_image(depth, info)
    return points[np.isfinite(points[:, :, 2])]


def back_project_image(depth: F32, info: Any) -> F32:
    """Return the points (h, w, 3) in metres of `depth` (H, W), metres, NaN unknown, in the camera's optical frame.

    The image is rectified, as REP-118 images are: pixel (u, v) at depth z lies at ((u - cx) z / fx, (v - cy) z / fy, z)
    with the projection matrix `p` of the CameraInfo, or its `k` when `p` is not given. x is right, y down, z forward
    (REP-103). Of a large image every n-th pixel of every n-th row is taken. InputError if the camera is not calibrated,
    or calibrated for another image size.
    """
    height, width = depth.shape
    info = describe_images(info, (width, height))
    if (int(info.width), int(info.height)) != (width, height):
        raise InputError(
            f"the depth image is {width}x{height}, its camera_info says {info.width}x{info.height}: publish the"
            " camera_info of these images, as image_proc's resize does"
        )
    fx, fy, cx, cy = _read_pinhole(info)
    step = max(1, math.ceil(math.sqrt(width * height / MAX_POINTS)))
    rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    z = depth[np.ix_(rows, columns)]
    right = ((columns - cx) / fx).astype(np.float32)[None, :] * z
    down = ((rows - cy) / fy).astype(np.float32)[:, None] * z
    return np.stack([right, down, z], axis=2)


def _read_pinhole(info: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in pixels from the projection matrix or else the camera matrix."""
    k, p = np.asarray(info.k, float).reshape(-1), np.asarray(info.p, float).reshape(-1)
    values = (p[0], p[5], p[2], p[6]) if p[0] or p[5] else (k[0], k[4], k[2], k[5])
    fx, fy, cx, cy = (float(value) for value in values)
    if not (fx or fy):
        raise InputError("the camera_info is uncalibrated (k and p are all zero); publish a calibrated camera_info")
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or fx <= 0 or fy <= 0:
        raise InputError(
            f"the camera_info has the focal lengths {fx:g} and {fy:g}, which are not those of a pinhole camera"
        )
    return fx, fy, cx, cy


def make_depth_cloud(factory: MessageFactory, image: Any, info: Any) -> Any:
    """Return the organised PointCloud2 message of a depth Image and its CameraInfo; InputError if that is None."""
    if info is None:
        raise InputError("no camera_info came yet: a depth image cannot be used without it; publish or remap it")
    return make_cloud(factory, image.header, back_project_image(decode_depth(image), info))
