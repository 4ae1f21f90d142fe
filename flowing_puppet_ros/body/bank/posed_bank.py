# SPDX-License-Identifier: Apache-2.0
"""A bank of people who sit, crouch, kneel or bend, drawn from the model.

The model draws hardly anybody who sits. So bodies that it draws are leant, their thighs and shanks swung to where
those of such people are, and a few Gauss-Newton steps under the model's priors let the flesh follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flowing_puppet_ros.body.bank.body_bank import BodyBank, turn_bodies
from flowing_puppet_ros.body.bank.upright_bank import SHAPE_SCALE
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread, parallel_map, usable_threads

type Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class PosedWay:
    """How some people are, in ranges of degrees.

    Attributes:
        count: of them in the bank.
        lean: of the trunk ahead.
        thigh: of both thighs, or of the left and of the right one, ahead of straight down.
        aside: of the thighs to their sides.
        shank: of both shanks, or of the left and of the right one, ahead of straight down.
        feet: height of the soles over the floor, metres.
    """

    count: int
    lean: Range
    thigh: tuple[Range, Range]
    aside: Range
    shank: tuple[Range, Range]
    feet: Range = (0.0, 0.0)


def _alike(low: float, high: float) -> tuple[Range, Range]:
    return (low, high), (low, high)


WAYS = {
    "seated": PosedWay(45, (-22, 30), _alike(76, 100), (0, 24), _alike(-30, 30)),
    "seated, feet up": PosedWay(8, (-20, 15), _alike(78, 98), (0, 15), _alike(-15, 40), feet=(0.03, 0.2)),
    "on the floor": PosedWay(8, (-25, 20), _alike(80, 98), (0, 25), _alike(60, 95)),
    "knees up": PosedWay(9, (-15, 30), _alike(115, 150), (0, 22), _alike(25, 65)),
    "squatting": PosedWay(10, (5, 50), _alike(85, 125), (0, 30), _alike(-40, -10)),
    "on the heels": PosedWay(6, (-5, 30), _alike(50, 80), (0, 20), _alike(-95, -65)),
    "on one knee": PosedWay(6, (-5, 35), ((75, 95), (-10, 20)), (0, 15), ((-15, 12), (-95, -70))),
    "on both knees": PosedWay(5, (-5, 25), _alike(-10, 15), (0, 15), _alike(-98, -75)),
    "bent": PosedWay(16, (28, 90), _alike(-12, 15), (0, 15), _alike(-22, 8)),
}
KNEELING_RAD = -np.radians(60.0)  # of a shank, from which on the foot lies as it does
MIN_STRETCHED, MAX_LEAN_RAD = 0.75, np.radians(35.0)
"""Height of the hips over the lower ankle, for each of the legs' length, and lean of the trunk, of who stands."""
SOFTEN = RefineWeights(stitch=0.1, pose=1e-6, shape=1e-3, pairwise=5e-7, iterations=8)
TARGET_WEIGHT = 0.02  # of the joints, against the priors
SIDES = ("left", "right")


@lru_cache(maxsize=3)
@one_blas_thread()
def make_posed_bank(model: StitchedPuppet) -> BodyBank:
    """Draw the bank; made once for a model."""
    rng = np.random.default_rng(0)
    bodies: list[tuple[BodyState, np.ndarray]] = []
    gauss_newton = GaussNewton(model)
    for way in WAYS.values():
        drawn = _draw_plain(model, rng, way.count)
        targets = [_swing(model, body, way, rng) for body in drawn]
        feet = rng.uniform(*way.feet, way.count)

        def soften(pair: tuple[BodyState, JointTargets]) -> BodyState:
            return gauss_newton.run(pair[0], None, pair[1], SOFTEN)

        for state, height in zip(parallel_map(soften, targets, usable_threads(2)), feet, strict=True):
            vertices = model.vertices(state)
            joints = dict(zip(model.joint_names, model.joints(vertices), strict=True))
            hips = (joints["left_hip"] + joints["right_hip"]) / 2
            down = np.array([-hips[0], -hips[1], height - vertices[:, 2].min()])
            moved = BodyState(state.center + down, state.rotation, state.pose, state.shape)
            bodies.append((moved, vertices + down))
    return turn_bodies(model, bodies)


def is_posed(joints: Mapping[str, np.ndarray]) -> bool:
    """Return whether somebody with these joints (3,) m is as those of the bank, not as who stands or walks."""
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    trunk = (joints["left_shoulder"] + joints["right_shoulder"]) / 2 - hips
    legs = [
        np.linalg.norm(joints[f"{side}_hip"] - joints[f"{side}_knee"])
        + np.linalg.norm(joints[f"{side}_knee"] - joints[f"{side}_ankle"])
        for side in SIDES
    ]
    stretched = (hips[2] - min(joints[f"{side}_ankle"][2] for side in SIDES)) / max(legs)
    leans = trunk[2] < np.cos(MAX_LEAN_RAD) * np.linalg.norm(trunk)
    return bool(stretched < MIN_STRETCHED or leans)


def _draw_plain(model: StitchedPuppet, rng: np.random.Generator, count: int) -> list[BodyState]:
    """Draw bodies whose hands are below the neck."""
    found: list[BodyState] = []
    neck, wrists = model.joint_names.index("neck"), [model.joint_names.index(f"{side}_wrist") for side in SIDES]
    while len(found) < count:
        many = model.sample_many(rng, 2 * count, shape_scale=SHAPE_SCALE)
        for arrays in zip(many.center, many.rotation, many.pose, many.shape, model.vertices(many), strict=True):
            joints = model.joints(arrays[4])
            if joints[wrists, 2].max() < joints[neck, 2]:
                found.append(BodyState(*arrays[:4]))
    return found[:count]


def _swing(
    model: StitchedPuppet, state: BodyState, way: PosedWay, rng: np.random.Generator
) -> tuple[BodyState, JointTargets]:
    """Return a body that is leant, its limbs swung, and where its joints are then."""
    limbs = _Limbs(model, state)
    limbs.turn("torso", "pelvis", so3.exp(np.radians([rng.normal(0, 3), rng.uniform(*way.lean), 0.0])))
    for side, sign, thigh, shank in zip(SIDES, (1, -1), way.thigh, way.shank, strict=True):
        aside, below = np.radians(rng.uniform(*way.aside)) * sign, np.radians(rng.uniform(*shank))
        limbs.aim(f"{side}_upper_leg", f"{side}_hip", f"{side}_knee", _point(np.radians(rng.uniform(*thigh)), aside))
        limbs.aim(f"{side}_lower_leg", f"{side}_knee", f"{side}_ankle", _point(below, 0.3 * aside))
        if below < KNEELING_RAD:
            limbs.aim(f"{side}_foot", f"{side}_ankle", f"{side}_toe", _point(below, 0.0))
    weight = np.zeros(len(model.joint_names))
    chosen = (
        "pelvis",
        "neck",
        *(f"{side}_{name}" for side in SIDES for name in ("hip", "knee", "ankle", "elbow", "wrist")),
    )
    weight[[model.joint_names.index(name) for name in chosen]] = TARGET_WEIGHT
    return limbs.state, JointTargets(limbs.joints, weight)


def _point(ahead: float, aside: float) -> np.ndarray:
    """Return the direction (3,) so far ahead of straight down, turned so far to the left."""
    along = np.array([np.sin(ahead), 0.0, -np.cos(ahead)])
    return np.asarray(so3.exp(np.array([aside * np.cos(ahead), 0.0, aside * np.sin(ahead)])) @ along)


class _Limbs:
    """A body whose limbs are turned about their joints, everything farther out with them."""

    def __init__(self, model: StitchedPuppet, state: BodyState) -> None:
        self._model = model
        self.state = BodyState(state.center.copy(), state.rotation.copy(), state.pose, state.shape)
        self.joints = model.joints(model.vertices(state))

    def turn(self, part: str, joint: str, turn: np.ndarray) -> None:
        """Turn a part and all that hangs on it by `turn` (3, 3) about a joint."""
        tree, state = self._model.tree, self.state
        rows = {tree.names.index(part)}
        for number, parent in enumerate(tree.parents):
            if parent in rows:
                rows.add(number)
        middle = self.joints[self._model.joint_names.index(joint)].copy()
        for row in rows:
            state.center[row] = middle + turn @ (state.center[row] - middle)
            state.rotation[row] = turn @ state.rotation[row]
        self.joints = self._model.joints(self._model.vertices(state))

    def aim(self, part: str, near: str, far: str, direction: np.ndarray) -> None:
        """Turn a part so that its far joint is in a direction (3,) from its near one."""
        names = self._model.joint_names
        now = self.joints[names.index(far)] - self.joints[names.index(near)]
        now = now / np.linalg.norm(now)
        axis = np.cross(now, direction)
        sine = float(np.linalg.norm(axis))
        if sine > 1e-9:
            self.turn(part, near, so3.exp(axis / sine * np.arctan2(sine, now @ direction)))
