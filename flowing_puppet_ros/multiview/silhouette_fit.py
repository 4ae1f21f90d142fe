# SPDX-License-Identifier: Apache-2.0
"""The fit of a Stitched Puppet to the silhouettes of one person in several calibrated cameras.

Triangulated joints place the body and a Gauss-Newton over all parts draws its rim to the outlines. The body is then
rendered: the overlap of its silhouettes with the seen ones tells a right body from one with sides or limbs confused,
which the outlines' own residuals do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.arrays import F64, U8
from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.initialisation import body_from_joints, flip_heading, joint_targets
from flowing_puppet_ros.body.refine.gauss_newton import GaussNewton, RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rim_term import Outline, RimTerm, mesh_edges
from flowing_puppet_ros.multiview.silhouette_overlap import outline_gap, render_mask, shares_inside, silhouette_iou
from flowing_puppet_ros.settings import Settings, setting

MIN_VIEWS = 2
# A view whose overlap is below this share of the median view's shows somebody else, or a mask or camera is wrong.
_ODD_VIEW = 0.7
# Metres outside a silhouette at which a vertex counts a quarter.
_INSIDE = 0.04
# Joints place limbs along the rays and where the body covers them; outlines have more to say of everything else.
_WEIGHTS = RefineWeights(pose=1e-7, pairwise=1e-7, shape=2e-6, sigma_start=0.08, sigma_end=0.05)


@dataclass(frozen=True)
class SilhouetteFitterSettings(Settings):
    """Settings of `SilhouetteFitter`."""

    outline_steps: int = setting(8, "Gauss-Newton steps on silhouettes", low=1, high=200)
    outline_joints: float = setting(0.02, "pull of an initial joint against all silhouettes'", low=0.0, high=100.0)
    least_overlap: float = setting(
        0.78,
        "overlap (intersection over union) of rendered and seen silhouettes of a reliable body; below it other starts"
        " are tried",
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A body and what it overlaps with: `views` are the outlines that were drawn to, `overlap` their mean, 0 to 1."""

    state: BodyState
    vertices: F64
    views: tuple[int, ...]
    overlap: float


class SilhouetteFitter:
    """Fits one model to silhouettes; nothing in it is random."""

    def __init__(self, model: StitchedPuppet, settings: SilhouetteFitterSettings | None = None) -> None:
        """Prepare the Gauss-Newton for `model`."""
        self.model = model
        self.settings = settings or SilhouetteFitterSettings()
        self._refiner = GaussNewton(model)
        self._edges = mesh_edges(model.faces)
        self._weights = replace(_WEIGHTS, iterations=self.settings.outline_steps)

    def fit(
        self,
        views: Sequence[tuple[Camera, U8]],
        initial: Mapping[str, tuple[float, float, float, float]],
        before: BodyState | None = None,
    ) -> BodyFit:
        """Fit the model to one person.

        Args:
            views: cameras and masks (h, w) uint8, positive on the person; a camera is resized to its mask.
            initial: joints by name as (x, y, z in metres, confidence 0 to 1), in the cameras' world; NaN where unknown.
            before: the body of the same person a moment ago. Its shape is where the fit starts, its pose only where the
                joints lead astray or are too few.

        The result's `confidence` is the rendered overlap, its `energy` the mean squared residual in square metres.

        Raises:
            InputError: when fewer than two masks have an outline, or joints and `before` place no body.
        """
        with one_blas_thread():
            outlines = [Outline.of(camera, mask) for camera, mask in views if 0 < np.count_nonzero(mask) < mask.size]
            if len(outlines) < MIN_VIEWS:
                raise InputError(
                    f"{len(outlines)} of {len(views)} silhouettes show a person's outline, and a fit needs {MIN_VIEWS}"
                )
            return self._result(self._best(outlines, initial, before), outlines)

    def _best(
        self,
        outlines: Sequence[Outline],
        initial: Mapping[str, tuple[float, float, float, float]],
        before: BodyState | None,
    ) -> _Candidate:
        none = JointTargets.none(self.model)
        try:
            targets = joint_targets(self.model, initial)
        except InputError:
            if before is None:
                raise
            return self._without_odd_views(outlines, self._finish(before, outlines, none))
        start = body_from_joints(self.model, self._refiner, targets)
        if before is not None:
            start = replace(start, shape=before.shape)
        best = self._without_odd_views(outlines, self._finish(start, outlines, targets))
        if best.overlap < self.settings.least_overlap:
            seen = [outlines[view] for view in best.views]
            others = [self._finish(flip_heading(self.model, start), seen, self._other_side(targets))]
            if before is not None:
                others.append(self._finish(before, seen, none))
            best = max(best, *(replace(other, views=best.views) for other in others), key=lambda tried: tried.overlap)
        return best

    def _finish(self, start: BodyState, outlines: Sequence[Outline], targets: JointTargets) -> _Candidate:
        term = RimTerm(outlines, self.model.faces, self._edges)
        believed = targets.scaled(self.settings.outline_joints)
        state = self._refiner.run(start, None, believed, self._weights, [term])
        vertices = self.model.vertices(state)
        return _Candidate(
            state, vertices, tuple(range(len(outlines))), float(self._overlaps(vertices, outlines).mean())
        )

    def _overlaps(self, vertices: F64, outlines: Sequence[Outline]) -> F64:
        faces = self.model.faces
        return np.array([silhouette_iou(render_mask(each.camera, vertices, faces), each.mask) for each in outlines])

    def _without_odd_views(self, outlines: Sequence[Outline], tried: _Candidate) -> _Candidate:
        """Fit once more to the views that agree, when others overlap much less than the median of them all."""
        overlaps = self._overlaps(tried.vertices, outlines)
        agree = tuple(np.flatnonzero(overlaps >= _ODD_VIEW * np.median(overlaps)).tolist())
        if len(agree) == len(outlines) or len(agree) < MIN_VIEWS:
            return tried
        none = JointTargets.none(self.model)
        again = self._finish(tried.state, [outlines[view] for view in agree], none)
        return replace(again, views=agree)

    def _other_side(self, targets: JointTargets) -> JointTargets:
        """The targets with left and right confused."""
        names = self.model.joint_names
        other = [names.index(_mirrored(name)) for name in names]
        return JointTargets(targets.points[other], targets.weight[other])

    def _result(self, best: _Candidate, outlines: Sequence[Outline]) -> BodyFit:
        seen, faces = [outlines[view] for view in best.views], self.model.faces
        middle = best.vertices.mean(axis=0)
        gaps = [
            outline_gap(render_mask(each.camera, best.vertices, faces), each, float(each.camera.to_camera(middle)[2]))
            for each in seen
        ]
        gap, energy = np.mean(gaps, axis=0)
        inside = shares_inside(best.vertices, seen, _INSIDE)
        owner, parts = self.model.part_of_vertex, len(self.model.tree)
        return BodyFit(
            best.state,
            best.vertices,
            self.model.joints(best.vertices),
            float(energy),
            np.bincount(owner, inside, parts) / np.bincount(owner, minlength=parts),
            best.overlap,
            best.overlap >= self.settings.least_overlap,
            float(gap),
        )


def _mirrored(name: str) -> str:
    side, _, kind = name.partition("_")
    return {"left": f"right_{kind}", "right": f"left_{kind}"}.get(side, name)
