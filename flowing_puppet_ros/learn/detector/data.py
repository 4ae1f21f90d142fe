# SPDX-License-Identifier: Apache-2.0
"""Examples to learn the detector from: images of at most 480 px, each with one person's joints and scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector.root_filters import resize
from flowing_puppet_ros.image.formats.annotations import AnnotatedFrame, source_of
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

JOINTS = tuple(name for name in JOINT_NAMES[10] if "knee" not in name and "ankle" not in name)
MIRRORED = tuple(
    JOINTS.index(name.replace("right", "LEFT").replace("left", "right").replace("LEFT", "left")) for name in JOINTS
)
LARGEST_SIDE = 480
TRUNK_SHARE = 0.62  # shoulder width over the trunk's length (mid-shoulder to mid-hip) of a person seen from the front
LEAST_CONFIDENCE = 0.5  # of a joint that teaches
NECK_SHARE = 0.6  # a head-and-shoulders window is centred this far from the face towards the neck
CLOSE_CENTER, CLOSE_SCALE = 0.35, 1.3  # units of S and ratio: a window this close to a person is no negative
BLUR_SHARE = 0.5  # of the examples are shrunk before they are looked at, as people far away are
SMALLEST_SCALE, LARGEST_SCALE = 12.0, 300.0  # px


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One person on an image (H, W, 3): `joints` (11, 2) px in the order of JOINTS, `seen` (11,), scale S in px.

    `seen` is false for joints outside the image or unsure; `others` (N, 4) are x, y, and half the width and height
    of further people, whom no negative example may touch; `source` is the video or file that the image is from.
    """

    image: U8
    joints: Array
    seen: Array
    scale: float
    others: Array
    source: str

    def joint(self, name: str) -> Array:
        """Position (2,) of one joint."""
        at: Array = self.joints[JOINTS.index(name)]
        return at

    def with_image(self, image: U8) -> Example:
        """The same person on another image of the same size."""
        return replace(self, image=image)

    def mirrored(self) -> Example:
        """The image and its person seen in a mirror."""
        width = self.image.shape[1]
        joints = self.joints[list(MIRRORED)] * (-1, 1) + (width - 1, 0)
        others = self.others.copy()
        others[:, 0] = width - 1 - others[:, 0]
        image = np.ascontiguousarray(self.image[:, ::-1])
        return replace(self, image=image, joints=joints, seen=self.seen[list(MIRRORED)], others=others)

    def resized(self, factor: float) -> Example:
        """The image and its person `factor` times as large."""
        image = resize(self.image, factor)
        ratio = np.array([image.shape[1] / self.image.shape[1], image.shape[0] / self.image.shape[0]])
        joints = (self.joints + 0.5) * ratio - 0.5
        return replace(
            self, image=image, joints=joints, scale=self.scale * factor, others=self.others * np.tile(ratio, 2)
        )


def examples_of(frames: Iterable[AnnotatedFrame]) -> list[Example]:
    """One example a person whose scale can be told; InputError when there is none.

    The scale of the only person of a video is the median over its frames: shoulders that turn keep their size.
    """
    model = DeformableStructures.load()
    examples: list[Example] = []
    files: list[str] = []
    for frame in frames:
        made = [joints_and_scale(model, person.keypoints) for person in frame.people]
        for index, (joints, confidence, scale) in enumerate(made):
            if SMALLEST_SCALE <= scale <= LARGEST_SCALE * max(1.0, max(frame.image.shape[:2]) / LARGEST_SIDE):
                others = _boxes([*made[:index], *made[index + 1 :]])
                height, width = frame.image.shape[:2]
                inside = ((joints >= 0) & (joints <= (width - 1, height - 1))).all(axis=1)
                seen = inside & (confidence >= LEAST_CONFIDENCE)
                whole = Example(frame.image, joints, seen, scale, others, source_of(frame.file))
                examples.append(whole.resized(min(1.0, LARGEST_SIDE / max(height, width))))
                files.append(frame.file if len(made) == 1 else f"{frame.file}#{len(examples)}")
    if not examples:
        raise InputError("the annotations show nobody with shoulders between 12 and 300 px; annotate more people")
    return _steady(examples, files)


def joints_and_scale(model: DeformableStructures, keypoints: Keypoints) -> tuple[Array, Array, float]:
    """Joints (11, 2) in the puppet's convention, confidence (11,) and S in px, 0 where it cannot be told."""
    joints, confidence = joints_from_keypoints(model, keypoints)
    chosen = [model.joint_names.index(name) for name in JOINTS]
    joints, confidence = joints[chosen], confidence[chosen]
    right, left = JOINTS.index("right_shoulder"), JOINTS.index("left_shoulder")
    trunk = (joints[right] + joints[left] - joints[JOINTS.index("right_hip")] - joints[JOINTS.index("left_hip")]) / 2
    lengths = np.linalg.norm(joints[right] - joints[left]), TRUNK_SHARE * np.linalg.norm(trunk)
    return (
        np.nan_to_num(joints),
        np.where(np.isfinite(joints).all(axis=1), confidence, 0.0),
        float(np.nan_to_num(np.fmax(*lengths))),
    )


def _boxes(people: Sequence[tuple[Array, Array, float]]) -> Array:
    """Centre and half sizes (N, 4) of the heads and shoulders of people, px."""
    rows = [[*joints[JOINTS.index("neck")], scale, scale] for joints, _, scale in people if scale > 0]
    return np.array(rows, np.float64).reshape(-1, 4)


def _steady(examples: list[Example], files: list[str]) -> list[Example]:
    """The examples with the median scale of their file."""
    names = np.array(files)
    scales = np.array([example.scale for example in examples])
    median = {name: float(np.median(scales[names == name])) for name in set(files)}
    return [replace(example, scale=median[name]) for example, name in zip(examples, files, strict=True)]


def varied(example: Example, rng: np.random.Generator) -> Example:
    """The example perhaps mirrored, at a random size, brighter or darker, at most as sharp as it was."""
    if rng.random() < 0.5:
        example = example.mirrored()
    if rng.random() < BLUR_SHARE:
        wanted = float(np.exp(rng.uniform(np.log(18.0), np.log(max(19.0, example.scale)))))
        example = example.resized(min(1.0, wanted / example.scale))
    if rng.random() < 0.5:
        table = (255 * np.linspace(0, 1, 256) ** rng.uniform(0.6, 1.7)).astype(np.uint8)
        example = example.with_image(table[example.image])
    return example


def center_of(example: Example) -> Array:
    """Centre (2,) px of the window that shows an example's head and shoulders."""
    center: Array = NECK_SHARE * example.joint("neck") + (1 - NECK_SHARE) * example.joint("face")
    return center


def close_to(
    example: Example,
    center: tuple[Any, Any],
    scale: float,
    nearness: float = CLOSE_CENTER,
    ratio: float = CLOSE_SCALE,
) -> Any:
    """Whether windows with the centre (x, y), two numbers or arrays, show the person or touch one of the others.

    They show the person when they are `nearness` of S or less away and smaller or larger by `ratio` at most.
    """
    true_center = center_of(example)
    distance = np.hypot(center[0] - true_center[0], center[1] - true_center[1])
    close = (distance < nearness * example.scale) & (max(scale / example.scale, example.scale / scale) < ratio)
    for x, y, half_width, half_height in example.others:
        close |= (abs(center[0] - x) < half_width) & (abs(center[1] - y) < half_height)
    return close
