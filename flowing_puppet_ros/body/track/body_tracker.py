# SPDX-License-Identifier: Apache-2.0
"""Track one person through a stream of clouds: a few Gauss-Newton steps per cloud, a full fit only when lost.

The motion is extrapolated at the last velocity, the shape is learned over the clouds, and the two-way distance between
body and cloud tells when the track is lost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, Progress, check_cloud
from flowing_puppet_ros.body.fit.partial_view import hang_unseen_parts
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights, SurfaceTerm
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.body.settings import BodyTrackerSettings
from flowing_puppet_ros.body.track.track_state import BodyObservation, TrackState, align, extrapolate, translate
from flowing_puppet_ros.body.upright.upright_fit import (
    FEW_POINTS,
    MANY_POINTS,
    MAX_FIT_POINTS,
    MIN_MANY_POINTS,
    UprightFitter,
    floor_term,
    keep_place_only,
)
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.process.threads import one_blas_thread

# First and last kernel width in metres: of a usual step, and of a step from which a lost body may come back.
NARROW_WIDTHS_M, WIDE_WIDTHS_M = (0.10, 0.03), (0.25, 0.03)
WIDE_STEPS = 20
ALTERNATE = 2  # a step matches every second vertex and cloud point, the next one the others
SHAPE_WEIGHT_PER_FRAME = 1e-6  # that each frame adds to `RefineWeights.shape` for the shape of the frames before
MAX_SHAPE_FRAMES = 30  # that count for the shape: with more, a first mistake would stay
MIN_VISIBLE = 0.4  # visible fraction, relative to normal, below which the person counts as occluded ...
MIN_VISIBLE_OF_FEW = 0.75  # ... and where few points show the person, and half of them bends the body more
MAX_TURNED_RATIO = 1.25
"""Two-way distance of a body that walks ahead, relative to that of one that walks backwards, up to which it is taken:
few points hardly tell front from back, and hardly anybody walks backwards."""
MAX_TRACKED_POINTS = 2500
"""Of one side of a person whose joints somebody sees: the shape comes from many clouds, and no full fit from these."""
ALIGN_GAP_NS = 100_000_000
"""Time between clouds from which on a body is first moved to the joints that somebody sees."""


class _Prepared(NamedTuple):
    """A cloud that is ready to be tracked to; `oriented`: its normals were turned outwards by the predicted body.

    `few`: so few points that the body is fitted as an upright one. `floor`: z of the floor in metres where the points
    leave the soles to it, else None. `targets` pull at the joints, and `places` say where they are, None where nobody
    sees them.
    """

    cloud: Cloud
    stamp: int
    occluded: bool
    oriented: bool
    few: bool
    floor: float | None
    targets: JointTargets
    places: JointTargets | None


class BodyTracker:
    """Tracks one person.

    Attributes:
        counters: clouds by how they were fitted: tracked, widened, searched, hidden.
        cloud: the last cloud of `track`, prepared; None where nothing was to be tracked.
    """

    def __init__(self, fitter: BodyFitter, settings: BodyTrackerSettings) -> None:
        """Track with the model of `fitter`, which also makes the full fits."""
        self._fitter = fitter
        self._settings = settings
        self._no_joints = JointTargets.none(fitter.model)
        self._upright = UprightFitter(fitter)
        self.counters: Counter[str] = Counter()
        self._quick = self._only_upright = False
        self.cloud: Cloud | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._state = TrackState()

    @property
    def last(self) -> BodyFit | None:
        """The body in the last cloud, None before the first."""
        return None if self._state.last is None else self._state.last.fit

    @property
    def lost(self) -> bool:
        """Whether the last body is not where the person is."""
        return self._state.lost

    def fork(self, quick: bool, upright: bool) -> BodyTracker:
        """Return a tracker that knows the same person and goes its own way from here.

        Its full fits are `quick`, or, where the floor is known, of `upright` bodies only.
        """
        made = copy(self)
        made._quick, made._only_upright = quick, upright
        made._upright = UprightFitter(self._fitter, max_threads=1)  # the others are for who is tracked meanwhile
        made.counters = self.counters.copy()
        return made

    def start(self, person: PersonCloud, fit: BodyFit) -> None:
        """Start from a body that was found in the person's cloud."""
        seen = BodyObservation(fit, person.stamp, person.points.mean(axis=0), len(person.points))
        self._state = TrackState(
            last=seen, best=fit.two_way_distance, best_points=len(person.points), frames=1, lost=False
        )

    def correct(self, fit: BodyFit, parts: Sequence[int]) -> None:
        """Take another body for the last cloud, of which `parts` are elsewhere; they are not taken to have moved."""
        last, before = self._state.last, self._state.before
        if last is None:
            return
        if before is not None:
            earlier, new, rows = before.fit.state, fit.state, list(parts)
            turn = earlier.rotation[0] @ new.rotation[0].T
            center, rotated = earlier.center.copy(), earlier.rotation.copy()
            center[rows] = earlier.center[0] + (new.center[rows] - new.center[0]) @ turn.T
            rotated[rows] = turn @ new.rotation[rows]
            moved = replace(earlier, center=center, rotation=rotated)
            before = replace(before, fit=replace(before.fit, state=moved))
        self._state = replace(self._state, before=before, last=replace(last, fit=fit), lost=False)

    def turn_round(self, person: PersonCloud) -> BodyFit | None:
        """Turn the last body, who walks backwards, if one that walks ahead explains the cloud nearly as well.

        Returns:
            The turned body; None where it stays as it is.
        """
        last, floor, viewpoint = self._state.last, person.floor, person.viewpoint
        if last is None or floor is None or viewpoint is None:
            return None
        with one_blas_thread():
            cloud = self._upright.make_cloud(person.points, viewpoint, None, person.field)
            turned = self._upright.turn_round(last.fit.state, cloud, floor).fit
        if turned.two_way_distance > MAX_TURNED_RATIO * last.fit.two_way_distance:
            return None
        self.start(person, turned)
        return turned

    @property
    def hidden(self) -> bool:
        """Whether much less of the person was seen in the last cloud than normally."""
        return self._state.hidden

    def predict(self, stamp: int) -> BodyState | None:
        """Return the body where it should be at a time in ns, None when the last one is too old or not known."""
        last = self._state.last
        if last is None or not 0 < stamp - last.stamp <= 1e9 * self._settings.max_time_gap:
            return None
        return extrapolate(self._state.before, last, stamp)

    def _predict(self, points: F64, stamp: int) -> BodyState | None:
        return self._state.predict(stamp, points.mean(axis=0), self._settings.max_time_gap)

    def accept(self) -> None:
        """Take the last body for the best there is: a full fit has found none that is closer."""
        last = self._state.last
        if last is not None:
            self._state = replace(self._state, best=last.fit.two_way_distance, best_points=last.points, lost=False)

    def track_or_refit(self, person: PersonCloud, seed: int | None = None, progress: Progress | None = None) -> BodyFit:
        """Fit the next cloud of the person, by a full fit when there is no track or it is lost.

        Args:
            person: its cloud, in one frame through the stream; a stamp that is not later than the last starts a new
                track.
            seed: of a full fit; overrides the fitter's.
            progress: of a full fit, see `BodyFitter.fit`.

        Raises:
            InputError: when the cloud cannot be the surface of a person; the track goes on with the next one.
        """
        with one_blas_thread():
            prepared = self._prepare(person)
            fit, lost = self._track(prepared)
            if fit is None or lost:
                fit, lost = self._refit(fit, prepared, seed, progress), False
        return self._record(fit, lost, prepared)

    def track(
        self,
        person: PersonCloud,
        targets: JointTargets | None = None,
        places: JointTargets | None = None,
        start: BodyState | None = None,
    ) -> BodyFit | None:
        """Fit the next cloud like `track_or_refit`, but never by a full fit: None when there is no body to start from.

        `targets` are where somebody else sees the joints, and `places` are the same with their depths, to which a body
        is moved that is lost or comes after a gap. `start` is where the body should be, None where it is `predict`'s.
        `lost` tells whether the body is not where the person is.
        """
        self.cloud = None
        if self._state.last is None:
            # Normals take long, and nothing would use them.
            self._fitter.prepare_points(*check_cloud(person.points, person.normals), person.viewpoint)
            return None
        with one_blas_thread():
            prepared = self._prepare(person, targets, places)
            self.cloud = prepared.cloud
            fit, lost = self._track(prepared, start)
        if fit is None:
            self._state = replace(self._state, lost=lost)
            return None
        return self._record(fit, lost, prepared)

    def _prepare(
        self, person: PersonCloud, targets: JointTargets | None = None, places: JointTargets | None = None
    ) -> _Prepared:
        stamp, viewpoint = person.stamp, person.viewpoint
        few = person.floor is not None and viewpoint is not None and len(person.points) < MIN_MANY_POINTS
        floor = person.floor if viewpoint is not None and len(person.points) < MAX_FIT_POINTS else None
        points, normals = (person.points, person.normals) if few else check_cloud(person.points, person.normals)
        if viewpoint is None:
            points, normals = downsample(points, normals, self._settings.max_points)
        if self._state.last is not None and stamp <= self._state.last.stamp:
            self.reset()
        if viewpoint is not None:
            min_visible = MIN_VISIBLE_OF_FEW if few else MIN_VISIBLE
            self._state = self._state.see(points, stamp, viewpoint, min_visible)
        occluded = viewpoint is not None and self._state.hidden
        expected = self._predict(points, stamp) if normals is None and viewpoint is None else None
        oriented = expected is not None
        if expected is not None:
            vertices = self._fitter.model.vertices(expected)
            normals = estimate_normals(points, (vertices, vertex_normals(vertices, self._fitter.model.faces)))
        if targets is not None and viewpoint is not None and person.field is not None:
            points, normals = downsample(points, normals, MAX_TRACKED_POINTS)
        if few and viewpoint is not None:
            cloud: Cloud = self._upright.make_cloud(points, viewpoint, None, person.field)
        else:
            cloud = self._fitter.prepare_cloud(points, normals, viewpoint, person.field)
        pull = self._no_joints if targets is None else targets
        return _Prepared(cloud, stamp, occluded, oriented, few, floor, pull, places)

    def _track(self, prepared: _Prepared, start: BodyState | None = None) -> tuple[BodyFit | None, bool]:
        """Return the last body after a few steps on the new cloud, and whether it is lost.

        The little that is seen of an occluded person would bend the body: it moves on in the pose that it has.
        """
        last, cloud = self._state.last, prepared.cloud
        if prepared.occluded and last is not None:
            self.counters["hidden"] += 1
            return self._fitter.assess(translate(self._state.before, last, prepared.stamp), cloud), False
        if start is None:
            start = self._predict(cloud.points, prepared.stamp)
        if last is None or start is None:
            return None, True
        fit = self._step(start, prepared)
        return fit, self._is_lost(fit, prepared)

    def _record(self, fit: BodyFit, lost: bool, prepared: _Prepared) -> BodyFit:
        state = self._state
        if prepared.few:
            fit = keep_place_only(self._fitter.model, fit, len(prepared.cloud.points))
        points = len(prepared.cloud.points)
        seen = BodyObservation(fit, prepared.stamp, prepared.cloud.points.mean(axis=0), points)
        if not lost and not prepared.occluded and fit.two_way_distance < state.best:
            state = replace(state, best=fit.two_way_distance, best_points=points)
        frames = state.frames + (not prepared.occluded)
        self._state = replace(state, before=state.last, last=seen, frames=frames, lost=lost)
        return fit

    def _step(self, start: BodyState, prepared: _Prepared) -> BodyFit:
        """Take a few steps from where the person should be; if they fail, more steps with a wider kernel."""
        steps, places, last = self._settings.gauss_newton_steps, prepared.places, self._state.last
        if places is not None and last is not None and prepared.stamp - last.stamp >= ALIGN_GAP_NS:
            start = align(self._fitter.gauss_newton, start, places)
        fit = self._refine(start, prepared, NARROW_WIDTHS_M, steps)
        if not self._is_lost(fit, prepared) or self._was_as_lost(fit):
            self.counters["tracked"] += 1
            return fit
        self.counters["widened"] += 1
        wide_steps = WIDE_STEPS
        if places is not None:
            start, wide_steps = align(self._fitter.gauss_newton, start, places), 2 * steps
        wide = self._refine(start, prepared, WIDE_WIDTHS_M, wide_steps)
        return min(fit, wide, key=lambda found: found.two_way_distance)

    def _refit(
        self, tracked: BodyFit | None, prepared: _Prepared, seed: int | None, progress: Progress | None
    ) -> BodyFit:
        """Return the full fit, unless the tracked body is closer to the cloud; its distance is the new best."""
        self.counters["searched"] += 1
        cloud = prepared.cloud
        upright = prepared.few or self._only_upright
        if upright and prepared.floor is not None and isinstance(cloud, SingleViewCloud):
            fit = self._upright.fit(cloud, prepared.floor).fit
            return self._keep_closer(tracked, fit, len(cloud.points))
        # Normals that were turned by a body that is lost would mislead the search.
        normals = None if prepared.oriented else cloud.normals
        # On the model's surface: vertices refined beyond it would come and go with the full fits.
        fit = self._fitter.fit(
            cloud.points,
            normals,
            viewpoint=cloud.viewpoint,
            field=cloud.field,
            seed=seed,
            progress=progress,
            nonrigid=False,
            quick=self._quick,
        )
        return self._keep_closer(tracked, fit, len(cloud.points))

    def _keep_closer(self, tracked: BodyFit | None, fit: BodyFit, points: int) -> BodyFit:
        if tracked is not None and tracked.two_way_distance <= fit.two_way_distance:
            self._state = replace(self._state, best=tracked.two_way_distance, best_points=points)
            return tracked
        # How much of the person is normally seen does not depend on the body.
        self._state = TrackState(best=fit.two_way_distance, best_points=points, visible=self._state.visible)
        return fit

    def _refine(self, start: BodyState, prepared: _Prepared, widths: tuple[float, float], steps: int) -> BodyFit:
        cloud, floor = prepared.cloud, prepared.floor
        weights = RefineWeights(sigma_start=widths[0], sigma_end=widths[1], iterations=steps, alternate=ALTERNATE)
        terms: list[SurfaceTerm] = []
        if floor is not None:
            weights = FEW_POINTS if prepared.few else replace(MANY_POINTS, sigma_end=widths[1], alternate=ALTERNATE)
            weights = replace(weights, sigma_start=widths[0], iterations=steps)
            terms.append(lambda vertices, _: floor_term(vertices, floor))
        learned = SHAPE_WEIGHT_PER_FRAME * min(self._state.frames, MAX_SHAPE_FRAMES)
        center, weight = start.shape.mean(axis=0), weights.shape + learned
        if floor is not None:
            # Without a pull to the mean the shape drifts where the points say little, until it is no person's.
            center = center * (1 - MANY_POINTS.shape / weight)
        weights = replace(weights, shape=weight, shape_center=center)
        # What faces the sensor is taken to be seen: a limb that lags behind its place in the cloud is not hidden. Where
        # joints say where it is, it does not lag, and one that is hidden is not drawn to what hides it.
        facing = Cloud(cloud.points, cloud.normals, cloud.nearest, cloud.viewpoint, cloud.field)
        seen = facing if prepared.targets.rays is None else cloud
        body = self._fitter.gauss_newton.run(start, seen, prepared.targets, weights, terms)
        # A limb that left the view stays in its last pose: its motion would go on for ever.
        last = start if self._state.last is None else self._state.last.fit.state
        body = hang_unseen_parts(self._fitter.model, (last, body), cloud, prepared.targets)
        return self._fitter.assess(body, cloud)

    def _was_as_lost(self, fit: BodyFit) -> bool:
        """Return whether more steps with a wider kernel left the body before as far from its cloud."""
        last = self._state.last
        if last is None or not self._state.lost:
            return False
        return fit.two_way_distance <= self._settings.lost_ratio * last.fit.two_way_distance

    def _is_lost(self, fit: BodyFit, prepared: _Prepared) -> bool:
        best, points = self._state.best, len(prepared.cloud.points)
        if prepared.floor is not None and points < self._state.best_points:
            # The farther somebody walks away, the farther are the points from each other, and a body from them.
            best *= float(np.sqrt(self._state.best_points / points))
        return fit.two_way_distance > self._settings.lost_ratio * best + self._settings.lost_distance
