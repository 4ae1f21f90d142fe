# SPDX-License-Identifier: Apache-2.0
"""Draw 2D puppets over an image: translucent parts in depth order, outlines, joints with confidence, part labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.draw.palette import joint_colour, part_colours

FIXED_BITS = 4  # fractional bits of coordinates: cv2 draws at 1/16 pixel
MAX_COORDINATE_PX = 1e6  # parts and joints beyond are not drawn
FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPuppet:
    """A puppet to draw, in pixels of the image; points that are NaN are left out."""

    id: str
    joint_names: tuple[str, ...]
    joints: np.ndarray  # (J, 2)
    confidence: np.ndarray  # (J,) in [0, 1]
    part_names: tuple[str, ...]
    contours: tuple[np.ndarray, ...]  # (K_i, 2) per part, closed
    order: tuple[int, ...]  # part indices, far to near

    @classmethod
    def from_message(cls, puppet: Any) -> DrawnPuppet:
        """Make it from a message with the fields of flowing_puppet_msgs/Puppet."""
        parts = list(puppet.parts)
        return cls(
            puppet.id,
            tuple(joint.name for joint in puppet.joints),
            np.array([(joint.x, joint.y) for joint in puppet.joints], float).reshape(-1, 2),
            np.array([joint.confidence for joint in puppet.joints], float),
            tuple(part.name for part in parts),
            tuple(np.asarray(part.contour, float).reshape(-1, 2) for part in parts),
            tuple(sorted(range(len(parts)), key=lambda index: (parts[index].depth, index))),
        )

    def transform(self, factor: float, corner: tuple[float, float] = (0.0, 0.0)) -> DrawnPuppet:
        """Return the puppet in an image cropped at pixel `corner` (x, y) and resized by `factor` as in cv2.resize."""

        def move(points: np.ndarray) -> np.ndarray:
            return (points - np.asarray(corner)) * factor + (factor - 1) / 2

        contours = tuple(move(contour) for contour in self.contours)
        return replace(self, joints=move(self.joints), contours=contours)


def draw_puppets(
    image: np.ndarray, puppets: Iterable[DrawnPuppet], *, opacity: float = 0.45, labels: bool = True
) -> np.ndarray:
    """Draw puppets over a copy of `image` (H, W, 3) or (H, W) uint8; return an RGB image (H, W, 3).

    `opacity` is that of the filled parts; `labels` adds the id and the names of the parts beside each puppet.
    """
    canvas = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image.copy()
    width = max(1, round(min(canvas.shape[:2]) / 360))
    for puppet in puppets:
        _draw_parts(canvas, puppet, opacity, width)
        _draw_joints(canvas, puppet, width)
        if labels:
            _draw_labels(canvas, puppet, width)
    return canvas


def is_drawable(contour: np.ndarray) -> bool:
    """Return whether `contour` (K, 2) is a finite polygon in or near an image."""
    return len(contour) >= 3 and bool(np.isfinite(contour).all()) and float(np.abs(contour).max()) < MAX_COORDINATE_PX


def to_fixed_point(points: np.ndarray) -> np.ndarray:
    """Return pixels as the fixed-point integers that cv2 draws with FIXED_BITS."""
    return np.rint(points * (1 << FIXED_BITS)).astype(np.int32)


def _crop(canvas: np.ndarray, points: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of the canvas (a view) within `margin` of the points, and its top left corner (x, y)."""
    size = np.array(canvas.shape[1::-1])
    low = np.clip(np.floor(points.min(axis=0) - margin), 0, size).astype(int)
    high = np.clip(np.ceil(points.max(axis=0) + margin) + 1, 0, size).astype(int)
    return canvas[low[1] : high[1], low[0] : high[0]], low


def _draw_parts(canvas: np.ndarray, puppet: DrawnPuppet, opacity: float, width: int) -> None:
    order = [index for index in puppet.order if is_drawable(puppet.contours[index])]
    if not order:
        return
    colours = part_colours(puppet.part_names)
    view, corner = _crop(canvas, np.vstack([puppet.contours[index] for index in order]), 2 * width)
    if view.size == 0:
        return
    layer = view.copy()
    for index in order:
        outline = to_fixed_point(puppet.contours[index] - corner)
        colour = tuple(int(value) for value in colours[index])
        dark = tuple(value * 2 // 5 for value in colour)
        cv2.fillPoly(layer, [outline], colour, cv2.LINE_AA, FIXED_BITS)
        cv2.polylines(layer, [outline], True, dark, width + 1, cv2.LINE_AA, FIXED_BITS)
    cv2.addWeighted(layer, opacity, view, 1 - opacity, 0, dst=layer)
    for index in order:
        colour = tuple(int(value) for value in colours[index])
        cv2.polylines(
            layer, [to_fixed_point(puppet.contours[index] - corner)], True, colour, width, cv2.LINE_AA, FIXED_BITS
        )
    view[:] = layer


def _draw_joints(canvas: np.ndarray, puppet: DrawnPuppet, width: int) -> None:
    """Draw a disc per joint: larger for more confidence, hollow below one half."""
    for name, point, confidence in zip(puppet.joint_names, puppet.joints, puppet.confidence, strict=True):
        if not (np.isfinite(point).all() and np.abs(point).max() < MAX_COORDINATE_PX):
            continue
        x, y = (int(value) for value in to_fixed_point(point))
        level = float(np.clip(confidence, 0, 1)) if np.isfinite(confidence) else 0.0
        radius = round((1.2 + 1.6 * level) * width * (1 << FIXED_BITS))
        inside = joint_colour(name) if level >= 0.5 else (30, 30, 30)
        cv2.circle(canvas, (x, y), radius + (width << FIXED_BITS), (20, 20, 20), -1, cv2.LINE_AA, FIXED_BITS)
        cv2.circle(canvas, (x, y), radius, joint_colour(name), -1, cv2.LINE_AA, FIXED_BITS)
        cv2.circle(canvas, (x, y), radius // 2, inside, -1, cv2.LINE_AA, FIXED_BITS)


def _shorten(name: str) -> str:
    return name.replace("left_", "L ").replace("right_", "R ").replace("_", " ")


def _draw_labels(canvas: np.ndarray, puppet: DrawnPuppet, width: int) -> None:
    """Write names in a column on each side of the puppet, each with a line to its part, and the id above it.

    A puppet too small for its names gets the id only.
    """
    indices = [index for index in puppet.order if is_drawable(puppet.contours[index])]
    if not indices:
        return
    size = max(0.35, min(canvas.shape[:2]) / 1400)
    texts = [_shorten(puppet.part_names[index]) for index in indices]
    boxes = [cv2.getTextSize(text, FONT, size, 1)[0] for text in texts]
    centres = np.array([puppet.contours[index].mean(axis=0) for index in indices])
    corners = np.vstack([puppet.contours[index] for index in indices])
    low, high = corners.min(axis=0), corners.max(axis=0)
    height = max(box[1] for box in boxes)
    on_right = centres[:, 0] >= np.median(centres[:, 0])
    for side in (False, True) if high[1] - low[1] > 15 * height else ():
        chosen = [k for k in np.argsort(centres[:, 1], kind="stable") if on_right[k] == side]
        rows = spread([centres[k, 1] for k in chosen], 1.9 * height, height + 2, canvas.shape[0] - 4)
        for k, baseline in zip(chosen, rows, strict=True):
            x = high[0] + 8 * width if side else low[0] - 8 * width - boxes[k][0]
            x = float(np.clip(x, 2, max(2, canvas.shape[1] - boxes[k][0] - 2)))
            anchor = (x - 2 if side else x + boxes[k][0] + 2, baseline - height / 2)
            line = [to_fixed_point(np.array(anchor)), to_fixed_point(centres[k])]
            cv2.polylines(canvas, [np.array(line)], False, (255, 255, 255), 1, cv2.LINE_AA, FIXED_BITS)
            write_text(canvas, texts[k], (x, baseline), size)
    name_width = cv2.getTextSize(puppet.id, FONT, 1.3 * size, 1)[0][0]
    write_text(canvas, puppet.id, ((low[0] + high[0] - name_width) / 2, max(1.5 * height, low[1] - height)), 1.3 * size)


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Return ascending positions moved until neighbours are `gap` apart, within low to high if there is room."""
    positions: list[float] = []
    for value in wanted:
        positions.append(max(value, positions[-1] + gap) if positions else max(value, low))
    limit = high
    for index in range(len(positions) - 1, -1, -1):
        positions[index] = min(positions[index], limit)
        limit = positions[index] - gap
    return positions


def write_text(canvas: np.ndarray, text: str, position: tuple[float, float], size: float) -> None:
    """Write ASCII text with its left baseline at (x, y), white with a dark rim, into an RGB image."""
    x, y = round(position[0]), round(position[1])
    # Thicker letters would also be wider, so the rim is the same text shifted.
    for dx, dy in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        cv2.putText(canvas, text, (x + dx, y + dy), FONT, size, (20, 20, 20), 1, cv2.LINE_AA)
    cv2.putText(canvas, text, (x, y), FONT, size, (255, 255, 255), 1, cv2.LINE_AA)
