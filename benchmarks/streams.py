# SPDX-License-Identifier: Apache-2.0
"""Speed of the 2D tracker by image size and number of people, on puppets drawn over noise.

Processor time of the whole process, after a first run that compiles.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread

SIZES = ((320, 240), (640, 480), (1280, 960))  # width and height, px
PEOPLE = (1, 2, 4, 8)
MIDDLE, ALONE = (640, 480), 1  # size at which people vary, and people at which the size varies
FRAMES, STEP_PX = 6, 3.0  # images, and a person's motion between them

type PlacedPeople = list[tuple[np.ndarray, float]]  # joints (J, 2) px, scale px/m


def measure_tracking(seed: int) -> list[Row]:
    """Measure milliseconds per image of the tracker with `preset: fast`, by image size and number of people."""
    rows = [_measure_size(size, ALONE, seed) for size in SIZES]
    return rows + [_measure_size(MIDDLE, people, seed) for people in PEOPLE if people != ALONE]


def _measure_size(size: tuple[int, int], people: int, seed: int) -> Row:
    model, rng = DeformableStructures.load(), np.random.default_rng(seed)
    ground = cv2.resize(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    placed_people = _arrange_people(model, size, people)
    tracker = FlowingPuppetTracker(model, None, FlowSettings(preset="fast"))
    seconds = []
    with one_blas_thread(), one_opencv_thread():
        for number in range(FRAMES):
            moved = [(joints + np.array([STEP_PX * number, 0.0]), scale) for joints, scale in placed_people]
            image = _draw_people(model, np.asarray(ground), moved)
            certain = np.ones(len(model.joint_names))
            detections = [Keypoints(model.joint_names, joints, certain) for joints, _ in moved] if not number else None
            started = time.process_time()
            result = tracker.step(image, number * 33_000_000, detections)
            seconds.append(time.process_time() - started)
    # The first image starts the tracks, the second may compile.
    spent = 1000 * float(np.median(seconds[2:]))
    row = {"width": size[0], "height": size[1], "people": people, "tracked": len(result.puppets)}
    return row | {"milliseconds_an_image": spent}


def _arrange_people(model: DeformableStructures, size: tuple[int, int], count: int) -> PlacedPeople:
    """Arrange people side by side, filling two thirds of the height, or less if they need the width."""
    joints = model.likely_puppet().joints
    joints = joints - joints.min(axis=0)
    width, height = joints.max(axis=0)
    room = (size[0] - STEP_PX * FRAMES) / count
    scale = min(0.66 * size[1] / height, 0.9 * room / width)
    corners = [np.array([room * (k + 0.5) - scale * width / 2, 0.2 * size[1]]) for k in range(count)]
    return [(joints * scale + corner, scale) for corner in corners]


def _draw_people(model: DeformableStructures, ground: np.ndarray, people: PlacedPeople) -> np.ndarray:
    image, colours = ground.copy(), np.random.default_rng(0).integers(0, 255, (len(model.tree), 3))
    for joints, scale in people:
        contours = model.puppet_from_joints(joints, scale).contours
        labels = render_labels(contours, depth_order(model), (ground.shape[0], ground.shape[1]))
        image[labels > 0] = colours[labels[labels > 0] - 1]
    return image
