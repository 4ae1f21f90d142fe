# SPDX-License-Identifier: Apache-2.0
"""Training examples of the detector: images of at most 480 px, each with one person's joints and scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8, Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.detector.root_filters import resize
from flowing_puppet_ros.image.formats.annotations import AnnotatedFrame, source_video
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.tree import mirrored_name

JOINTS = tuple(name for name in JOINT_NAMES[10] if "knee" not in name and "ankle" not in name)
MIRRORED_JOINTS = tuple(JOINTS.index(mirrored_name(name)) for name in JOINTS)
MAX_SIDE_PX = 480  # larger images are shrunk
SHOULDERS_PER_TRUNK = 0.62  # shoulder width over trunk length (mid-shoulder to mid-hip), seen from the front
MIN_CONFIDENCE = 0.5  # of a joint to learn from
NECK_SHARE = 0.6  # centre of a head-and-shoulders window, as a share of the way from face to neck
# In units of S, and a ratio: closer windows are not negatives.
MIN_NEGATIVE_OFFSET, MIN_NEGATIVE_SCALE_RATIO = 0.35, 1.3
SHRINK_PROBABILITY = 0.5  # of shrinking an example, to resemble people far away
MIN_SCALE_PX, MAX_SCALE_PX = 12.0, 300.0  # of people to learn from


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One person in an image.

    Attributes:
        image: (H, W, 3) uint8.
        joints: (11, 2) px in the order of JOINTS.
        seen: (11,) bool, false for joints outside the image or of low confidence.
        scale: S, the shoulder width from the front, px.
        others: (N, 4) px, centre and half width and height of other people, which negatives must not touch.
        source: the video or file of the image.
    """

    image: U8
    joints: Array
    seen: Array
    scale: float
    others: Array
    source: str

    def joint(self, name: str) -> Array:
        """Return the position (2,) px of one joint."""
        at: Array = self.joints[JOINTS.index(name)]
        return at

    def with_image(self, image: U8) -> Example:
        """Return the example with another image of the same size."""
        return replace(self, image=image)

    def mirror(self) -> Example:
        """Mirror the image and its person."""
        width = self.image.shape[1]
        joints = self.joints[list(MIRRORED_JOINTS)] * (-1, 1) + (width - 1, 0)
        others = self.others.copy()
        others[:, 0] = width - 1 - others[:, 0]
        image = np.ascontiguousarray(self.image[:, ::-1])
        return replace(self, image=image, joints=joints, seen=self.seen[list(MIRRORED_JOINTS)], others=others)

    def resize(self, factor: float) -> Example:
        """Scale the image and its person by `factor`."""
        image = resize(self.image, factor)
        ratio = np.array([image.shape[1] / self.image.shape[1], image.shape[0] / self.image.shape[0]])
        joints = (self.joints + 0.5) * ratio - 0.5
        return replace(
            self, image=image, joints=joints, scale=self.scale * factor, others=self.others * np.tile(ratio, 2)
        )


def make_examples(frames: Iterable[AnnotatedFrame]) -> list[Example]:
    """Make an example of each person whose scale is known; InputError if there is none.

    If a video shows a single person, their scale is the median over its frames: turning does not shrink shoulders.
    """
    model = DeformableStructures.load()
    examples: list[Example] = []
    files: list[str] = []
    for frame in frames:
        made = [measure_joints_and_scale(model, person.keypoints) for person in frame.people]
        for index, (joints, confidence, scale) in enumerate(made):
            if MIN_SCALE_PX <= scale <= MAX_SCALE_PX * max(1.0, max(frame.image.shape[:2]) / MAX_SIDE_PX):
                others = _make_boxes([*made[:index], *made[index + 1 :]])
                height, width = frame.image.shape[:2]
                inside = ((joints >= 0) & (joints <= (width - 1, height - 1))).all(axis=1)
                seen = inside & (confidence >= MIN_CONFIDENCE)
                whole = Example(frame.image, joints, seen, scale, others, source_video(frame.file))
                examples.append(whole.resize(min(1.0, MAX_SIDE_PX / max(height, width))))
                files.append(frame.file if len(made) == 1 else f"{frame.file}#{len(examples)}")
    if not examples:
        raise InputError(
            "the annotations show no person with shoulders between 12 and 300 px wide; annotate more people"
        )
    return _share_median_scale(examples, files)


def measure_joints_and_scale(model: DeformableStructures, keypoints: Keypoints) -> tuple[Array, Array, float]:
    """Return joints (11, 2) px in the puppet's convention, confidence (11,) and the scale S in px, 0 if unknown."""
    joints, confidence = joints_from_keypoints(model, keypoints)
    chosen = [model.joint_names.index(name) for name in JOINTS]
    joints, confidence = joints[chosen], confidence[chosen]
    right, left = JOINTS.index("right_shoulder"), JOINTS.index("left_shoulder")
    trunk = (joints[right] + joints[left] - joints[JOINTS.index("right_hip")] - joints[JOINTS.index("left_hip")]) / 2
    lengths = np.linalg.norm(joints[right] - joints[left]), SHOULDERS_PER_TRUNK * np.linalg.norm(trunk)
    return (
        np.nan_to_num(joints),
        np.where(np.isfinite(joints).all(axis=1), confidence, 0.0),
        float(np.nan_to_num(np.fmax(*lengths))),
    )


def _make_boxes(people: Sequence[tuple[Array, Array, float]]) -> Array:
    """Return centre and half size (N, 4) px of the heads and shoulders of people."""
    rows = [[*joints[JOINTS.index("neck")], scale, scale] for joints, _, scale in people if scale > 0]
    return np.array(rows, np.float64).reshape(-1, 4)


def _share_median_scale(examples: list[Example], files: list[str]) -> list[Example]:
    """Give all examples of a file their median scale."""
    names = np.array(files)
    scales = np.array([example.scale for example in examples])
    median = {name: float(np.median(scales[names == name])) for name in set(files)}
    return [replace(example, scale=median[name]) for example, name in zip(examples, files, strict=True)]


def augment(example: Example, rng: np.random.Generator) -> Example:
    """Randomly mirror, shrink, and brighten or darken an example."""
    if rng.random() < 0.5:
        example = example.mirror()
    if rng.random() < SHRINK_PROBABILITY:
        wanted = float(np.exp(rng.uniform(np.log(18.0), np.log(max(19.0, example.scale)))))
        example = example.resize(min(1.0, wanted / example.scale))
    if rng.random() < 0.5:
        table = (255 * np.linspace(0, 1, 256) ** rng.uniform(0.6, 1.7)).astype(np.uint8)
        example = example.with_image(table[example.image])
    return example


def window_center(example: Example) -> Array:
    """Return the centre (2,) px of the window that shows an example's head and shoulders."""
    center: Array = NECK_SHARE * example.joint("neck") + (1 - NECK_SHARE) * example.joint("face")
    return center


def is_close(
    example: Example,
    center: tuple[Any, Any],
    scale: float,
    max_offset: float = MIN_NEGATIVE_OFFSET,
    max_ratio: float = MIN_NEGATIVE_SCALE_RATIO,
) -> Any:
    """Return whether windows with centre (x, y), numbers or arrays, show the person or touch one of the others.

    A window shows the person if its centre is less than `max_offset` S away and its scale differs by less than a factor
    of `max_ratio`.
    """
    true_center = window_center(example)
    distance = np.hypot(center[0] - true_center[0], center[1] - true_center[1])
    close = (distance < max_offset * example.scale) & (max(scale / example.scale, example.scale / scale) < max_ratio)
    for x, y, half_width, half_height in example.others:
        close |= (abs(center[0] - x) < half_width) & (abs(center[1] - y) < half_height)
    return close
