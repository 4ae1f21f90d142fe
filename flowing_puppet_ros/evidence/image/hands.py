# SPDX-License-Identifier: Apache-2.0
"""Hand detectors by appearance and by motion (thesis, video chapter, "Image Likelihood", Figs. 6 and 7).

Two linear SVMs score oriented boxes at the wrist: one on HOG of the image and the skin ratio of each cell, one on HOG
of the optical flow's gradient magnitude and the motion of each cell. A box is a grid of cells that rotates with the
forearm; left and right hands share a filter. The map of a detector is the maximum over orientations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, F64, Array, Flow
from flowing_puppet_ros.evidence.image.features import (
    CHANNELS,
    LEVELS_PER_OCTAVE,
    ORDERS,
    OrientationMap,
    orientation_map,
)
from flowing_puppet_ros.evidence.image.likelihood import ImageEvidence
from flowing_puppet_ros.model import weights

CELL_METRES = 0.04  # side of a cell
ALONG, ACROSS = np.arange(-2, 5), np.arange(-2, 3)
"""Cells of a box along the forearm, from the wrist towards the fingertips, and across it."""

EXTRAS = {"image": ("skin",), "flow": ("gradient", "speed")}
"""Values of a cell besides its HOG descriptor: the mean log ratio of skin; the flow's gradient and speed, in [0, 1]."""

LENGTH = {kind: len(ALONG) * len(ACROSS) * (CHANNELS + len(extras)) for kind, extras in EXTRAS.items()}
"""Values of a descriptor."""

ORIENTATIONS = 12  # of a box, over which a map takes the maximum
MAP_PITCH_M = 0.03  # between the positions of a map
MIN_FOREARM_M = 0.05  # a forearm that appears shorter has no direction
_GRADIENT_SCALE = 0.25  # px/px per frame at which the flow's gradient counts 63 %
SPEED_SCALE_M = 0.06  # per frame, relative to the background, at which the speed counts 63 %


@dataclass(frozen=True, slots=True, eq=False)
class HandField:
    """Input of one detector: an orientation map, and the `extras` (h, w, S) of each of its pixels."""

    level: OrientationMap
    extras: F32

    @classmethod
    def of_image(cls, evidence: ImageEvidence, scale: float) -> Self:
        """Compute HOG and skin of an image in which the person has `scale` px/m."""
        number = int(evidence.features.find_levels(np.array(CELL_METRES * scale)))
        level = evidence.features.level(number)
        skin = _pool(evidence.skin.values.astype(np.float32), level)
        return cls(level, skin[..., None])

    @classmethod
    def of_flow(cls, flows: Sequence[Flow], scale: float) -> Self:
        """Compute HOG of the gradient magnitude, and motion, of the `flows` (H, W, 2) px from one image."""
        motions = [_measure_motion(flow, scale) for flow in flows]
        gradient, speed = np.mean(motions, axis=0)
        factor = 2.0 ** (-round(LEVELS_PER_OCTAVE * np.log2(max(CELL_METRES * scale, 2.0) / 4.0)) / LEVELS_PER_OCTAVE)
        level = orientation_map(np.repeat(255 * gradient[..., None], 3, axis=2), factor)
        return cls(level, np.stack([_pool(gradient, level), _pool(speed, level)], axis=2))

    def describe(self, wrist: F64, angle: F64, cell: float) -> F32:
        """Describe boxes at `wrist` (N, 2) px that point along `angle` (N,) rad, with cells of `cell` px, as (N, D)."""
        size = self.level.values.shape[2] + self.extras.shape[2]
        out = np.zeros((len(wrist), len(ALONG) * len(ACROSS), size), np.float32)
        places = np.ascontiguousarray(np.nan_to_num(wrist), np.float64)
        _describe(self.level.values, self.extras, *self.level.scale, places, np.asarray(angle, float), cell, out)
        return out.reshape(len(wrist), len(ALONG) * len(ACROSS) * size)


def _measure_motion(flow: Flow, scale: float) -> tuple[F32, F32]:
    """Return a flow's gradient magnitude and its speed relative to the background, each (H, W) in [0, 1]."""
    known = np.nan_to_num(flow)
    vertical, horizontal = np.gradient(known, axis=(0, 1))
    gradient = np.sqrt((vertical**2 + horizontal**2).sum(axis=2))
    beside = known - np.median(known.reshape(-1, 2), axis=0)
    speed = np.hypot(beside[..., 0], beside[..., 1]) / (SPEED_SCALE_M * scale)
    return (1 - np.exp(-gradient / _GRADIENT_SCALE)).astype(np.float32), (1 - np.exp(-speed)).astype(np.float32)


def _pool(values: F32, level: OrientationMap) -> F32:
    """Resize a map `values` (H, W) to a level's resolution, each pixel the mean of about a cell."""
    height, width = level.values.shape[:2]
    small = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 1.6, borderType=cv2.BORDER_REPLICATE)).reshape(height, width)


@njit(cache=True, nogil=True)
def _describe(
    values: F32, extras: F32, to_x: float, to_y: float, wrist: F64, angle: F64,
    cell: float, out: F32,
) -> None:  # fmt: skip
    height, width = values.shape[:2]
    across = len(ACROSS)
    for n in range(len(wrist)):
        cosine, sine = np.cos(angle[n]), np.sin(angle[n])
        turn_re, turn_im = np.float32(np.cos(2 * angle[n])), np.float32(-np.sin(2 * angle[n]))
        for k in range(out.shape[1]):
            a, b = cell * ALONG[k // across], cell * ACROSS[k % across]
            x = (wrist[n, 0] + a * cosine - b * sine + 0.5) * to_x - 0.5
            y = (wrist[n, 1] + a * sine + b * cosine + 0.5) * to_y - 0.5
            if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
                continue
            x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
            left, top = int(x), int(y)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            fx, fy = np.float32(x - left), np.float32(y - top)
            one = np.float32(1.0)
            w00, w10, w01, w11 = (one - fx) * (one - fy), fx * (one - fy), (one - fx) * fy, fx * fy
            for m in range(CHANNELS):
                out[n, k, m] = (
                    w00 * values[top, left, m] + w10 * values[top, right, m]
                    + w01 * values[bottom, left, m] + w11 * values[bottom, right, m]
                )  # fmt: skip
            for m in range(extras.shape[2]):
                out[n, k, CHANNELS + m] = (
                    w00 * extras[top, left, m] + w10 * extras[top, right, m]
                    + w01 * extras[bottom, left, m] + w11 * extras[bottom, right, m]
                )  # fmt: skip
            re, im = turn_re, turn_im
            for order in range(ORDERS):
                p, q = out[n, k, 2 * order + 1], out[n, k, 2 * order + 2]
                out[n, k, 2 * order + 1], out[n, k, 2 * order + 2] = p * re - q * im, p * im + q * re
                re, im = re * turn_re - im * turn_im, re * turn_im + im * turn_re


def mirror(descriptors: F32) -> F32:
    """Mirror `descriptors` (N, D) of boxes along the forearm: a left hand's become a right hand's."""
    cells = descriptors.reshape(len(descriptors), len(ALONG), len(ACROSS), -1)[:, :, ::-1].copy()
    cells[..., 2:CHANNELS:2] *= -1
    return cells.reshape(descriptors.shape)


@dataclass(frozen=True, slots=True, eq=False)
class HandFilter:
    """A linear SVM over a box: `weight` (D,) and `bias`; `odds` (2,) turn its margin into the log odds of a hand."""

    weight: F32
    bias: float
    odds: tuple[float, float]

    def margin(self, descriptors: F32) -> F64:
        """Return the SVM's output (N,) for `descriptors` (N, D)."""
        return np.asarray(descriptors @ self.weight + self.bias, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class HandDetectors:
    """Both filters, and how their margins combine: `joint` (3,) are the weights of image and flow, and a bias."""

    filters: Mapping[str, HandFilter]
    joint: F64

    @classmethod
    def load(cls, name: str = "upper") -> Self:
        """Load the shipped detectors; InputError if there are none of that name."""
        return cls.from_arrays(weights.load("hands", name))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Self:
        """Build from the arrays that `to_arrays` returns."""
        filters = {}
        for kind in EXTRAS:
            bias, slope, offset = (float(value) for value in arrays[f"{kind}_odds"])
            filters[kind] = HandFilter(np.asarray(arrays[f"{kind}_weight"], np.float32), bias, (slope, offset))
        return cls(filters, np.asarray(arrays["joint"], np.float64))

    def to_arrays(self) -> dict[str, F32]:
        """Return the arrays for an .npz file."""
        arrays = {"joint": self.joint.astype(np.float32)}
        for kind, known in self.filters.items():
            arrays[f"{kind}_weight"] = known.weight.astype(np.float32)
            arrays[f"{kind}_odds"] = np.array([known.bias, *known.odds], np.float32)
        return arrays


@dataclass(frozen=True, slots=True, eq=False)
class HandMaps:
    """Evidence for hands in one image in which the person has `scale` px/m; without flow, by appearance alone.

    `fields` by kind ("image", "flow") are in the pixels of a crop: `corner` (2,) is its position in the image in whose
    pixels wrists are given, and `factor` its pixels per pixel of that image.
    """

    detectors: HandDetectors
    fields: Mapping[str, HandField]
    scale: float
    corner: F64
    factor: float = 1.0

    @classmethod
    def of(
        cls,
        detectors: HandDetectors,
        evidence: ImageEvidence,
        flows: Sequence[Flow],
        scale: float,
        corner: F64 | None = None,
        factor: float = 1.0,
    ) -> Self:
        """Compute the maps of a crop; `flows` (H, W, 2) from it are on its grid and, like `scale`, in its pixels."""
        fields = {"image": HandField.of_image(evidence, scale)}
        if flows:
            fields["flow"] = HandField.of_flow(flows, scale)
        return cls(detectors, fields, scale, np.zeros(2) if corner is None else corner, factor)

    def log_odds(self, kind: str, wrist: F64, angle: F64) -> F64:
        """Return one detector's log odds (N,) of hands at `wrist` (N, 2) px along `angle` (N,); 0 without a field."""
        if kind not in self.fields:
            return np.zeros(len(wrist))
        slope, offset = self.detectors.filters[kind].odds
        return slope * self._margin(kind, wrist, angle) + offset

    def score(self, wrist: F64, angle: F64) -> F64:
        """Return the log odds (N,) of hands by both detectors together."""
        if "flow" not in self.fields:
            return self.log_odds("image", wrist, angle)
        image, flow, bias = self.detectors.joint
        return image * self._margin("image", wrist, angle) + flow * self._margin("flow", wrist, angle) + bias

    def _margin(self, kind: str, wrist: F64, angle: F64) -> F64:
        inside = (np.asarray(wrist, np.float64) - self.corner) * self.factor
        described = self.fields[kind].describe(inside, angle, CELL_METRES * self.scale)
        return self.detectors.filters[kind].margin(described)

    def best_orientation(self, kind: str, places: F64) -> tuple[F64, F64]:
        """Return the maximum log odds (N,) over box orientations at `places` (N, 2) px, and the angles (N,) rad."""
        turns = np.arange(ORIENTATIONS) * (2 * np.pi / ORIENTATIONS)
        odds = np.stack([self.log_odds(kind, places, np.full(len(places), turn)) for turn in turns])
        return odds.max(axis=0), np.asarray(turns[odds.argmax(axis=0)], np.float64)


def hand_score(maps: HandMaps, wrist: F64, elbow: F64, scale: float) -> F64:
    """Return the log odds (N,) of hands at forearms from `elbow` (N, 2) to `wrist` (N, 2) px; `scale` in px/m.

    They are relative to as many random positions near a person. A forearm that points at the camera may have its hand
    in any direction. 0 where a position is not finite.
    """
    wrist, elbow = np.asarray(wrist, np.float64), np.asarray(elbow, np.float64)
    along = wrist - elbow
    known = np.isfinite(along).all(axis=1)
    angle = np.arctan2(np.where(known, along[:, 1], 0.0), np.where(known, along[:, 0], 1.0))
    score = maps.score(wrist, angle)
    short = known & (np.hypot(along[:, 0], along[:, 1]) < MIN_FOREARM_M * scale)
    if short.any():
        turns = np.arange(ORIENTATIONS) * (2 * np.pi / ORIENTATIONS)
        score[short] = np.max([maps.score(wrist[short], np.full(short.sum(), turn)) for turn in turns], axis=0)
    return np.where(known, score, 0.0)
