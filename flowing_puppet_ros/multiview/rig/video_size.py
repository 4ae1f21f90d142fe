# SPDX-License-Identifier: Apache-2.0
"""A camera's calibration for a video that was scaled or cropped after the calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rig.rig import RigCamera

_SAME_SHAPE = 0.005  # relative difference of the sides' ratios of a scaled video
_MAX_CROP = 0.1  # of a side


def fit_to_video(
    name: str,
    each: RigCamera,
    size: tuple[int, int],
    crop: tuple[float, float] | None,
    note: Callable[[str], None],
) -> Camera:
    """Return the camera for frames of `size` (width, height) px.

    `crop` has the columns and rows that the video lost on the left and at the top; None: on both sides alike, which is
    told to `note`. InputError when the sizes have nothing to do with one another.
    """
    camera, calibrated = each.camera, each.camera.size
    if not each.has_size:
        return replace(camera, size=size)
    if crop is not None:
        return _crop(camera, crop, size)
    if calibrated == size:
        return camera
    here, there = f"{size[0]}x{size[1]}", f"{calibrated[0]}x{calibrated[1]}"
    if abs(size[0] * calibrated[1] / (size[1] * calibrated[0]) - 1) < _SAME_SHAPE:
        note(f"the video of {name} is {here} and its calibration for {there}: it is taken as scaled")
        return camera.resize(size)
    lost = [was - now for was, now in zip(calibrated, size, strict=True)]
    if all(0 <= gone <= _MAX_CROP * was for gone, was in zip(lost, calibrated, strict=True)):
        note(
            f"the video of {name} is {here} and its calibration for {there}: it is taken as cropped on both sides; "
            f"--crop {name}=LEFT,TOP says otherwise"
        )
        return _crop(camera, (lost[0] / 2, lost[1] / 2), size)
    turned = " (is the video turned?)" if calibrated == size[::-1] else ""
    raise InputError(
        f"the video of {name} is {here} and its calibration for {there}{turned}: they do not belong together"
    )


def _crop(camera: Camera, crop: tuple[float, float], size: tuple[int, int]) -> Camera:
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= crop
    return replace(camera, matrix=matrix, size=size)
