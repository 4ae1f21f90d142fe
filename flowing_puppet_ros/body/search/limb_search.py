# SPDX-License-Identifier: Apache-2.0
"""Searches an arm or a leg again, in the part of the cloud that the rest of the body does not explain.

The energy asks whether the body lies on the cloud, not whether the cloud is covered, so two limbs may share the cloud
of one. A limb that only sees unexplained points cannot, and of the many poses that its particles find, the one that
covers these points best is taken. Where nothing is left, the limb goes to the mean of its Gaussians.
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

SINGLE_LIMBS = 4  # groups of `limb_groups` that are one limb, the first ones
# Parts of a limb from the trunk outwards, without the side.
ARM_PARTS = ("shoulder", "upper_arm", "lower_arm", "hand")
LEG_PARTS = ("upper_leg", "lower_leg", "foot")
# Distance to the rest of the body up to which a cloud point is explained by it.
MAX_EXPLAINED_DISTANCE_M = 0.03
# Share of the cloud that must be left for a limb: a person's arm has about 9 %, a leg 17 %.
MIN_UNEXPLAINED_SHARE = 0.01
MAX_GAP_POINTS = 400  # vertices and cloud points by which a limb's poses are compared
MAX_GAP_M = 0.1  # larger distances count as this one
# Poses in which each part is attached to its parent, particles of them that are kept, and rounds of the search.
ATTACHMENTS, PARTICLES, ITERATIONS = 60, 15, 8


def limb_groups(tree: PartTree) -> tuple[tuple[int, ...], ...]:
    """Return the parts of each leg and arm, of both legs, both arms and all limbs, each from the trunk outwards."""
    left_leg, right_leg, left_arm, right_arm = (
        tuple(tree.index(f"{side}_{name}") for name in names)
        for names in (LEG_PARTS, ARM_PARTS)
        for side in ("left", "right")
    )
    legs, arms = left_leg + right_leg, left_arm + right_arm
    return left_leg, right_leg, left_arm, right_arm, legs, arms, legs + arms


class LimbSearch:
    """The search for limbs of one model."""

    def __init__(self, model: StitchedPuppet, search: BodyParticleSearch, proposer: Proposer) -> None:
        self._model = model
        self._search = search
        self._proposer = proposer

    def run(
        self, body: BodyState, limbs: tuple[int, ...], cloud: Cloud, grid: CloudGrid, rng: np.random.Generator
    ) -> BodyState | None:
        """Search limbs again in the part of the cloud that the rest of the body does not explain.

        Args:
            body: its limbs are among the first particles; its other parts stay.
            limbs: parts, each after its parent.
            cloud: the cloud to fit.
            grid: of the whole cloud.
            rng: source of all randomness.

        Returns:
            The body, or None when nearly nothing of the cloud is left.
        """
        own = np.isin(self._model.part_of_vertex, limbs)
        rest = cKDTree(self._model.vertices(body)[~own])
        left = ~np.isfinite(rest.query(cloud.points, distance_upper_bound=MAX_EXPLAINED_DISTANCE_M)[0])
        if np.count_nonzero(left) < MIN_UNEXPLAINED_SHARE * len(left):
            return None
        points = cloud.points[left]
        grids = dict.fromkeys(limbs, CloudGrid.build(points, cloud.normals[left]))
        start, none, stages = (
            self._attach_limbs(body, limbs, rng),
            JointTargets.none(self._model),
            limb_stages(self._model.tree),
        )
        found = self._search.optimise(
            start, grid, none, stages, ITERATIONS, rng, part_grids=grids, max_particles=PARTICLES
        )
        ends = [part for part in limbs if not self._model.tree.children(part)]
        bodies = [found.state, *(mode for end in ends for mode in self._search.extract_modes(found, end))]
        return min(bodies, key=lambda state: _limb_gap(self._model.vertices(state)[own], points, cloud))

    def pose_limb_at_mean(self, body: BodyState, limb: tuple[int, ...]) -> BodyState:
        """Return the body with a limb at the mean of its Gaussians (Eq. 49), for a limb that the cloud hides."""
        model = self._model
        state = BodyState(body.center.copy(), body.rotation.copy(), body.pose.copy(), body.shape)
        for part in limb:
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

    def _attach_limbs(self, body: BodyState, limbs: tuple[int, ...], rng: np.random.Generator) -> list[Particles]:
        """Return the body's parts as particles, those of the limbs also attached to their parents in many poses."""
        start = states_to_particles(self._model, [body])
        for part in limbs:
            above = start[self._model.tree.parents[part]]
            parents = above.take(np.arange(ATTACHMENTS) % len(above))
            start[part] = Particles.join(
                [start[part], self._proposer.attach_to_parent(part, parents, start[part].shape[0], rng)]
            )
        return start


def _limb_gap(limb: np.ndarray, points: np.ndarray, cloud: Cloud) -> float:
    """Return the mean distance of a limb's vertices (V, 3) to the cloud plus that of the points (M, 3) to the limb.

    Some hundreds of each are enough to compare poses.
    """
    points, limb = (places[:: -(-len(places) // MAX_GAP_POINTS)] for places in (points, limb))
    to_cloud = cloud.nearest.query(limb)[0]
    to_limb = cKDTree(limb).query(points, distance_upper_bound=MAX_GAP_M)[0]
    return float(np.minimum(to_cloud, MAX_GAP_M).mean() + np.minimum(to_limb, MAX_GAP_M).mean())
