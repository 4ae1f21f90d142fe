# SPDX-License-Identifier: Apache-2.0
"""The loop of flowing puppets as in the thesis: particle swarms in every image, propagated along the flow.

Thesis, video chapter, "Inference" and Fig. 8. Propagation of the best particles of each image to its neighbours
alternates with a search in each image. It is the reference against which the default is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.image.formats.keypoints import joints_from_keypoints
from flowing_puppet_ros.image.thesis_loop.energy import FlowingEnergy, FrameEvidence, propagate_joints
from flowing_puppet_ros.image.thesis_loop.settings import EnergySettings, LoopSettings
from flowing_puppet_ros.image.thesis_loop.upper_body import PARTS, UpperBodyParameters
from flowing_puppet_ros.image.thesis_loop.wrist_proposals import WristProposals
from flowing_puppet_ros.inference.swarm import Swarm, resample, search
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.shape import View

STAGES: tuple[tuple[str, ...], ...] = (PARTS[:4], PARTS)
"""Parts that move in each stage of the hierarchical search: torso, head and right arm, then all."""

INITIAL_NOISE = {"angle": 0.15, "length": 0.01, "shape": 0.3, "center": 0.0, "scale": 0.03}
"""Standard deviations of the first particles around the detector's poses (thesis: "adding noise"): rad, m, standard
deviations, px, log of the scale."""

MAX_MODES = 10  # poses of the detector to start from
AGREEMENT_DISTANCE_M = 0.1  # within which particles agree on a joint


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """Start of the search in one image: `joints` (J, 2) px as tracked, and `scale` px/m."""

    joints: F64
    scale: float


@dataclass(slots=True, eq=False)
class _FrameParticles:
    """One image in a run: particles, `legs` (J, 2) px, wrist proposals, and the vector `start` (D,) of the bounds."""

    swarm: Swarm
    legs: F64
    proposal: WristProposals | None
    start: F64


class ThesisLoop:
    """The loop over consecutive images of one person."""

    def __init__(self, model: DeformableStructures, view: View, settings: LoopSettings, energy: EnergySettings) -> None:
        """Prepare the parameters; `view` is the side of the person that the camera sees."""
        self.body = UpperBodyParameters(model, view)
        self.settings, self.energy_settings = settings, energy

    def run(self, starts: Sequence[InitialPose], frames: Sequence[FrameEvidence]) -> tuple[F64, F64, F64]:
        """Search; return joints (T, J, 2) px, the agreement of the particles (T, J) in [0, 1], and the energy (T,).

        Of several seeds, the run of minimum total energy counts.
        """
        energy = FlowingEnergy(self.body, frames, self.energy_settings)
        best: tuple[float, list[_FrameParticles]] | None = None
        for number in range(self.settings.restarts):
            rng = np.random.default_rng([self.settings.seed, number])
            images = [self._initialise(t, start, energy, rng) for t, start in enumerate(starts)]
            self._propagate(images, energy)
            for _ in range(self.settings.rounds):
                for t, image in enumerate(images):
                    self._search(t, image, energy, rng)
                self._propagate(images, energy)
            total = sum(float(image.swarm.energy.min()) for image in images)
            if best is None or total < best[0]:
                best = total, images
        assert best is not None
        return self._summarise(best[1])

    def _initialise(
        self, t: int, start: InitialPose, energy: FlowingEnergy, rng: np.random.Generator
    ) -> _FrameParticles:
        """Draw the first particles: the detector's poses with noise, half of them with a wrist from the hand maps."""
        poses = self._initial_poses(start, energy.frames[t])
        vectors = self.body.to_vectors(poses, np.full(len(poses), start.scale))
        bounds, legs = self.body.make_bounds(vectors[0]), self.body.leg_offsets(start.joints)
        hands = energy.frames[t].hands
        neck = start.joints[self.body.model.joint_names.index("neck")]
        proposal = None
        if hands is not None and self.energy_settings.hand_weight > 0:
            proposal = WristProposals.of(self.body, bounds, legs, hands, neck, start.scale)
        particles = vectors[np.arange(self.settings.particles) % len(vectors)]
        noise = np.concatenate(
            [np.full(part.stop - part.start, INITIAL_NOISE[name]) for name, part in self.body.slices().items()]
        )
        fresh = slice(min(len(vectors), len(particles) // 2), None)
        particles[fresh] += noise * rng.standard_normal(particles[fresh].shape)
        if proposal is not None:
            drawn = slice((fresh.start + len(particles)) // 2, None)
            particles[drawn] = proposal(particles[drawn], rng)
        particles = bounds.clip(particles)
        return _FrameParticles(Swarm.of(particles, energy.evaluate(t, particles, legs)), legs, proposal, vectors[0])

    def _initial_poses(self, start: InitialPose, evidence: FrameEvidence) -> F64:
        """Return the tracked joints, then the detector's poses, (K, J, 2) px; what a pose lacks is as tracked."""
        poses = [start.joints]
        for keypoints, _ in evidence.found.modes(MAX_MODES) if evidence.found is not None else ():
            joints, _ = joints_from_keypoints(self.body.model, keypoints)
            poses.append(np.where(np.isfinite(joints), joints, start.joints))
        return np.array(poses)

    def _search(self, t: int, image: _FrameParticles, energy: FlowingEnergy, rng: np.random.Generator) -> None:
        """Run both stages of the swarm, then resample the particles by their energy; the best one stays."""
        bounds = self.body.make_bounds(image.start)
        evaluate = partial(energy.evaluate, t, legs=image.legs)
        for parts in STAGES:
            search(
                image.swarm, evaluate, bounds, self.settings.iterations, rng, self.body.select_values(parts),
                image.proposal, self.settings.jump_probability,
            )  # fmt: skip
        swarm = image.swarm
        best = int(swarm.best_energy.argmin())
        drawn = resample(swarm, self.settings.temperature, rng)
        worst = int(drawn.energy.argmax())
        drawn.particles[worst], drawn.energy[worst] = swarm.best[best], swarm.best_energy[best]
        image.swarm = Swarm.of(drawn.particles, drawn.energy)

    def _propagate(self, images: Sequence[_FrameParticles], energy: FlowingEnergy) -> None:
        """Propagate the best particles of each image forward through the clip, then backward; keep the best of all."""
        count = len(images)
        if self.settings.max_propagated == 0:
            return
        for step, order in ((1, range(count - 1)), (-1, range(count - 1, 0, -1))):
            for t in order:
                self._propagate_to_neighbour(t, step, images, energy)

    def _propagate_to_neighbour(
        self, t: int, step: int, images: Sequence[_FrameParticles], energy: FlowingEnergy
    ) -> None:
        flow = energy.flow_to_neighbour(t, step)
        if flow is None:
            return
        here, there = images[t], images[t + step]
        chosen = here.swarm.particles[np.argsort(here.swarm.energy, kind="stable")[: self.settings.max_propagated]]
        joints, scale = self.body.to_joints(chosen, here.legs)
        contours, _ = self.body.model.puppets_from_joints(joints, scale, self.body.view, [])
        moved = self.body.to_vectors(propagate_joints(self.body, flow, joints, contours), scale)
        moved = self.body.make_bounds(there.start).clip(moved)
        particles = np.concatenate([there.swarm.particles, moved])
        energies = np.concatenate([there.swarm.energy, energy.evaluate(t + step, moved, there.legs)])
        kept = np.argsort(energies, kind="stable")[: self.settings.particles]
        there.swarm = Swarm.of(particles[kept], energies[kept])

    def _summarise(self, images: Sequence[_FrameParticles]) -> tuple[F64, F64, F64]:
        """Return the best joints of each image, the agreement of its particles on them, and its energy."""
        joints, agreement, energies = [], [], []
        for image in images:
            swarm = image.swarm
            best = int(swarm.energy.argmin())
            places, scale = self.body.to_joints(swarm.particles, image.legs)
            weight = np.exp((swarm.energy[best] - swarm.energy) / self.settings.temperature)
            near = np.linalg.norm(places - places[best], axis=2) < AGREEMENT_DISTANCE_M * scale[best]
            joints.append(places[best])
            agreement.append(np.minimum((weight[:, None] * near).sum(axis=0) / weight.sum(), 1.0))
            energies.append(float(swarm.energy[best]))
        return np.array(joints), np.array(agreement), np.array(energies)
