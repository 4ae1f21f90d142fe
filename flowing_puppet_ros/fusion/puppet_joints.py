# SPDX-License-Identifier: Apache-2.0
"""The joints of puppets, whoever found them, in the body model's order; and puppets carried to another stamp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.arrays import F64, Bools
from flowing_puppet_ros.image.formats.keypoints import Keypoints, joints_from_keypoints
from flowing_puppet_ros.image.person_mask import PersonMask
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.sp import StitchedPuppet

# From a network's ankle to the model's, which lies lower: share of the way from the knee to the ankle.
ANKLE_DROP = 0.10
MIN_SURE_CONFIDENCE = 0.5
"""Of a joint that tells where the person is: whose mask it is, and whether colour and depth fit."""
MIN_PUPPET_JOINTS = 4
"""Known joints of a puppet that is believed to be a person."""
LONG_BONES = (
    ("shoulder", "hip"), ("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"),
)  # fmt: skip
"""Whose length in the image tells the distance, on both sides."""
LONG_SHARE = 0.25
"""Share of the bones that may appear longer than they are: most are foreshortened, and seem farther away."""
SLACK_SHARE = 0.8
"""Of the joints, that move no farther beside a mask that moves with the others than its slack."""
_TRUNK = ("neck", "belly", "face", "right_shoulder", "left_shoulder", "right_hip", "left_hip")


@dataclass(frozen=True, slots=True, eq=False)
class PuppetJoints:
    """One person in an image.

    Attributes:
        id: stable over time; empty when whoever found the person does not track.
        pixels: (J, 2) in the body model's order, NaN where unknown.
        confidence: (J,) 0 to 1, 0 where unknown.
        hidden: (J,) whether the puppet's own parts hide the joint from the camera.
        mask: where in the image the person is, if a network has said so.
    """

    id: str
    pixels: F64
    confidence: F64
    hidden: Bools
    mask: PersonMask | None = None

    @property
    def known(self) -> Bools:
        """Which joints (J,) have a place, however doubtful."""
        return np.isfinite(self.pixels).all(axis=1)

    @property
    def sure(self) -> Bools:
        """Which joints (J,) the image surely shows where they are."""
        return self.known & ~self.hidden & (self.confidence >= MIN_SURE_CONFIDENCE)

    def move_to(self, pixels: F64) -> PuppetJoints:
        """Return the puppet with its joints at `pixels` (J, 2); its mask moves with most of them."""
        steps = (pixels - self.pixels)[self.known]
        if self.mask is None or not len(steps):
            return replace(self, pixels=pixels)
        step = np.median(steps, axis=0)
        slack = float(np.quantile(np.hypot(*(steps - step).T), SLACK_SHARE))
        return replace(self, pixels=pixels, mask=self.mask.move(step, slack))

    def swap_sides(self, model: StitchedPuppet) -> PuppetJoints:
        """Return the puppet with left called right."""
        other = list(find_other_sides(model.joint_names))
        return replace(self, pixels=self.pixels[other], confidence=self.confidence[other], hidden=self.hidden[other])


@lru_cache(maxsize=8)
def find_other_sides(names: tuple[str, ...]) -> tuple[int, ...]:
    """Return for each joint the index of that of the other side, its own for joints of the middle."""
    swapped = {"left": "right", "right": "left"}
    found = []
    for name in names:
        side, _, rest = name.partition("_")
        found.append(names.index(f"{swapped[side]}_{rest}") if side in swapped else names.index(name))
    return tuple(found)


def place_joints(
    model: StitchedPuppet,
    identity: str,
    names: Sequence[str],
    pixels: F64,
    confidence: F64,
    hidden: Sequence[str] = (),
    mask: PersonMask | None = None,
) -> PuppetJoints | None:
    """Return a puppet's joints in the body model's order, None when too few are known.

    A puppet's own joints (those with a belly) are taken as they are; a detector's shoulders, hips and head are moved to
    where puppets have them, and everybody's ankles down to where the body model has them.

    Args:
        model: the body model.
        identity: the puppet's id.
        names: of the joints, in any spelling that `image.formats.keypoints` understands.
        pixels: (K, 2), NaN where unknown.
        confidence: (K,) 0 to 1.
        hidden: names of the joints that the puppet's own parts hide.
        mask: where in the image the person is, if that is known.
    """
    flat = _load_flat_model()
    joints, certain = joints_from_keypoints(flat, Keypoints(tuple(names), pixels, np.maximum(confidence, 1e-3)))
    found = np.full((len(model.joint_names), 2), np.nan)
    weight = np.zeros(len(model.joint_names))
    behind = np.zeros(len(model.joint_names), dtype=bool)
    for name, place, sure in zip(flat.joint_names, joints, certain, strict=True):
        index = model.joint_names.index(name)
        found[index], weight[index], behind[index] = place, sure, name in hidden
    for side in ("right", "left"):
        knee, ankle = (model.joint_names.index(f"{side}_{name}") for name in ("knee", "ankle"))
        found[ankle] = found[ankle] + ANKLE_DROP * (found[ankle] - found[knee])
    weight[~np.isfinite(found).all(axis=1)] = 0.0
    made = PuppetJoints(identity, found, weight, behind, mask)
    return made if np.count_nonzero(made.known) >= MIN_PUPPET_JOINTS else None


def carry_puppets(earlier: Sequence[PuppetJoints], later: Sequence[PuppetJoints], share: float) -> list[PuppetJoints]:
    """Return the puppets at a time between or beyond two images: `share` 0 is the earlier one, 1 the later one.

    Joints move evenly, and masks with them. A puppet that only one of the images has stays where it is, if that image
    is the nearer one.
    """
    before = {puppet.id: puppet for puppet in earlier if puppet.id}
    after = {puppet.id for puppet in later if puppet.id}
    nearer_is_later = share >= 0.5
    found = []
    for puppet in later:
        known = before.get(puppet.id)
        if known is not None:
            moved = known.pixels + share * (puppet.pixels - known.pixels)
            base = puppet if nearer_is_later else known
            found.append(base.move_to(np.where(np.isfinite(moved), moved, base.pixels)))
        elif nearer_is_later:
            found.append(puppet)
    if not nearer_is_later:
        found += [puppet for puppet in earlier if puppet.id not in after]
    return found


def trunk_rows(model: StitchedPuppet) -> list[int]:
    """Return the rows of the joints of trunk and head that puppets have."""
    return [model.joint_names.index(name) for name in _TRUNK]


def list_bones(model: StitchedPuppet) -> list[tuple[int, int]]:
    """Return the rows of the two joints of every bone of the limbs, and of the lines along and across the trunk."""
    sides = [f"{side}_" for side in ("left", "right")]
    pairs = [(side + above, side + below) for side in sides for above, below in LONG_BONES]
    pairs += [("left_" + name, "right_" + name) for name in ("shoulder", "hip")]
    return [(model.joint_names.index(first), model.joint_names.index(last)) for first, last in pairs]


@lru_cache(maxsize=1)
def _load_flat_model() -> DeformableStructures:
    return DeformableStructures.load("neutral", 14)


@lru_cache(maxsize=3)
def find_average_joints(model: StitchedPuppet) -> F64:
    """Return the joints (J, 3) m of the average body."""
    return np.asarray(model.joints(model.vertices(model.rest_state())))


def measure_distance_by_size(model: StitchedPuppet, rays: F64, sure: Bools, min_bones: int = 1) -> float:
    """Return how far away, in metres, a person of average size is; NaN where fewer than `min_bones` tell.

    Args:
        model: the body model.
        rays: (J, 3) unit vectors from the camera to the joints.
        sure: (J,) joints whose rays count.
        min_bones: least number of bones between them.
    """
    names, average = model.joint_names, find_average_joints(model)
    found = []
    for side in ("left", "right"):
        for above, below in LONG_BONES:
            first, last = names.index(f"{side}_{above}"), names.index(f"{side}_{below}")
            if sure[first] and sure[last]:
                angle = float(np.linalg.norm(rays[first] - rays[last]))
                found.append(float(np.linalg.norm(average[first] - average[last])) / max(angle, 1e-6))
    return float(np.quantile(found, LONG_SHARE)) if len(found) >= min_bones else float("nan")
