# SPDX-License-Identifier: Apache-2.0
"""Right and wrong places of hands in annotated images, and the hand maps of these images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flowing_puppet_ros.arrays import Array, Bools
from flowing_puppet_ros.evidence.image.hands import EXTRAS, HandDetectors, HandFilter, HandMaps
from flowing_puppet_ros.evidence.image.likelihood import MAX_HAND_DISTANCE_M, PartLikelihood
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.learn.likelihood.samples import PosedPerson
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

KINDS = tuple(EXTRAS)
SIDES = ("right", "left")
MIN_CONFIDENCE = 0.5  # of wrists and elbows to learn from
MIN_WRONG_DISTANCE_M = 0.12  # of a wrong place from any wrist
NO_FILTER = HandFilter(np.zeros(0, np.float32), 0.0, (1.0, 0.0))
BLANK = HandDetectors(dict.fromkeys(KINDS, NO_FILTER), np.zeros(3))


def make_maps(
    posed: PosedPerson, likelihood: PartLikelihood, optical_flow: OpticalFlow, detectors: HandDetectors = BLANK
) -> HandMaps:
    """Make the hand maps of an image, with the colours of the posed person and the flow back in time."""
    scene = likelihood.prepare(posed.image).with_torso(*posed.puppet.contours[:2])
    flows = [] if posed.previous_image is None else [optical_flow(posed.previous_image, posed.image)[1]]
    return HandMaps.of(detectors, scene, flows, posed.puppet.scale)


def find_wrists(model: DeformableStructures, posed: PosedPerson) -> Iterator[tuple[Array, Array]]:
    """Yield wrist (2,) and elbow (2,) px of each arm with reliable joints and the wrist in the image."""
    for side in SIDES:
        wrist, elbow = (model.joint_names.index(f"{side}_{name}") for name in ("wrist", "elbow"))
        place = posed.puppet.joints[wrist]
        inside = (place >= 0).all() and (place < posed.image.shape[1::-1]).all()
        if min(posed.confidence[wrist], posed.confidence[elbow]) >= MIN_CONFIDENCE and inside:
            yield place, posed.puppet.joints[elbow]


def sample_wrong_places(model: DeformableStructures, posed: PosedPerson, count: int, rng: np.random.Generator) -> Array:
    """Draw up to `count` places (N, 2) px in the image that a hand could reach and where none is."""
    scale = posed.puppet.scale
    distance, turn = MAX_HAND_DISTANCE_M * scale * np.sqrt(rng.random(4 * count)), rng.uniform(0, 2 * np.pi, 4 * count)
    middle = posed.puppet.contours[1].mean(axis=0) + np.array([0.0, 0.2 * scale])
    places = middle + distance[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return places[is_far_from_wrists(model, posed, places)][:count]


def is_far_from_wrists(model: DeformableStructures, posed: PosedPerson, places: Array) -> Bools:
    """Return which of `places` (N, 2) px are in the image and not near either wrist."""
    wrists = posed.puppet.joints[[model.joint_names.index(f"{side}_wrist") for side in SIDES]]
    near = np.linalg.norm(places[:, None] - wrists, axis=2).min(axis=1) < MIN_WRONG_DISTANCE_M * posed.puppet.scale
    inside = ((places >= 0) & (places < np.array(posed.image.shape[1::-1]))).all(axis=1)
    return np.asarray(inside & ~near)
