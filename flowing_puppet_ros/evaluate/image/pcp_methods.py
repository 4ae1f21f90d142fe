# SPDX-License-Identifier: Apache-2.0
"""The rows of the thesis's Table 1: detector alone, and the search without likelihood, without shape, and in full."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.evaluate.image.pcp import PosedSticks, Tally
from flowing_puppet_ros.evaluate.people import Unmatched
from flowing_puppet_ros.image.formats.keypoints import joints_from_keypoints
from flowing_puppet_ros.image.formats.stickmen import sticks_from_joints
from flowing_puppet_ros.image.pose.estimator import PoseDetectorLike, PoseEstimator
from flowing_puppet_ros.image.pose.evidence import LikelihoodLike, PersonHypotheses
from flowing_puppet_ros.image.pose.result import PosedPuppet
from flowing_puppet_ros.image.pose.settings import PoseSettings
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

METHODS: dict[str, dict[str, bool]] = {
    "NL": {"likelihood": False},
    "NS": {"shape": False},
    "DS, PMP": {"diverse": False},
    "DS, D-PMP": {},
}
"""Settings of each row that differ from the full search: no likelihood, no shape, no diverse particles."""

DETECTOR = "detector"


class _SharedDetector:
    """A detector that runs once per image for all rows."""

    def __init__(self, detector: PoseDetectorLike) -> None:
        self._detector = detector
        self._seen: tuple[bytes, Sequence[PersonHypotheses]] | None = None

    def detect(self, image: Array) -> Sequence[PersonHypotheses]:
        pixels = image.tobytes()
        if self._seen is None or self._seen[0] != pixels:
            self._seen = pixels, self._detector.detect(image)
        return self._seen[1]


def measure_methods(
    images: Iterable[tuple[Array, Sequence[Array]]],
    model: DeformableStructures,
    sides: MultiViewStructures,
    detector: PoseDetectorLike,
    likelihood: LikelihoodLike,
    settings: PoseSettings,
    pixels: float,
    unmatched: Unmatched,
    progress: Callable[[], None],
) -> dict[str, dict[str, float]]:
    """Return the figures of `Tally` and CPU seconds per image by method, over images (H, W, 3) with true sticks.

    `progress` is called after each image. The time of the search excludes the detector.
    """
    once = _SharedDetector(detector)
    tallies = {name: Tally(pixels, unmatched) for name in (DETECTOR, *METHODS)}
    seconds = dict.fromkeys(tallies, 0.0)
    estimators = {
        name: PoseEstimator([model], once, likelihood, replace(settings, **changes), [sides])
        for name, changes in METHODS.items()
    }
    count = 0
    for image, truths in images:
        began = time.process_time()
        people = [_sticks_from_detection(found, model) for found in once.detect(np.ascontiguousarray(image))]
        seconds[DETECTOR] += time.process_time() - began
        tallies[DETECTOR].add(people, truths)
        for name, estimator in estimators.items():
            began = time.process_time()
            posed = [_sticks_from_pose(one, model) for one in estimator.estimate(image)]
            seconds[name] += time.process_time() - began
            tallies[name].add(posed, truths)
        count += 1
        progress()
    return {
        name: tally.summarise() | {"seconds an image": round(seconds[name] / max(count, 1), 3)}
        for name, tally in tallies.items()
    }


def _sticks_from_pose(posed: PosedPuppet, model: DeformableStructures) -> PosedSticks:
    solutions = [sticks_from_joints(model.joint_names, solution.joints) for solution in posed.solutions]
    sticks = sticks_from_joints(model.joint_names, posed.joints)
    return PosedSticks(sticks, np.stack(solutions), float(posed.confidence.mean()))


def _sticks_from_detection(found: PersonHypotheses, model: DeformableStructures) -> PosedSticks:
    """Return the detector's own result: its best pose and up to nine others."""
    several = []
    for keypoints, _ in found.modes(10):
        joints, _ = joints_from_keypoints(model, keypoints)
        several.append(sticks_from_joints(model.joint_names, joints))
    return PosedSticks(several[0], np.stack(several), found.confidence)
