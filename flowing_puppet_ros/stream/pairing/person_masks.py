# SPDX-License-Identifier: Apache-2.0
"""Label images that say who is where in an image: those of the puppets' own network, or of any other segmentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.fusion.puppet_joints import PuppetJoints
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.stream.messages.images import decode_labels

MIN_CONFIDENCE = 0.3  # of a joint that tells which label is a person's
MIN_SHARE = 0.5  # of these joints that have one label, from which on it is the person's
MAX_SHAPE_RATIO = 1.05  # between the shapes of the label image and the camera's, which are of one picture


def add_masks(puppets: Sequence[PuppetJoints], message: Any, size: tuple[int, int]) -> list[PuppetJoints]:
    """Return the puppets of an image of `size` (width, height) with their masks, by the label image of that image.

    In it 0 is nobody, and every other value one person; whose it is, most joints tell. It may be smaller than the
    image.

    Raises:
        InputError: when it is no label image, or of another camera.
    """
    labels = decode_labels(message)
    ratio = labels.shape[1] / labels.shape[0] / (size[0] / size[1])
    if not 1 / MAX_SHAPE_RATIO < ratio < MAX_SHAPE_RATIO:
        raise InputError(
            f"a label image of {labels.shape[1]}x{labels.shape[0]} on person_masks is not of the {size[0]}x{size[1]}"
            " image of puppets/camera_info: people are used without it; remap the one that belongs to them"
        )
    found = []
    for puppet in puppets:
        label = _find_label(labels, puppet, size)
        mask = None if label == 0 else PersonMask.of_grid(np.where(labels == label, np.uint8(255), np.uint8(0)), size)
        found.append(replace(puppet, mask=mask))
    return found


def _find_label(labels: U8, puppet: PuppetJoints, size: tuple[int, int]) -> int:
    """Return the label of most of a puppet's joints, 0 without one."""
    places = puppet.pixels[puppet.known & (puppet.confidence >= MIN_CONFIDENCE)]
    height, width = labels.shape
    cells = np.floor((places + 0.5) * (width / size[0], height / size[1])).astype(np.int64)
    inside = ((cells >= 0) & (cells < (width, height))).all(axis=1)
    column, row = cells[inside].T
    count = np.bincount(labels[row, column], minlength=2)
    count[0] = 0
    label = int(count.argmax())
    return label if count[label] and count[label] >= MIN_SHARE * len(column) else 0
