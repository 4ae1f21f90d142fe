# SPDX-License-Identifier: Apache-2.0
"""The fit of a Stitched Puppet to a cloud: search, the body turned around, finish, confidences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from flowing_puppet_ros.body.clip import near_limbs
from flowing_puppet_ros.body.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.energy import JointTargets
from flowing_puppet_ros.body.geometry import vertex_normals
from flowing_puppet_ros.body.initial import body_from_joints, joint_targets, sampled_bodies, turned_around
from flowing_puppet_ros.body.normals import estimated_normals, thinned
from flowing_puppet_ros.body.particles import Particles, particles_of
from flowing_puppet_ros.body.points import part_points
from flowing_puppet_ros.body.proposals import Proposer, WalkNoise
from flowing_puppet_ros.body.refine import Refiner, RefineWeights
from flowing_puppet_ros.body.schedule import four_stages, local_stages
from flowing_puppet_ros.body.search import Search, SearchWeights
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud import CloudGrid
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.settings import Settings, setting

MIN_POINTS = 50
# Widest sides, in metres, between which a cloud may be a person or a part of one, with some surroundings.
PERSON_EXTENT = (0.1, 20.0)
Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class FitterSettings(Settings):
    """Settings of `BodyFitter`; the defaults are the fast ones, the thesis's are 80 particles and 120 iterations."""

    particles: int = setting(40, "particles a part", low=4, high=1000)
    iterations: int = setting(50, "rounds of the search when nothing is known of the pose", low=1, high=10000)
    local_particles: int = setting(20, "particles a part when the pose is roughly known", low=4, high=1000)
    local_iterations: int = setting(16, "rounds of the search when the pose is roughly known", low=0, high=10000)
    lm_steps: int = setting(4, "Levenberg-Marquardt steps a new particle", low=0, high=50)
    refine_iterations: int = setting(25, "Gauss-Newton steps of the finish", low=0, high=200)
    cloud_points: int = setting(10000, "points that a cloud is thinned to", low=200, high=200000)
    joint_strength: float = setting(0.02, "pull of an initial joint against the whole cloud's", low=0.0, high=100.0)
    clip_factor: float = setting(2.0, "limb radii around the initial joints' axes that a cloud is clipped to, 0: none",
                                 low=0.0, high=20.0)  # fmt: skip
    restarts: int = setting(2, "searches from new starts while no body comes close to the cloud", low=0, high=20)
    restart_distance: float = setting(0.02, "two-way distance at which a body is close", unit="m", low=0.0, high=1.0)
    seed: int = setting(0, "seed of all that is random", low=0)


@dataclass(frozen=True, slots=True, eq=False)
class BodyFit:
    """A fitted body.

    Attributes:
        state: the model's variables.
        vertices: (V, 3) metres, in the cloud's frame.
        joints: (J, 3) metres, in the order of the model's `joint_names`.
        energy: Eq. 50 of the body, lower is better.
        part_confidence: (16,) 0 to 1, how much of each part lies on the cloud.
        confidence: 0 to 1, parts on the cloud and cloud on the body together.
        two_way_distance: mean distance between body and cloud over both ways, metres.
    """

    state: BodyState
    vertices: np.ndarray
    joints: np.ndarray
    energy: float
    part_confidence: np.ndarray
    confidence: float
    two_way_distance: float


class BodyFitter:
    """Fits one model to clouds of one person; deterministic for a seed, whatever the number of threads."""

    def __init__(self, model: StitchedPuppet, settings: FitterSettings) -> None:
        self.model = model
        self.settings = settings
        points = part_points(model)
        self._search = Search(model, points, SearchWeights(lm_steps=settings.lm_steps))
        self._proposer = Proposer(model, points)
        self._refiner = Refiner(model)

    def fit(
        self,
        points: np.ndarray,
        normals: np.ndarray | None = None,
        *,
        initial: Mapping[str, tuple[float, float, float, float]] | None = None,
        viewpoint: np.ndarray | None = None,
        seed: int | None = None,
        progress: Progress | None = None,
    ) -> BodyFit:
        """Fit the model to a cloud.

        Args:
            points: (N, 3) metres, z up, one person.
            normals: (N, 3) outward unit normals, or None to estimate them.
            initial: joints by name as (x, y, z in metres, confidence 0 to 1), NaN where unknown; without them the
                person stands with unknown yaw.
            viewpoint: (3,) where the sensor stood when the cloud shows one side only.
            seed: overrides the settings' seed.
            progress: called with the fraction done, 0 to 1.

        Raises:
            InputError: when the cloud cannot be the surface of a person or the initial joints place no body.
        """
        rng = np.random.default_rng(self.settings.seed if seed is None else seed)
        with threadpool_limits(limits=1):
            points, normals = checked_cloud(points, normals)
            if initial is None:
                return self._fit_unknown(self._cloud(points, normals, viewpoint), rng, progress or _silent)
            return self._fit_from_joints(points, normals, initial, viewpoint, rng, progress or _silent)

    def _cloud(self, points: np.ndarray, normals: np.ndarray | None, viewpoint: np.ndarray | None) -> Cloud:
        """Thin and index the points; InputError when they cannot be the surface of a person."""
        extent = float(np.ptp(points, axis=0).max())
        if not PERSON_EXTENT[0] <= extent <= PERSON_EXTENT[1]:
            raise InputError(
                f"the cloud is {extent:.3g} m wide, which is no person; check the unit or cut out one person"
            )
        points, normals = thinned(points, normals, self.settings.cloud_points)
        places = len(np.unique(points, axis=0))
        if places < MIN_POINTS:
            raise InputError(
                f"the cloud's points lie in {places} places and a fit needs {MIN_POINTS}; give the surface of a person"
            )
        if normals is None:
            normals = estimated_normals(points, viewpoint)
        return Cloud.of(points, normals, viewpoint)

    def _fit_unknown(self, cloud: Cloud, rng: np.random.Generator, progress: Progress) -> BodyFit:
        """Search with unknown yaw; start again, some times, while no body comes close to the cloud."""
        grid = CloudGrid.build(cloud.points, cloud.normals)
        tries = 1 + self.settings.restarts
        bodies: list[BodyState] = []
        for turn in range(tries):
            bodies += self._two_bodies(cloud, grid, rng, _part_of(progress, turn / tries, (turn + 1) / tries))
            best = min(bodies, key=lambda state: self._distance(state, cloud))
            if self._distance(best, cloud) < self.settings.restart_distance:
                break
        progress(1.0)
        return self._result(best, cloud, grid)

    def _two_bodies(
        self, cloud: Cloud, grid: CloudGrid, rng: np.random.Generator, progress: Progress
    ) -> tuple[BodyState, BodyState]:
        """Search with unknown yaw; the body found, and the best one that faces the other way."""
        none = JointTargets.none(self.model)
        bodies = sampled_bodies(self.model, _body_center(cloud), self.settings.particles, rng)
        noise = WalkNoise(center=0.05, rotation=0.1, pose=0.0, shape=0.0)
        start = [self._proposer.walk(group, noise, rng) for group in particles_of(self.model, bodies)]
        stages, iterations = four_stages(self.model.tree), self.settings.iterations
        found = self._search.run(start, grid, none, stages, iterations, rng, _part_of(progress, 0.0, 0.6))
        body = self._finish(found.state, cloud, none)
        turned = turned_around(self.model, body)
        turned = self._local_search(turned, grid, none, rng, _part_of(progress, 0.65, 0.95))
        return body, self._finish(turned, cloud, none)

    def _fit_from_joints(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        initial: Mapping[str, tuple[float, float, float, float]],
        viewpoint: np.ndarray | None,
        rng: np.random.Generator,
        progress: Progress,
    ) -> BodyFit:
        """Start from the body that the joints describe, on the part of the cloud around its limbs."""
        targets = joint_targets(self.model, initial)
        body = body_from_joints(self.model, self._refiner, targets)
        if self.settings.clip_factor > 0:
            joints = self.model.joints(self.model.vertices(body))
            near = near_limbs(points, dict(zip(self.model.joint_names, joints, strict=True)), self.settings.clip_factor)
            if np.count_nonzero(near) < MIN_POINTS:
                raise InputError(
                    f"only {np.count_nonzero(near)} of {len(points)} points lie around the initial joints; check that"
                    " cloud and joints are in one frame, in metres"
                )
            points, normals = points[near], None if normals is None else normals[near]
        cloud = self._cloud(points, normals, viewpoint)
        grid = CloudGrid.build(cloud.points, cloud.normals)
        targets = targets.scaled(self.settings.joint_strength)
        found = self._local_search(body, grid, targets, rng, _part_of(progress, 0.1, 0.8))
        body = self._finish(found, cloud, targets)
        progress(1.0)
        return self._result(body, cloud, grid)

    def _local_search(
        self, body: BodyState, grid: CloudGrid, targets: JointTargets, rng: np.random.Generator, progress: Progress
    ) -> BodyState:
        """Search around a body; the body itself is among the first particles."""
        start = []
        for group in particles_of(self.model, [body]):
            copies = group.take(np.zeros(self.settings.local_particles - 1, dtype=np.int64))
            walked = self._proposer.walk(copies, WalkNoise(0.02, 0.12, 0.5, 0.2), rng)
            start.append(Particles.join([group, walked]))
        stages, iterations = local_stages(self.model.tree), self.settings.local_iterations
        return self._search.run(start, grid, targets, stages, iterations, rng, progress).state

    def _finish(self, body: BodyState, cloud: Cloud, targets: JointTargets) -> BodyState:
        steps = self.settings.refine_iterations
        weights = RefineWeights(iterations=steps)
        if cloud.viewpoint is not None:
            # What is hidden is only known from the joints' usual angles and from usual shapes.
            weights = RefineWeights(shape=1e-5, pairwise=4e-6, iterations=steps)
        return self._refiner.run(body, cloud, targets, weights)

    def _distance(self, state: BodyState, cloud: Cloud) -> float:
        return two_way_distance(self.model.vertices(state), self.model.faces, cloud)

    def _result(self, state: BodyState, cloud: Cloud, grid: CloudGrid) -> BodyFit:
        vertices = self.model.vertices(state)
        part_confidence, explained = self._confidence(vertices, cloud)
        return BodyFit(
            state,
            vertices,
            self.model.joints(vertices),
            self._search.energy(state, grid),
            part_confidence,
            float(np.sqrt(part_confidence.mean() * explained)),
            self._distance(state, cloud),
        )

    def _confidence(self, vertices: np.ndarray, cloud: Cloud) -> tuple[np.ndarray, float]:
        """Share of each part's seen surface that lies on the cloud, and share of the cloud that lies on the body.

        A point counts by the Geman-McClure weight of its distance at 4 cm, and not when the normals disagree.
        """
        normals = vertex_normals(vertices, self.model.faces)
        distance, index = cloud.tree.query(vertices)
        weight = (0.04**2 / (0.04**2 + distance**2)) ** 2
        weight *= (normals * cloud.normals[index]).sum(axis=1) > 0
        seen = cloud.sees(vertices, normals)
        owner, parts = self.model.part_of_vertex, len(self.model.tree)
        count = np.bincount(owner[seen], minlength=parts)
        share = np.bincount(owner[seen], weight[seen], minlength=parts) / np.maximum(count, 1)
        explained = (0.04**2 / (0.04**2 + cKDTree(vertices).query(cloud.points)[0] ** 2)) ** 2
        return share, float(explained.mean())


def checked_cloud(points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return float64 arrays without the points that are not finite; normals most of which are missing become None.

    Raises:
        InputError: when shapes are wrong or too few points are left.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"a cloud has shape (points, 3), this one has {points.shape}")
    finite = np.isfinite(points).all(axis=1)
    if normals is not None:
        normals = np.asarray(normals, dtype=np.float64)
        if normals.shape != points.shape:
            raise InputError(f"{len(points)} points need as many normals, got an array of shape {normals.shape}")
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        usable = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
        if 2 * np.count_nonzero(usable) < len(points):
            normals = None
        else:
            finite &= usable
            normals = (normals / np.where(length > 0, length, 1))[finite]
    points = points[finite]
    if len(points) < MIN_POINTS:
        raise InputError(f"the cloud has {len(points)} finite points, a fit needs at least {MIN_POINTS} on one person")
    return points, normals


def _body_center(cloud: Cloud) -> np.ndarray:
    """Where the torso may be: the mean of the cloud, moved 10 cm into the body when only its front is seen."""
    center = cloud.points.mean(axis=0)
    if cloud.viewpoint is None:
        return center
    away = center - cloud.viewpoint
    return center + 0.1 * away / max(float(np.linalg.norm(away)), 1e-9)


def _part_of(progress: Progress, low: float, high: float) -> Progress:
    """Progress of one stretch of the work."""
    return lambda done: progress(low + (high - low) * done)


def _silent(done: float) -> None:
    """Take a fraction and do nothing."""
