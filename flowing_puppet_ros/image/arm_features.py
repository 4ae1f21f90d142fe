# SPDX-License-Identifier: Apache-2.0
"""What is measured of a hypothesis of an arm: where it lies, what the detector says of it, contour, colour, motion.

Left arms are measured as if seen in a mirror, so that both sides share what is learned. Lengths are in units of S, the
shoulder width. What cannot be known (no motion in a single image, no maps where the detector missed the person) is
UNKNOWN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flowing_puppet_ros.evidence.hog import SIGNED, UNSIGNED
from flowing_puppet_ros.flow.estimate import Flow
from flowing_puppet_ros.image.carry import Grid
from flowing_puppet_ros.image.detector_parts import CELLS_PER_SCALE
from flowing_puppet_ros.image.detector_parts import Window as PartWindow
from flowing_puppet_ros.image.detector_person import PersonDetection
from flowing_puppet_ros.image.pose_evidence import Window
from flowing_puppet_ros.image.smoothing import sampled
from flowing_puppet_ros.model.ds import DeformableStructures
from flowing_puppet_ros.model.ds_shape import View

type Floats = NDArray[np.float64]

SIDES = ("right", "left")
ENDS = ("elbow", "wrist")
UNKNOWN = -10.0
UPPER_ALONG = (0.25, 0.6)  # where gradients are measured, from shoulder (0) to elbow (1)
LOWER_ALONG = (0.0, 0.33, 0.67, 1.0, 1.3)  # from elbow to wrist, and at the hand
ASIDE = (-0.14, 0.0, 0.14)  # units of S across the limb
COLOURS = 4
STEERED = UNSIGNED + COLOURS
MOTION_POINTS = (0.0, 0.5, 1.0, 1.3)  # from elbow to wrist, where motion is measured
FARTHEST = 3.0  # units of S; larger lengths are cut off


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Dense `flow` from this image to one beside it, on the working grid of `grid`."""

    flow: Flow
    grid: Grid


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A person in one image.

    `joints` (J, 2) px as far as they are known already, `scale` px/m, the `detection` (None where it was missed), the
    detector's features `look` around the person, the evidence `window` (None outside of the image), and the `motion`
    (None in a single image).
    """

    model: DeformableStructures
    joints: Floats
    scale: float
    view: View
    detection: PersonDetection | None
    look: PartWindow
    window: Window | None
    motion: Motion | None

    def joint(self, name: str) -> Floats:
        """Place (2,) px of a joint."""
        at: Floats = self.joints[self.model.joint_names.index(name)]
        return at

    @property
    def width(self) -> float:
        """S in px."""
        return self.look.cell * CELLS_PER_SCALE

    def hypotheses(self, side: str, count: int) -> Floats:
        """Elbow and wrist (K, 2, 2) px of the detector's modes of an arm; without it the known ones."""
        if self.detection is not None:
            return self.detection.arms(side, count)
        return np.stack([self.joint(f"{side}_{name}") for name in ENDS])[None]


def arm_features(sight: Sight, side: str, places: Floats) -> NDArray[np.float32]:
    """Features (K, F) of elbow and wrist at places (K, 2, 2) px."""
    columns = [
        _geometry(sight, side, places),
        _detector_scores(sight, side, places),
        _evidence(sight, side, places),
        _steered(sight, side, places),
        _motion(sight, places),
    ]
    return np.concatenate(columns, axis=1).astype(np.float32)


def _geometry(sight: Sight, side: str, places: Floats) -> Floats:
    sign = np.array([-1.0 if (side == "right") == (sight.view == "front") else 1.0, 1.0])
    other = SIDES[1 - SIDES.index(side)]
    shoulder, face = sight.joint(f"{side}_shoulder"), sight.joint("face")
    elbow, wrist = places[:, 0], places[:, 1]
    vectors = [elbow - shoulder, wrist - elbow, wrist - face]
    spans = [*vectors, wrist - shoulder, wrist - sight.joint("belly")]
    spans += [wrist - sight.joint(f"{other}_{name}") for name in ENDS] + [elbow - sight.joint(f"{other}_elbow")]
    lengths = np.stack([np.hypot(*span.T) for span in spans], axis=1)
    bend = (vectors[0] * vectors[1]).sum(axis=1) / np.maximum(lengths[:, 0] * lengths[:, 1], 1e-6)
    aside = np.concatenate([vector * sign for vector in vectors], axis=1)
    return np.column_stack([np.clip(np.concatenate([aside, lengths], axis=1) / sight.width, -3, FARTHEST), bend])


def _detector_scores(sight: Sight, side: str, places: Floats) -> Floats:
    if sight.detection is None:
        return np.full((len(places), 3), UNKNOWN)
    elbow, wrist = (sight.detection.joint_score(f"{side}_{name}", places[:, k]) for k, name in enumerate(ENDS))
    return np.stack([elbow, wrist, np.minimum(elbow, wrist)], axis=1)


def _evidence(sight: Sight, side: str, places: Floats) -> Floats:
    """The terms of contour and colour of upper and lower arm, and how much the wrist looks like a hand's."""
    if sight.window is None:
        return np.full((len(places), 10), UNKNOWN)
    rows = [sight.model.joint_names.index(f"{side}_{name}") for name in ENDS]
    parts = [sight.model.tree.names.index(f"{side}_{name}") for name in ("upper_arm", "lower_arm")]
    contours: tuple[list[Floats], list[Floats]] = ([], [])
    for place in places:
        joints = sight.joints.copy()
        joints[rows] = place
        shape = sight.model.puppet_from_joints(joints, sight.scale, sight.view)
        for own, part in zip(contours, parts, strict=True):
            own.append(shape.contours[part])
    scale = np.full(len(places), sight.scale)
    terms = [sight.window.terms(part, np.array(own), scale) for part, own in zip(parts, contours, strict=True)]
    hand = np.log(sight.window.hands(places[:, 1], sight.scale))
    return np.nan_to_num(np.column_stack([*terms, hand]), nan=UNKNOWN, neginf=UNKNOWN)


def _steered(sight: Sight, side: str, places: Floats) -> Floats:
    """Gradients relative to the limb's direction and colours, at points along and beside both limbs."""
    sign = -1.0 if (side == "right") == (sight.view == "front") else 1.0
    shoulder = np.broadcast_to(sight.joint(f"{side}_shoulder"), (len(places), 2))
    limbs = (shoulder, places[:, 0], UPPER_ALONG), (places[:, 0], places[:, 1], LOWER_ALONG)
    columns = []
    for start, end, along in limbs:
        axis = end - start
        angle = np.arctan2(axis[:, 1], axis[:, 0])
        across = sign * np.stack([-np.sin(angle), np.cos(angle)], axis=1) * sight.width
        points = np.stack(
            [start + share * axis + aside * across for share in along for aside in ASIDE], axis=1
        )  # (K, M, 2)
        cells = sight.look.cells_of(points)
        columns.append(steered(sight.look.features, cells, angle, sign).reshape(len(places), -1))
    return np.concatenate(columns, axis=1)


def _motion(sight: Sight, places: Floats) -> Floats:
    """How fast points of the forearm move relative to the trunk, in units of S an image, and how unevenly."""
    count = len(places)
    if sight.motion is None:
        return np.full((count, len(MOTION_POINTS) + 1), UNKNOWN)
    flow, grid = sight.motion.flow, sight.motion.grid
    trunk = np.stack([sight.joint(name) for name in ("neck", "belly", "right_shoulder", "left_shoulder")])
    still = np.nan_to_num(np.nanmedian(sampled(flow, grid.reduced(trunk)), axis=0))
    axis = places[:, 1] - places[:, 0]
    points = np.concatenate([places[:, 0] + share * axis for share in MOTION_POINTS])
    moved = (sampled(flow, grid.reduced(points)) - still).reshape(len(MOTION_POINTS), count, 2) / grid.factor
    speed = np.linalg.norm(moved, axis=2).T / sight.width
    spread = np.linalg.norm(moved[-1] - moved[0], axis=1) / sight.width
    return np.nan_to_num(np.column_stack([speed, spread]), nan=UNKNOWN)


@njit(cache=True)
def steered(features: NDArray[np.float32], points: Floats, angle: Floats, sign: float) -> Any:
    """Gradient orientations relative to `angle` (K,) and colours (K, M, 13) at points (K, M, 2) of a grid (R, C, 36).

    `sign` -1 counts orientations the other way round, as in a mirror. Between cells values are shared linearly,
    beyond the grid its border is repeated.
    """
    rows, columns, _ = features.shape
    count, places, _ = points.shape
    out = np.zeros((count, places, STEERED))
    own = np.zeros(UNSIGNED)
    step = np.pi / UNSIGNED
    for k in range(count):
        for m in range(places):
            x = min(max(points[k, m, 0], 0.0), columns - 1.0)
            y = min(max(points[k, m, 1], 0.0), rows - 1.0)
            left, top = min(int(x), columns - 2), min(int(y), rows - 2)
            own[:] = 0
            for dy in range(2):
                for dx in range(2):
                    share = abs(1 - dx - (x - left)) * abs(1 - dy - (y - top))
                    cell = features[top + dy, left + dx]
                    for b in range(UNSIGNED):
                        own[b] += share * cell[SIGNED + b]
                    for c in range(COLOURS):
                        out[k, m, UNSIGNED + c] += share * cell[cell.size - COLOURS + c]
            for b in range(UNSIGNED):
                at = (angle[k] + sign * b * step) / step
                low = int(np.floor(at))
                rest = at - low
                out[k, m, b] = (1 - rest) * own[low % UNSIGNED] + rest * own[(low + 1) % UNSIGNED]
    return out
