# SPDX-License-Identifier: Apache-2.0
"""The fit of a Stitched Puppet to the silhouettes of one person in several calibrated cameras, and to depth if known.

Triangulated joints place the body, and Gauss-Newton over all parts fits its rim to the outlines, and its surface to
what depth sensors saw. The body is then rendered: the overlap of its silhouettes with the observed ones tells a correct
body from one with sides or limbs confused, which the outlines' residuals do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, I8, U8
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, flip_heading, make_joint_targets
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rim_term import Outline, RimTerm, mesh_edges
from flowing_puppet_ros.multiview.silhouette_overlap import (
    measure_outline_gap,
    measure_shares_inside,
    render_mask,
    silhouette_iou,
)
from flowing_puppet_ros.multiview.visual_hull import MIN_VIEWS
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import Settings, setting

# Overlap of a view in overlaps of the median view; below it another person is seen, or a mask or camera is wrong.
_MIN_OVERLAP_RATIO = 0.7
# Distance outside a silhouette at which a vertex counts a quarter.
_KERNEL_WIDTH_M = 0.04
# Share inside the silhouettes from which on a vertex counts as seen: less than 2 cm outside on average, or 4 cm.
_MIN_SEEN_SHARE, _MIN_NEAR_SHARE = 0.64, 0.25
# Joints place limbs along the rays and in front of the body; outlines determine everything else better.
_WEIGHTS = RefineWeights(pose=1e-7, pairwise=1e-7, shape=2e-6, sigma_start=0.08, sigma_end=0.05)
# With depth: first everything attracts what the joints place roughly; then depth, which tells more of the surface than
# rough outlines and joints do, is followed closely, and outlines hold what it does not see.
_WITH_DEPTH = RefineWeights(pose=1e-7, pairwise=1e-7, shape=1e-6, sigma_start=0.12, sigma_end=0.03, iterations=14)
_CLOSE_TO_DEPTH = replace(_WITH_DEPTH, sigma_start=0.06, iterations=8)
_RIM_BESIDE_DEPTH = 0.2


@dataclass(frozen=True)
class SilhouetteFitterSettings(Settings):
    """Settings of `SilhouetteFitter`."""

    gauss_newton_steps: int = setting(8, "Gauss-Newton steps on silhouettes", low=1, high=200, advanced=True)
    joint_weight: float = setting(
        0.02, "weight of an initial joint relative to all silhouettes", low=0.0, high=100.0, advanced=True
    )
    min_iou: float = setting(
        0.78,
        "minimum intersection over union of rendered and observed silhouettes for a body to be reliable; below it,"
        " other initialisations are tried",
        low=0.0,
        high=1.0,
        advanced=True,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A body: `views` are the indices of the outlines that it was fitted to, `overlap` its mean on them, 0 to 1."""

    state: BodyState
    vertices: F64
    views: tuple[int, ...]
    overlap: float


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """What a body is fitted to: one or more `outlines`, and what depth sensors saw, None if nothing."""

    outlines: Sequence[Outline]
    cloud: SingleViewCloud | None

    def take(self, views: Sequence[int]) -> _Evidence:
        """Return the same with some of the outlines, by their indices."""
        return replace(self, outlines=[self.outlines[view] for view in views])


class SilhouetteFitter:
    """The fit of one model to silhouettes, and to depth where it is known, without randomness."""

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings | None = None) -> None:
        """Prepare Gauss-Newton for `model`."""
        self.model = model
        self.settings = settings or SilhouetteFitterSettings()
        self._refiner = GaussNewton(model)
        self._edges = mesh_edges(model.faces)

    def fit(
        self,
        views: Sequence[tuple[Camera, U8]],
        initial: Mapping[str, tuple[float, float, float, float]],
        previous: BodyState | None = None,
        cloud: SingleViewCloud | None = None,
    ) -> BodyFit:
        """Fit the model to one person.

        Args:
            views: cameras and masks (h, w) uint8, positive on the person; a camera is resized to its mask.
            initial: joints by name as (x, y, z in metres, confidence 0 to 1), in the cameras' world; NaN where unknown.
            previous: the body of the same person a moment ago. The fit starts from its shape, and from its pose only
                where the joints are wrong or too few.
            cloud: the person's own points of one or more depth sensors, in the same world.

        Returns:
            The fit; its `confidence` is the rendered overlap, its `energy` the mean squared residual in square metres.
            Of the `cloud` they say nothing.

        Raises:
            InputError: when fewer than two masks have an outline, or none beside a `cloud`, or neither joints nor
                `previous` give a body.
        """
        with one_blas_thread():
            outlines = [Outline.of(camera, mask) for camera, mask in views if 0 < np.count_nonzero(mask) < mask.size]
            needed = MIN_VIEWS if cloud is None else 1
            if len(outlines) < needed:
                raise InputError(
                    f"{len(outlines)} of {len(views)} silhouettes show a person's outline, and a fit needs {needed}"
                )
            return self._assess(self._find_best(_Evidence(outlines, cloud), initial, previous), outlines)

    def _find_best(
        self,
        evidence: _Evidence,
        initial: Mapping[str, tuple[float, float, float, float]],
        previous: BodyState | None,
    ) -> _Candidate:
        """Fit from the joints; where the overlap is poor, also from the opposite heading and the previous body."""
        none = JointTargets.none(self.model)
        try:
            targets = make_joint_targets(self.model, initial)
        except InputError:
            if previous is None:
                raise
            return self._refit_without_outliers(evidence, self._refine(previous, evidence, none))
        start = body_from_joints(self.model, self._refiner, targets)
        if previous is not None:
            start = replace(start, shape=previous.shape)
        best = self._refit_without_outliers(evidence, self._refine(start, evidence, targets))
        if best.overlap < self.settings.min_iou:
            seen = evidence.take(best.views)
            others = [self._refine(flip_heading(self.model, start), seen, self._swap_sides(targets))]
            if previous is not None:
                others.append(self._refine(previous, seen, none))
            best = max(
                best, *(replace(other, views=best.views) for other in others), key=lambda candidate: candidate.overlap
            )
        return best

    def _refine(self, start: BodyState, evidence: _Evidence, targets: JointTargets) -> _Candidate:
        outlines, scaled = evidence.outlines, targets.scale(self.settings.joint_weight)
        rim = RimTerm(outlines, self.model.faces, self._edges)
        if evidence.cloud is None:
            weights = replace(_WEIGHTS, iterations=self.settings.gauss_newton_steps)
            state = self._refiner.run(start, None, scaled, weights, [rim])
        else:
            state = self._refine_with_depth(start, evidence.cloud, rim, scaled)
        vertices = self.model.vertices(state)
        return _Candidate(
            state, vertices, tuple(range(len(outlines))), float(self._measure_overlaps(vertices, outlines).mean())
        )

    def _refine_with_depth(
        self, start: BodyState, cloud: SingleViewCloud, rim: RimTerm, targets: JointTargets
    ) -> BodyState:
        free, none = cloud.free_space_term, JointTargets.none(self.model)
        near = self._refiner.run(start, cloud, targets, _WITH_DEPTH, [rim, free])
        return self._refiner.run(near, cloud, none, _CLOSE_TO_DEPTH, [rim.scale(_RIM_BESIDE_DEPTH), free])

    def _measure_overlaps(self, vertices: F64, outlines: Sequence[Outline]) -> F64:
        faces = self.model.faces
        return np.array([silhouette_iou(render_mask(each.camera, vertices, faces), each.mask) for each in outlines])

    def _refit_without_outliers(self, evidence: _Evidence, candidate: _Candidate) -> _Candidate:
        """Fit again to the views that agree, when others overlap much less than the median view."""
        overlaps = self._measure_overlaps(candidate.vertices, evidence.outlines)
        agree = tuple(np.flatnonzero(overlaps >= _MIN_OVERLAP_RATIO * np.median(overlaps)).tolist())
        if len(agree) == len(evidence.outlines) or (len(agree) < MIN_VIEWS and evidence.cloud is None):
            return candidate
        again = self._refine(candidate.state, evidence.take(agree), JointTargets.none(self.model))
        return replace(again, views=agree)

    def _swap_sides(self, targets: JointTargets) -> JointTargets:
        """Return the targets with left and right swapped."""
        names = self.model.joint_names
        other = [names.index(_mirror_name(name)) for name in names]
        return JointTargets(targets.points[other], targets.weight[other])

    def _assess(self, best: _Candidate, outlines: Sequence[Outline]) -> BodyFit:
        seen, faces = [outlines[view] for view in best.views], self.model.faces
        middle = best.vertices.mean(axis=0)
        gaps = [
            measure_outline_gap(
                render_mask(each.camera, best.vertices, faces), each, float(each.camera.to_camera(middle)[2])
            )
            for each in seen
        ]
        gap, energy = np.mean(gaps, axis=0)
        inside = measure_shares_inside(best.vertices, seen, _KERNEL_WIDTH_M)
        owner, parts = self.model.part_of_vertex, len(self.model.tree)
        return BodyFit(
            best.state,
            best.vertices,
            self.model.joints(best.vertices),
            float(energy),
            np.bincount(owner, inside, parts) / np.bincount(owner, minlength=parts),
            best.overlap,
            best.overlap >= self.settings.min_iou,
            float(gap),
            BodyVisibility.of_vertices(self.model, _judge_vertices(inside)),
        )


def _judge_vertices(inside: F64) -> I8:
    """Return the `Visibility` (V,) of vertices by how far they lie inside the silhouettes that show them."""
    state = np.where(inside >= _MIN_NEAR_SHARE, Visibility.NEAR, Visibility.INFERRED)
    return np.where(inside >= _MIN_SEEN_SHARE, Visibility.SEEN, state).astype(np.int8)


def _mirror_name(name: str) -> str:
    side, _, kind = name.partition("_")
    return {"left": f"right_{kind}", "right": f"left_{kind}"}.get(side, name)
