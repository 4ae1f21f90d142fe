# SPDX-License-Identifier: Apache-2.0
"""The fit of a Stitched Puppet to a cloud: search, the body turned around, finish, confidences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.limb_crop import crop_to_limbs
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.cloud.single_view import VIEW_POINTS, SingleViewCloud
from flowing_puppet_ros.body.fit.hypotheses import BodyHypotheses, FitterSettings, Progress, sub_progress
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, joint_targets
from flowing_puppet_ros.body.fit.quality import assess_fit
from flowing_puppet_ros.body.refine.gauss_newton import LOOSE, GaussNewton
from flowing_puppet_ros.body.refine.hand_pose import refine_hand_pose
from flowing_puppet_ros.body.refine.nonrigid import NonRigidRefinement, NonRigidWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, ExactCloud
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

__all__ = ["BodyFit", "BodyFitter", "FitterSettings", "Progress", "check_cloud"]

MIN_POINTS = 50
# Models that are warm in this process.
_WARM: set[str] = set()
WARM_VIEW = np.array([3.0, 0.0, 0.0])  # metres from the body
# Points that a cloud needs before it may shape the surface more finely than the model does.
DENSE_CLOUD = 3000
COARSE_POINTS = 1500
# Widest sides, in metres, between which a cloud may be a person or a part of one, with some surroundings.
PERSON_EXTENT = (0.1, 20.0)


@dataclass(frozen=True, slots=True, eq=False)
class BodyFit:
    """A fitted body.

    Attributes:
        state: the model's variables.
        vertices: (V, 3) metres, in the cloud's frame; where a whole cloud is dense not just the model's surface.
        joints: (J, 3) metres, in the order of the model's `joint_names`.
        energy: Eq. 50 of the body, lower is better.
        part_confidence: (16,) 0 to 1, how much of each part lies on the cloud.
        confidence: 0 to 1, parts on the cloud and cloud on the body together.
        reliable: whether nothing speaks against the body, see `Judgement.reliable`.
        two_way_distance: mean distance between body and cloud over both ways, metres.
    """

    state: BodyState
    vertices: np.ndarray
    joints: np.ndarray
    energy: float
    part_confidence: np.ndarray
    confidence: float
    reliable: bool
    two_way_distance: float


class BodyFitter:
    """Fits one model to clouds of one person; deterministic for a seed, whatever the number of threads."""

    def __init__(self, model: StitchedPuppet, settings: FitterSettings) -> None:
        self.model = model
        self.settings = settings
        self._finder = BodyHypotheses(model, settings)
        self._surface_finish = NonRigidRefinement(model.faces, len(model.part_of_vertex), NonRigidWeights())

    @property
    def gauss_newton(self) -> GaussNewton:
        """The Gauss-Newton over all parts."""
        return self._finder.refiner

    def warm_up(self) -> None:
        """Do beforehand what takes long the first time in a process: load compiled code, make the bank of bodies."""
        if self.model.name in _WARM:
            return
        _WARM.add(self.model.name)
        with one_blas_thread():
            points = self.model.vertices(self.model.rest_state())
            cloud = self.cloud(points, None, None)
            view = SingleViewCloud.seen_from(cloud.points, cloud.normals, cloud.points.mean(axis=0) + WARM_VIEW)
            self._finder.warm_up(cloud, view)
            self.result(self.model.rest_state(), cloud)

    def fit(
        self,
        points: np.ndarray,
        normals: np.ndarray | None = None,
        *,
        initial: Mapping[str, tuple[float, float, float, float]] | None = None,
        viewpoint: np.ndarray | None = None,
        seed: int | None = None,
        progress: Progress | None = None,
        own_surface: bool = True,
        quick: bool = False,
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
            own_surface: let vertices follow a dense whole cloud closer than the model can.
            quick: without initial joints try a small search first, whose limbs may still be wrong.

        Raises:
            InputError: when the cloud cannot be the surface of a person or the initial joints place no body.
        """
        rng = np.random.default_rng(self.settings.seed if seed is None else seed)
        with one_blas_thread():
            points, normals = check_cloud(points, normals)
            if initial is None:
                cloud = self.cloud(points, normals, viewpoint)
                state = self._finder.search(cloud, rng, progress or _no_progress, quick)
                (progress or _no_progress)(1.0)
                if not self._follows_surface(cloud):
                    return self.result(state, cloud)
                state = refine_hand_pose(self.model, self._finder.refiner, state, cloud)
                if not own_surface:
                    return self.result(state, cloud)
                return self._refine_nonrigid(self.result(state, cloud), cloud)
            return self._fit_from_joints(points, normals, initial, viewpoint, rng, progress or _no_progress)

    def cloud(self, points: np.ndarray, normals: np.ndarray | None, viewpoint: np.ndarray | None) -> Cloud:
        """Thin and index the points; InputError when they cannot be the surface of a person."""
        points, normals = self.person_points(points, normals, viewpoint)
        if normals is None:
            normals = estimate_normals(points, viewpoint)
        return Cloud.of(points, normals) if viewpoint is None else SingleViewCloud.seen_from(points, normals, viewpoint)

    def person_points(
        self, points: np.ndarray, normals: np.ndarray | None, viewpoint: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Thin the points; InputError when they cannot be the surface of a person."""
        extent = float(np.ptp(points, axis=0).max())
        if not PERSON_EXTENT[0] <= extent <= PERSON_EXTENT[1]:
            raise InputError(
                f"the cloud is {extent:.3g} m wide, which is no person; check the unit or cut out one person"
            )
        limit = self.settings.cloud_points
        points, normals = downsample(points, normals, limit if viewpoint is None else min(limit, VIEW_POINTS))
        # Along one axis alone that is quickly told, of nearly every cloud.
        places = len(np.unique(points[:, 2]))
        if places < MIN_POINTS and (places := len(np.unique(points, axis=0))) < MIN_POINTS:
            raise InputError(
                f"the cloud's points lie in {places} places and a fit needs {MIN_POINTS}; give the surface of a person"
            )
        return points, normals

    def coarse_cost(self, points: np.ndarray, viewpoint: np.ndarray | None = None) -> float:
        """How well, in metres, any upright body may explain a cloud (N, 3) in metres; lower is better, and fast.

        Compares frames in which a cloud may be meant before one is fitted in.
        """
        points = downsample(points, None, COARSE_POINTS)[0]
        unknown = np.zeros_like(points)
        cloud = (
            Cloud.of(points, unknown) if viewpoint is None else SingleViewCloud.seen_from(points, unknown, viewpoint)
        )
        return self._finder.bank.coarse_cost(cloud)

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
        body = body_from_joints(self.model, self._finder.refiner, targets)
        if self.settings.clip_factor > 0:
            joints = self.model.joints(self.model.vertices(body))
            near = crop_to_limbs(
                points, dict(zip(self.model.joint_names, joints, strict=True)), self.settings.clip_factor
            )
            if np.count_nonzero(near) < MIN_POINTS:
                raise InputError(
                    f"only {np.count_nonzero(near)} of {len(points)} points lie around the initial joints; check that"
                    " cloud and joints are in one frame, in metres"
                )
            points, normals = points[near], None if normals is None else normals[near]
        cloud = self.cloud(points, normals, viewpoint)
        grid = CloudGrid.build(cloud.points, cloud.normals)
        targets = targets.scaled(self.settings.joint_strength)
        found = self._finder.search_near(body, grid, targets, rng, sub_progress(progress, 0.1, 0.8))
        body = self._finder.refine(found, cloud, targets, self.settings.refine_iterations)
        progress(1.0)
        return self.result(body, cloud)

    def _follows_surface(self, cloud: Cloud) -> bool:
        """Whether a cloud is dense and whole enough for hands and vertices of their own."""
        return self.settings.surface_finish and cloud.viewpoint is None and len(cloud.points) >= DENSE_CLOUD

    def _refine_nonrigid(self, fit: BodyFit, cloud: Cloud) -> BodyFit:
        """The fit with vertices that follow a dense whole cloud closer than the model can."""
        loose = self._finder.refiner.run(fit.state, cloud, JointTargets.none(self.model), LOOSE)
        vertices = self._surface_finish.run(self.model.vertices(loose), cloud)
        distance = two_way_distance(vertices, self.model.faces, cloud)
        return replace(fit, vertices=vertices, two_way_distance=distance)

    def result(self, state: BodyState, cloud: Cloud) -> BodyFit:
        """What is known of a body that was fitted to a cloud."""
        vertices = self.model.vertices(state)
        judgement = assess_fit(self.model, vertices, cloud)
        return BodyFit(
            state,
            vertices,
            self.model.joints(vertices),
            self._finder.particle_search.energy(state, ExactCloud(cloud.points, cloud.normals, cloud.nearest)),
            judgement.part_confidence,
            judgement.confidence,
            judgement.reliable,
            judgement.distance,
        )


def check_cloud(points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
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


def _no_progress(done: float) -> None:
    """Take a fraction and do nothing."""
