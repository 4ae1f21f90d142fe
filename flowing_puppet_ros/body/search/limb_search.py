# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of limbs: an arm or a leg is searched anew in what the rest of the body leaves of the cloud.

The energy asks whether the body lies on the cloud, not whether the cloud is covered, so that two limbs may share the
cloud of one. A limb that only sees the points which nothing else explains cannot; and of the many places that
particles find for it the one is taken that covers them best. Where nothing is left, a limb hangs as it usually does.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.proposals import Proposer
from flowing_puppet_ros.body.search.schedule import limb_stages
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid
from flowing_puppet_ros.model import rotation as so3
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.model.tree import PartTree

SINGLE_LIMBS = 4
ARM = ("shoulder", "upper_arm", "lower_arm", "hand")
LEG = ("upper_leg", "lower_leg", "foot")
# Metres from the rest of the body at which a cloud point is left to the limb.
EXPLAINED = 0.03
# Share of the cloud that must be left for a limb: a person's arm has about 9 %, a leg 17 %.
LEAST_LEFT = 0.01
FAR = 0.1  # metres: what is farther counts as this far
# How many ways to hang each part are tried, how many particles go on, and for how many rounds.
ATTACHMENTS, PARTICLES, ITERATIONS = 120, 30, 14


def limb_groups(tree: PartTree) -> tuple[tuple[int, ...], ...]:
    """Parts from the trunk outwards: of each of the `SINGLE_LIMBS` legs and arms, both legs, both arms, all limbs."""
    left_leg, right_leg, left_arm, right_arm = (
        tuple(tree.index(f"{side}_{name}") for name in names) for names in (LEG, ARM) for side in ("left", "right")
    )
    legs, arms = left_leg + right_leg, left_arm + right_arm
    return left_leg, right_leg, left_arm, right_arm, legs, arms, legs + arms


class LimbSearch:
    """Searches limbs of one model."""

    def __init__(self, model: StitchedPuppet, search: BodyParticleSearch, proposer: Proposer) -> None:
        self._model = model
        self._search = search
        self._proposer = proposer

    def run(
        self, body: BodyState, limbs: tuple[int, ...], cloud: Cloud, grid: CloudGrid, rng: np.random.Generator
    ) -> BodyState | None:
        """Search limbs anew in what the rest of the body leaves of the cloud.

        Args:
            body: the limbs as they are is among the first particles; its other parts stay.
            limbs: parts, each after the one that it hangs on.
            cloud: what to fit.
            grid: of the whole cloud.
            rng: source of all randomness.

        Returns:
            The body, or None when nearly nothing of the cloud is left.
        """
        own = np.isin(self._model.part_of_vertex, limbs)
        rest = cKDTree(self._model.vertices(body)[~own])
        left = ~np.isfinite(rest.query(cloud.points, distance_upper_bound=EXPLAINED)[0])
        if np.count_nonzero(left) < LEAST_LEFT * len(left):
            return None
        points = cloud.points[left]
        grids = dict.fromkeys(limbs, CloudGrid.build(points, cloud.normals[left]))
        start, none, stages = (
            self._attached(body, limbs, rng),
            JointTargets.none(self._model),
            limb_stages(self._model.tree),
        )
        found = self._search.optimise(start, grid, none, stages, ITERATIONS, rng, own=grids, keep=PARTICLES)
        ends = [part for part in limbs if not self._model.tree.children(part)]
        bodies = [found.state, *(mode for end in ends for mode in self._search.modes(found, end))]
        return min(bodies, key=lambda state: _gap(self._model.vertices(state)[own], points, cloud))

    def mean_limb(self, body: BodyState, limbs: tuple[int, ...]) -> BodyState:
        """The body with limbs at the mean of their Gaussians (Eq. 49): where they hang when the cloud hides them."""
        model = self._model
        state = BodyState(body.center.copy(), body.rotation.copy(), body.pose.copy(), body.shape)
        for part in limbs:
            parent, interface, mean = (
                model.tree.parents[part],
                model.interfaces[part - 1],
                model.pairwise[part - 1].mean,
            )
            own = mean[3 + model.pose_count(parent) :]
            state.pose[part, : len(own)] = own
            rotation = state.rotation[parent] @ so3.exp(mean[:3])
            above = model.part_mesh(
                parent, state.center[parent], state.rotation[parent], state.pose[parent], state.shape[parent]
            )
            local = model.local_vertices(part, state.pose[part], state.shape[part])[interface.child_index]
            state.rotation[part] = rotation
            state.center[part] = above[interface.parent_index].mean(axis=0) - rotation @ local.mean(axis=0)
        return state

    def _attached(self, body: BodyState, limbs: tuple[int, ...], rng: np.random.Generator) -> list[Particles]:
        """The body's parts, and the limbs' also hanging on it in many ways."""
        start = states_to_particles(self._model, [body])
        for part in limbs:
            above = start[self._model.tree.parents[part]]
            parents = above.take(np.arange(ATTACHMENTS) % len(above))
            start[part] = Particles.join(
                [start[part], self._proposer.attach_to_parent(part, parents, start[part].shape[0], rng)]
            )
        return start


def _gap(limb: np.ndarray, points: np.ndarray, cloud: Cloud) -> float:
    """Mean distance from a limb's vertices (V, 3) to the cloud and back from the points (M, 3) that it should cover."""
    there = cloud.nearest.query(limb)[0]
    back = cKDTree(limb).query(points, distance_upper_bound=FAR)[0]
    return float(np.minimum(there, FAR).mean() + np.minimum(back, FAR).mean())
