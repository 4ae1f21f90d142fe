# SPDX-License-Identifier: Apache-2.0
"""The fit of a Stitched Puppet to a cloud: hypotheses and search, refinement, confidences."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flowing_puppet_ros.body.cloud.correspondence import Cloud, two_way_distance
from flowing_puppet_ros.body.cloud.limb_crop import crop_to_limbs
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.cloud.rig_cloud import RigCloud
from flowing_puppet_ros.body.cloud.single_view import MAX_VIEW_POINTS, SingleViewCloud
from flowing_puppet_ros.body.fit.hypotheses import BodyCandidate, BodyHypotheses, Progress, sub_progress
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, make_joint_targets
from flowing_puppet_ros.body.fit.quality import assess_fit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility, judge_visibility, rate_joints
from flowing_puppet_ros.body.refine.body_beneath import BodyBeneath
from flowing_puppet_ros.body.refine.gauss_newton import LOOSE_STITCHING, GaussNewton
from flowing_puppet_ros.body.refine.hand_pose import refine_hand_pose
from flowing_puppet_ros.body.refine.nonrigid import NonRigidRefinement, NonRigidWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, ExactCloud
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread

__all__ = ["BodyFit", "BodyFitter", "Progress", "check_cloud"]

MIN_CLOUD_POINTS = 50  # finite and distinct
WARM_UP_VIEWPOINT_M = np.array([3.0, 0.0, 0.0])  # relative to the body
# Points that a cloud needs before it may shape the surface beyond the model.
MIN_DENSE_POINTS = 3000
MAX_CONTESTED_M = 0.15  # between the centres of a part in two bodies that are as likely
MAX_COARSE_POINTS = 1500  # of a cloud whose frames are compared
# Longest side of a cloud that may be a person or a part of one, with some surroundings.
MIN_PERSON_EXTENT_M, MAX_PERSON_EXTENT_M = 0.1, 20.0


@dataclass(frozen=True, slots=True, eq=False)
class BodyFit:
    """A fitted body.

    Attributes:
        state: the model's variables; of the body beneath the garments where a whole cloud is dense.
        vertices: (V, 3) metres, in the cloud's frame; refined beyond the model's surface where a whole cloud is dense.
        joints: (J, 3) metres, of `state`, in the order of the model's `joint_names`.
        energy: Eq. 50 of the body, lower is better.
        part_confidence: (16,) 0 to 1, how much of each part lies on the cloud.
        confidence: 0 to 1, from the parts on the cloud and the cloud on the body.
        reliable: whether the body can be trusted, see `FitQuality.reliable`.
        two_way_distance: mean distance between body and cloud over both directions, metres.
        visibility: which vertices, joints and parts the sensor saw.
    """

    state: BodyState
    vertices: np.ndarray
    joints: np.ndarray
    energy: float
    part_confidence: np.ndarray
    confidence: float
    reliable: bool
    two_way_distance: float
    visibility: BodyVisibility

    @property
    def joint_confidence(self) -> np.ndarray:
        """Probability (J,) that each joint is within 10 cm."""
        return rate_joints(self.visibility.joints, self.reliable, self.confidence)


class BodyFitter:
    """The fit of one model to clouds of one person; deterministic for a seed, whatever the number of threads."""

    def __init__(self, model: StitchedPuppet, settings: FitterSettings) -> None:
        self.model = model
        self.settings = settings
        self.hypotheses = BodyHypotheses(model, settings)
        self._beneath = BodyBeneath(model, self.gauss_newton)

    @cached_property
    def _nonrigid(self) -> NonRigidRefinement:
        """The refinement beyond the model, made when a dense whole cloud first needs it."""
        return NonRigidRefinement(self.model.faces, len(self.model.part_of_vertex), NonRigidWeights())

    @property
    def gauss_newton(self) -> GaussNewton:
        """Gauss-Newton over all parts."""
        return self.hypotheses.gauss_newton

    def warm_up(self) -> None:
        """Load compiled code and make the pose bank, which takes long; done once for a model in a process."""
        if self.model not in _WARM:
            _warm_up(self)
            _WARM.append(self.model)

    def fit(
        self,
        points: np.ndarray,
        normals: np.ndarray | None = None,
        *,
        initial: Mapping[str, tuple[float, float, float, float]] | None = None,
        viewpoint: np.ndarray | None = None,
        field: SensorField | SensorRig | None = None,
        seed: int | None = None,
        progress: Progress | None = None,
        nonrigid: bool = True,
        quick: bool = False,
    ) -> BodyFit:
        """Fit the model to a cloud.

        Cases:
            initial joints: the body that they describe, a search near it, Gauss-Newton.
            initial joints, `field`: the same without the search, which would draw what is out of sight to the cloud.
            single view, or sparse: the best of the hypotheses (cases in `BodyHypotheses.search`), with Gauss-Newton.
            dense whole cloud: the same, then the hand poses.
            dense whole cloud, `nonrigid`: the same, then every vertex by itself, and the body beneath the garments.

        Args:
            points: (N, 3) metres, z up, one person.
            normals: (N, 3) outward unit normals, or None to estimate them.
            initial: joints by name as (x, y, z in metres, confidence 0 to 1), NaN where unknown; without them the
                person is upright with unknown yaw.
            viewpoint: (3,) position of the sensor in metres, for a cloud that shows one side only.
            field: what the sensor at the viewpoint can know of the person; without it, all that is not in the cloud
                counts as free; of several sensors what all can know, and which of them saw each point.
            seed: overrides the settings' seed.
            progress: called with the fraction done, 0 to 1.
            nonrigid: refine the vertices beyond the model where a whole cloud is dense.
            quick: without initial joints, take a close body as it is, whose limbs may be wrong.

        Raises:
            InputError: when the cloud cannot be the surface of a person or the initial joints place no body.
        """
        progress = progress or _no_progress
        rng = np.random.default_rng(self.settings.seed if seed is None else seed)
        with one_blas_thread():
            points, normals = check_cloud(points, normals)
            if initial is not None:
                return self._fit_from_joints(points, normals, initial, (viewpoint, field), rng, progress)
            cloud = self.prepare_cloud(points, normals, viewpoint, field)
            state, *others = self.hypotheses.search(cloud, rng, progress, quick)
            progress(1.0)
            if not self._is_dense(cloud):
                return self._doubt(self.assess(state, cloud), others, cloud)
            state = refine_hand_pose(self.model, self.gauss_newton, state, cloud)
            fit = self.assess(state, cloud)
            return self._find_beneath(self._refine_nonrigid(fit, cloud), cloud) if nonrigid else fit

    def prepare_cloud(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        viewpoint: np.ndarray | None,
        field: SensorField | SensorRig | None = None,
    ) -> Cloud:
        """Downsample and index a cloud; InputError when it cannot be the surface of a person."""
        if isinstance(field, SensorRig):
            self.prepare_points(points, None, viewpoint)
            return RigCloud.seen_by(points, field)
        points, normals = self.prepare_points(points, normals, viewpoint)
        if viewpoint is None:
            return Cloud.of(points, estimate_normals(points) if normals is None else normals)
        return SingleViewCloud.seen_from(points, normals, viewpoint, field=field)

    def prepare_points(
        self, points: np.ndarray, normals: np.ndarray | None, viewpoint: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Downsample a cloud; InputError when it cannot be the surface of a person."""
        extent = float(np.ptp(points, axis=0).max())
        if not MIN_PERSON_EXTENT_M <= extent <= MAX_PERSON_EXTENT_M:
            raise InputError(
                f"the cloud is {extent:.3g} m wide, which is not a person; check the unit or cut out one person"
            )
        limit = self.settings.max_points
        points, normals = downsample(points, normals, limit if viewpoint is None else min(limit, MAX_VIEW_POINTS))
        # Counted along one axis first, which is fast and enough for nearly every cloud.
        places = len(np.unique(points[:, 2]))
        if places < MIN_CLOUD_POINTS and (places := len(np.unique(points, axis=0))) < MIN_CLOUD_POINTS:
            raise InputError(
                f"the cloud has {places} distinct points, a fit needs {MIN_CLOUD_POINTS}; give the surface of a person"
            )
        return points, normals

    def coarse_cost(self, points: np.ndarray, viewpoint: np.ndarray | None = None) -> float:
        """Return roughly how far, in metres, the best upright body is from a cloud (N, 3) in metres.

        Much faster than a fit; compares the frames that a cloud may be in.
        """
        points = downsample(points, None, MAX_COARSE_POINTS)[0]
        unknown = np.zeros_like(points)
        cloud = (
            Cloud.of(points, unknown) if viewpoint is None else SingleViewCloud.seen_from(points, unknown, viewpoint)
        )
        return self.hypotheses.pose_bank.coarse_cost(cloud)

    def find_roughly(
        self, points: np.ndarray, normals: np.ndarray | None, viewpoint: np.ndarray | None, thorough: bool
    ) -> BodyCandidate:
        """Find a body in a cloud in a fraction of a second: enough to tell its frame and unit, not its pose.

        Arguments as in `fit`; `thorough` starts from more poses and takes twice the time.

        Raises:
            InputError: when the cloud cannot be the surface of a person.
        """
        with one_blas_thread():
            points, normals = downsample(points, normals, MAX_COARSE_POINTS)
            return self.hypotheses.find_roughly(self.prepare_cloud(points, normals, viewpoint), thorough)

    def fit_at_once(self, points: np.ndarray, normals: np.ndarray | None) -> BodyFit | None:
        """Return a reliable body of a whole cloud, in a fifth of the time of a fit; None where that is not enough.

        Arguments as in `fit`. Bodies that are close but not reliable are often turned round or have limbs elsewhere.

        Raises:
            InputError: when the cloud cannot be the surface of a person.
        """
        with one_blas_thread():
            cloud = self.prepare_cloud(*check_cloud(points, normals), None)
            state = self.hypotheses.find_close(cloud)
            fit = None if state is None else self.assess(state, cloud)
            return fit if fit is not None and fit.reliable else None

    def _fit_from_joints(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        initial: Mapping[str, tuple[float, float, float, float]],
        sensor: tuple[np.ndarray | None, SensorField | SensorRig | None],
        rng: np.random.Generator,
        progress: Progress,
    ) -> BodyFit:
        """Fit from the body that the joints describe, to the part of the cloud around its limbs.

        `sensor` are the viewpoint and the field of `fit`.
        """
        targets = make_joint_targets(self.model, initial)
        body = body_from_joints(self.model, self.gauss_newton, targets)
        if self.settings.clip_factor > 0:
            joints = self.model.joints(self.model.vertices(body))
            near = crop_to_limbs(
                points, dict(zip(self.model.joint_names, joints, strict=True)), self.settings.clip_factor
            )
            if np.count_nonzero(near) < MIN_CLOUD_POINTS:
                raise InputError(
                    f"only {np.count_nonzero(near)} of {len(points)} points lie around the initial joints; check that"
                    " cloud and joints are in the same frame, in metres"
                )
            points, normals = points[near], None if normals is None else normals[near]
        cloud = self.prepare_cloud(points, normals, *sensor)
        targets = targets.scale(self.settings.joint_weight)
        if isinstance(cloud, SingleViewCloud) and cloud.field is not None:
            body = self.hypotheses.refine_partial(body, cloud, targets)
            progress(1.0)
            return self.assess(body, cloud)
        grid = CloudGrid.build(cloud.points, cloud.normals)
        found = self.hypotheses.search_near(body, grid, targets, rng, sub_progress(progress, 0.1, 0.8))
        body = self.hypotheses.refine(found, cloud, targets, self.settings.gauss_newton_steps)
        progress(1.0)
        return self.assess(body, cloud)

    def _doubt(self, fit: BodyFit, others: Sequence[BodyState], cloud: Cloud) -> BodyFit:
        """Return the fit, unreliable if another body that is as likely has a part elsewhere that the sensor saw.

        A part that it saw in neither body is a guess in any case, as the visibility says.
        """
        for other in others:
            apart = np.linalg.norm(fit.state.center - other.center, axis=1) > MAX_CONTESTED_M
            parts = np.maximum(fit.visibility.parts, self.assess(other, cloud).visibility.parts)
            if (apart & (parts == Visibility.SEEN)).any():
                return replace(fit, reliable=False)
        return fit

    def _is_dense(self, cloud: Cloud) -> bool:
        """Return whether a cloud is dense and whole enough to refine hands and vertices."""
        return self.settings.nonrigid and cloud.viewpoint is None and len(cloud.points) >= MIN_DENSE_POINTS

    def _refine_nonrigid(self, fit: BodyFit, cloud: Cloud) -> BodyFit:
        """Return the fit with vertices refined beyond the model on a dense whole cloud."""
        loose = self.gauss_newton.run(fit.state, cloud, JointTargets.none(self.model), LOOSE_STITCHING)
        vertices = self._nonrigid.run(self.model.vertices(loose), cloud)
        distance = two_way_distance(vertices, self.model.faces, cloud)
        return replace(fit, vertices=vertices, two_way_distance=distance)

    def _find_beneath(self, fit: BodyFit, cloud: Cloud) -> BodyFit:
        """Return the fit with the state and joints of the body beneath what is worn; the surface stays."""
        state = self._beneath.find(fit.state, cloud)
        return replace(fit, state=state, joints=self.model.joints(self.model.vertices(state)))

    def assess_surface(self, state: BodyState, cloud: Cloud) -> BodyFit:
        """Return the fit of a body to a cloud, with refined vertices where the cloud is dense and whole."""
        fit = self.assess(state, cloud)
        return self._refine_nonrigid(fit, cloud) if self._is_dense(cloud) else fit

    def assess(self, state: BodyState, cloud: Cloud) -> BodyFit:
        """Return the fit of a body to a cloud, with its energy and confidences."""
        vertices = self.model.vertices(state)
        quality = assess_fit(self.model, vertices, cloud)
        return BodyFit(
            state,
            vertices,
            self.model.joints(vertices),
            self.hypotheses.energy.measure(state, ExactCloud(cloud.points, cloud.normals, cloud.nearest)),
            quality.part_confidence,
            quality.confidence,
            quality.reliable,
            quality.distance,
            judge_visibility(self.model, vertices, cloud, quality.surface),
        )


def check_cloud(points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return float64 arrays without the points that are not finite, and no normals when most of them are missing.

    Raises:
        InputError: when shapes are wrong or too few points are left.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"a cloud has shape (N, 3), this one has {points.shape}")
    finite = np.isfinite(points).all(axis=1)
    if normals is not None:
        normals = np.asarray(normals, dtype=np.float64)
        if normals.shape != points.shape:
            raise InputError(f"{len(points)} points need as many normals, got normals of shape {normals.shape}")
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        usable = np.isfinite(length[:, 0]) & (length[:, 0] > 0)
        if 2 * np.count_nonzero(usable) < len(points):
            normals = None
        else:
            finite &= usable
            normals = (normals / np.where(length > 0, length, 1))[finite]
    points = points[finite]
    if len(points) < MIN_CLOUD_POINTS:
        raise InputError(f"the cloud has {len(points)} finite points, a fit needs {MIN_CLOUD_POINTS} on one person")
    return points, normals


# The last models whose fits ran once; equal only to themselves.
_WARM: deque[StitchedPuppet] = deque(maxlen=3)


def _warm_up(fitter: BodyFitter) -> None:
    """Run every step of a fit once on a body of the fitter's model."""
    with one_blas_thread():
        state = fitter.model.rest_state()
        cloud = fitter.prepare_cloud(fitter.model.vertices(state), None, None)
        viewpoint = cloud.points.mean(axis=0) + WARM_UP_VIEWPOINT_M
        fitter.hypotheses.warm_up(cloud, SingleViewCloud.seen_from(cloud.points, cloud.normals, viewpoint))
        fitter.assess(state, cloud)


def _no_progress(done: float) -> None:
    """Ignore the fraction done."""
