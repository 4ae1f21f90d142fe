# SPDX-License-Identifier: Apache-2.0
"""The search for a body in a cloud from one side: bodies judged whole, from a bank of poses, and limbs hung anew.

The thesis's data term asks every part for itself whether it lies on the cloud. One side of a body answers that badly:
the far half of every part must not lie on it, and parts behind others have no cloud at all. Here hypotheses are judged
as whole bodies by three questions. Is all of the cloud covered? Does anything stand where the sensor looked through?
Are the joints turned as people turn them? The last alone places what nobody saw.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flowing_puppet_ros.body.energy import JointTargets
from flowing_puppet_ros.body.geometry import farthest_points
from flowing_puppet_ros.body.particles import Particles, particles_of, state_of
from flowing_puppet_ros.body.points import PartPoints, PointSet
from flowing_puppet_ros.body.proposals import Proposer
from flowing_puppet_ros.body.refine import Refiner, RefineWeights
from flowing_puppet_ros.body.view_cloud import ViewCloud
from flowing_puppet_ros.evidence.one_sided import distances
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

BANK, YAWS, STARTS, KEPT = 200, 16, 6, 3
LIMB_SAMPLES, LIMB_ROUNDS = 600, 3
TARGETS = 250
"""Points of the cloud that must be covered."""
SURFACE = {
    "torso": 56, "head": 20, "shoulder": 14, "upper_arm": 18, "lower_arm": 16, "hand": 10,
    "upper_leg": 26, "lower_leg": 22, "foot": 12,
}  # fmt: skip
"""Surface points a part, about one to 50 square centimetres."""
CHAINS = (("shoulder", "upper_arm", "lower_arm", "hand"), ("upper_leg", "lower_leg", "foot"))
PRIOR = 1e-4
"""Metres of mean distance that a squared Mahalanobis distance of 1 of a joint's rotation is worth."""
JOINT_RIDGE = 0.05
"""Radians added to the spread of a joint's rotation."""
TRIED = 0.003
"""Metres by which a limb may look worse than the present one before Gauss-Newton and still be tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Covered:
    """Whole bodies against a view.

    Attributes:
        cost: (P,) metres.
        distance: (P, M) metres from the cloud's targets to the body.
    """

    cost: np.ndarray
    distance: np.ndarray


class ViewSearch:
    """Finds bodies of one model in clouds from one side."""

    def __init__(
        self, model: StitchedPuppet, points: tuple[PartPoints, ...], proposer: Proposer, refiner: Refiner
    ) -> None:
        self._model = model
        self._proposer = proposer
        self._refiner = refiner
        sizes = [SURFACE[name.removeprefix("left_").removeprefix("right_")] for name in model.tree.names]
        self._share = np.array(sizes) / sum(sizes)
        self._surface = [_first(part.surface, size) for part, size in zip(points, sizes, strict=True)]
        self._normals = [part.normals[:size] for part, size in zip(points, sizes, strict=True)]
        spread = [np.linalg.inv(pair.covariance[:3, :3] + JOINT_RIDGE**2 * np.eye(3)) for pair in model.pairwise]
        self._joints = [(pair.mean[:3], precision) for pair, precision in zip(model.pairwise, spread, strict=True)]
        self._limbs = [
            tuple(model.tree.index(f"{side}_{name}") for name in chain)
            for chain in CHAINS
            for side in ("left", "right")
        ]
        self._bank: list[Particles] | None = None

    def run(
        self, cloud: ViewCloud, rng: np.random.Generator, steps: int, progress: Callable[[float], None]
    ) -> BodyState:
        """Find the body of a cloud in metres, z up, of which nothing is known but that it stands, sits or so.

        Args:
            cloud: the cloud.
            rng: source of all randomness.
            steps: Gauss-Newton steps of the finish.
            progress: called with the fraction done.
        """
        targets = cloud.points[farthest_points(cloud.points, TARGETS)]
        found = []
        for turn, body in enumerate(self._starts(cloud, targets)):
            body = self._with_better_limbs(body, cloud, targets, rng)
            body = self.finish(body, cloud, RefineWeights(sigma_start=0.08, iterations=steps))
            found.append((self._cost(body, cloud, targets), body))
            progress((turn + 1) / KEPT)
        return min(found, key=lambda pair: pair[0])[1]

    def finish(self, body: BodyState, cloud: ViewCloud, weights: RefineWeights) -> BodyState:
        """Gauss-Newton on the surface and the free space."""
        none = JointTargets.none(self._model)
        return self._refiner.run(body, cloud, none, weights, terms=[cloud.free_space])

    def _starts(self, cloud: ViewCloud, targets: np.ndarray) -> list[BodyState]:
        """The best of the bank's bodies in the best yaws after a few steps of Gauss-Newton."""
        bodies = self._placed(self._turned_bank(), cloud, targets)
        cost = self._judge(bodies, cloud, targets, range(len(bodies))).cost.reshape(YAWS, BANK)
        best = cost.argmin(axis=1)
        chosen = []
        for yaw in np.argsort(cost.min(axis=1), kind="stable")[:STARTS]:
            row = np.full(len(bodies), yaw * BANK + best[yaw])
            body = self.finish(
                state_of(self._model, bodies, row), cloud, RefineWeights(sigma_start=0.2, sigma_end=0.08, iterations=8)
            )
            chosen.append((self._cost(body, cloud, targets), body))
        chosen.sort(key=lambda pair: pair[0])
        return [body for _, body in chosen[:KEPT]]

    def _turned_bank(self) -> list[Particles]:
        """Per part the bank's bodies in every yaw; the same for every cloud."""
        if self._bank is None:
            rng = np.random.default_rng(0)
            bank = particles_of(self._model, [self._model.sample(rng, shape_scale=0.0) for _ in range(BANK)])
            turns = so3.exp(np.array([0.0, 0.0, 2 * np.pi / YAWS]) * np.arange(YAWS)[:, None])
            self._bank = [Particles.join([_turned(group, turn) for turn in turns]) for group in bank]
        return self._bank

    def _placed(self, bodies: list[Particles], cloud: ViewCloud, targets: np.ndarray) -> list[Particles]:
        """Move each body so that the mean of its surface that faces the sensor is the cloud's."""
        points, normals = self._points(bodies, range(len(bodies)))
        forward = targets.mean(axis=0) - cloud.view.viewpoint
        facing = (normals @ forward < 0)[:, :, None]
        shift = targets.mean(axis=0) - (points * facing).sum(axis=1) / np.maximum(facing.sum(axis=1), 1)
        return [Particles(group.center + shift, group.rotation, group.pose, group.shape) for group in bodies]

    def _with_better_limbs(
        self, body: BodyState, cloud: ViewCloud, targets: np.ndarray, rng: np.random.Generator
    ) -> BodyState:
        """Hang every limb anew in many ways, keep what is better after Gauss-Newton, until nothing is."""
        cost = self._cost(body, cloud, targets)
        for _ in range(LIMB_ROUNDS):
            changed = False
            for limb in self._limbs:
                hung = self._hung(body, limb, cloud, targets, cost, rng)
                if hung is None:
                    continue
                hung = self.finish(hung, cloud, RefineWeights(sigma_start=0.06, sigma_end=0.04, iterations=5))
                new = self._cost(hung, cloud, targets)
                if new < cost:
                    body, cost, changed = hung, new, True
            if not changed:
                break
        return body

    def _hung(
        self,
        body: BodyState,
        limb: tuple[int, ...],
        cloud: ViewCloud,
        targets: np.ndarray,
        cost: float,
        rng: np.random.Generator,
    ) -> BodyState | None:
        """The body with the best of many samples of one limb, None when all look worse than what it has."""
        groups = particles_of(self._model, [body])
        rest = [part for part in range(len(groups)) if part not in limb]
        without = self._judge(groups, cloud, targets, rest)
        for part in limb:
            above = groups[self._model.tree.parents[part]]
            above = above if len(above) > 1 else above.take(np.zeros(LIMB_SAMPLES, dtype=np.int64))
            groups[part] = self._proposer.hang(part, above, body.shape[part], rng)
        judged = self._judge(groups, cloud, targets, limb, without.distance)
        total = judged.cost + without.cost - without.distance.mean()
        best = int(total.argmin())
        if total[best] > cost + TRIED:
            return None
        pick = np.zeros(len(groups), dtype=np.int64)
        pick[list(limb)] = best
        return state_of(self._model, groups, pick)

    def _cost(self, body: BodyState, cloud: ViewCloud, targets: np.ndarray) -> float:
        groups = particles_of(self._model, [body])
        return float(self._judge(groups, cloud, targets, range(len(groups))).cost[0])

    def _judge(
        self,
        bodies: list[Particles],
        cloud: ViewCloud,
        targets: np.ndarray,
        parts: Sequence[int],
        already: np.ndarray | float = np.inf,
    ) -> Covered:
        """Judge bodies (row p of every part is body p) by some of their parts.

        `already` (1, M) is how far the targets are from the other parts.
        """
        points, normals = self._points(bodies, parts)
        misfit, facing = cloud.view.misfit(points, normals)
        distance = np.minimum(distances(targets, points, facing), already)
        cost = distance.mean(axis=1) + self._share[list(parts)].sum() * misfit
        for part in parts:
            if part:
                mean, precision = self._joints[part - 1]
                above = bodies[self._model.tree.parents[part]].rotation.transpose(0, 2, 1)
                gap = so3.log(above @ bodies[part].rotation) - mean
                cost = cost + PRIOR * ((gap @ precision) * gap).sum(axis=1)
        return Covered(cost, distance)

    def _points(self, bodies: list[Particles], parts: Sequence[int]) -> tuple[np.ndarray, ...]:
        """Surface points (P, K, 3) and their normals of some parts."""
        points = [self._surface[part].world(bodies[part]) for part in parts]
        normals = [self._normals[part] @ bodies[part].rotation.transpose(0, 2, 1) for part in parts]
        return np.concatenate(points, axis=1), np.concatenate(normals, axis=1)


def _first(points: PointSet, count: int) -> PointSet:
    return PointSet(points.mean[:count], points.pose_basis[:count], points.shape_basis[:count])


def _turned(group: Particles, turn: np.ndarray) -> Particles:
    return Particles(group.center @ turn.T, turn @ group.rotation, group.pose, group.shape)
