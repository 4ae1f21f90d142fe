# SPDX-License-Identifier: Apache-2.0
"""Outputs of the usual kinds of keypoint networks: YOLO-pose, MoveNet MultiPose, SimCC (RTMPose) and heat maps.

Each decoder takes the outputs of one run and returns people in pixels of the network's input.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Array
from flowing_puppet_ros.errors import InputError

type DecodedPerson = tuple[F64, F64, float]
"""Joints (K, 2) px of the input, their scores (K,), and the score of the person."""
type Decoder = Callable[[Sequence[Array], tuple[int, int], int], list[DecodedPerson]]
"""From the outputs, the size (width, height) of the input and the number K of joints to the people."""

MAX_OVERLAP = 0.65  # of the boxes of two people
MIN_BOX_SCORE = 0.05
QUARTER_PX = 0.25  # by which the place of a heat map's maximum is moved towards its larger neighbour


def decode_yolo(outputs: Sequence[Array], size: tuple[int, int], joints: int) -> list[DecodedPerson]:
    """Decode YOLO-pose: (1, 5 + 3K, N) or its transpose with box, score and (x, y, score) of each joint, in pixels."""
    rows = _squeeze(outputs[0], 2)
    width = 5 + 3 * joints
    if rows.shape[0] == width and rows.shape[1] != width:
        rows = rows.T
    _check_shape(rows.shape[1] == width, outputs[0], f"(1, {width}, N) for {joints} joints")
    rows = rows[np.isfinite(rows).all(axis=1) & (rows[:, 4] >= MIN_BOX_SCORE)]
    if not len(rows):
        return []
    corner = rows[:, :2] - rows[:, 2:4] / 2
    boxes = np.column_stack([corner, rows[:, 2:4]]).tolist()
    kept = cv2.dnn.NMSBoxes(boxes, rows[:, 4].tolist(), MIN_BOX_SCORE, MAX_OVERLAP)
    points = rows[:, 5:].reshape(len(rows), joints, 3)
    return [(points[k, :, :2], points[k, :, 2], float(rows[k, 4])) for k in np.asarray(kept).ravel()]


def decode_movenet(outputs: Sequence[Array], size: tuple[int, int], joints: int) -> list[DecodedPerson]:
    """Decode MoveNet: MultiPose (1, N, 3K + 5), or a single pose (1, 1, K, 3); (y, x, score) as shares of the input."""
    rows = _squeeze(outputs[0], 2)
    if rows.shape == (joints, 3):
        rows = np.concatenate([rows.ravel(), np.zeros(4), [rows[:, 2].mean()]])[None]
    _check_shape(rows.shape[1] == 3 * joints + 5, outputs[0], f"(1, N, {3 * joints + 5}) for {joints} joints")
    people = []
    for row in rows[np.isfinite(rows).all(axis=1) & (rows[:, -1] > 0)]:
        values = row[: 3 * joints].reshape(joints, 3)
        people.append((values[:, 1::-1] * size - 0.5, values[:, 2], float(row[-1])))
    return people


def decode_simcc(outputs: Sequence[Array], size: tuple[int, int], joints: int) -> list[DecodedPerson]:
    """Decode SimCC of one person: two outputs (1, K, B), distributions of x and of y over bins of the input's sides.

    What is no number counts as nothing.
    """
    _check_shape(len(outputs) == 2, outputs[0], "two outputs, of x and of y")
    across, down = (np.nan_to_num(_squeeze(output, 2), posinf=0.0) for output in outputs)
    for values, output in zip((across, down), outputs, strict=True):
        _check_shape(values.shape[0] == joints and values.size > 0, output, f"(1, {joints}, bins)")
    place = np.column_stack([
        np.argmax(values, axis=1) * side / values.shape[1]
        for values, side in zip((across, down), size, strict=True)
    ])  # fmt: skip
    score = np.clip(np.minimum(across.max(axis=1), down.max(axis=1)), 0.0, 1.0)
    return [(place, score, float(score.mean()))]


def decode_heat_maps(outputs: Sequence[Array], size: tuple[int, int], joints: int) -> list[DecodedPerson]:
    """Decode heat maps (1, K, h, w) of one person; what is no number counts as nothing."""
    maps = np.nan_to_num(_squeeze(outputs[0], 3), posinf=0.0)
    _check_shape(maps.shape[0] == joints and maps.size > 0, outputs[0], f"(1, {joints}, h, w)")
    height, width = maps.shape[1:]
    best = maps.reshape(joints, -1).argmax(axis=1)
    x, y = best % width, best // width
    rows = np.arange(joints)

    def towards(before: Array, after: Array) -> F64:
        return np.asarray(QUARTER_PX * np.sign(after - before), np.float64)

    side = towards(maps[rows, y, np.maximum(x - 1, 0)], maps[rows, y, np.minimum(x + 1, width - 1)])
    down = towards(maps[rows, np.maximum(y - 1, 0), x], maps[rows, np.minimum(y + 1, height - 1), x])
    place = (np.column_stack([x + side, y + down]) + 0.5) * (size[0] / width, size[1] / height) - 0.5
    score = np.clip(maps.reshape(joints, -1).max(axis=1), 0.0, 1.0)
    return [(place, score, float(score.mean()))]


DECODERS: dict[str, Decoder] = {
    "yolo": decode_yolo,
    "movenet": decode_movenet,
    "simcc": decode_simcc,
    "heatmap": decode_heat_maps,
}
ONE_PERSON = ("simcc", "heatmap")
"""Decoders of networks that see one person at a time, in a box that somebody has found."""


def _squeeze(values: Array, dimensions: int) -> F64:
    """Return an output without its first sides of 1, down to a number of dimensions; InputError where it has others."""
    found = np.asarray(values, np.float64)
    while found.ndim > dimensions and found.shape[0] == 1:
        found = found[0]
    _check_shape(found.ndim == dimensions, values, f"{dimensions} sides after the first")
    return found


def _check_shape(right: bool, values: Array, expected: str) -> None:
    if not right:
        raise InputError(
            f"the network's output has shape {np.shape(values)}; this decoder needs {expected}: check `decoder` and"
            " `joints` in its description"
        )
