# SPDX-License-Identifier: Apache-2.0
"""One person through a stream of clouds: from the last bodies a few Gauss-Newton steps, a search only when lost.

Motion goes on at the last velocity, shape is learned over the frames, and the two-way distance between body and cloud
tells when the track is lost.
"""

from __future__ import annotations

from collections import Counter
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from flowing_puppet_ros.blas import one_blas_thread
from flowing_puppet_ros.body.cloud.correspondence import Cloud
from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.cloud.normals import downsample, estimate_normals
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, Progress, check_cloud
from flowing_puppet_ros.body.refine.gauss_newton import RefineWeights
from flowing_puppet_ros.body.search.energy import JointTargets
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState
from flowing_puppet_ros.settings import Settings, setting

NARROW, WIDE = (0.10, 0.03), (0.25, 0.03)  # first and last kernel width of a usual step and of a lost body's, metres
WIDE_STEPS = 20
BELIEF = 1e-6  # weight in `RefineWeights.shape` that each frame adds to the shape of the frames before
MOST_FRAMES = 30  # that are remembered of a shape, or a first mistake would stay
HIDDEN = 0.4  # share of what is usually seen of a person below which somebody stands before them
HALF_LIFE = 2.0  # seconds in which what is usual falls to half, where less is seen
MOST_STRETCH = 2.0  # frames' steps that a motion may go on unseen


@dataclass(frozen=True)
class BodyTrackerSettings(Settings):
    """Settings of `BodyTracker`."""

    track_points: int = setting(5000, "points that a tracked cloud from all sides is thinned to", low=200, high=200000)
    track_steps: int = setting(5, "Gauss-Newton steps a frame", low=1, high=100)
    track_lost_ratio: float = setting(1.3, "two-way distance, against the best since the last search, of a lost track",
                                      low=1.0, high=10.0)  # fmt: skip
    track_lost_distance: float = setting(0.001, "distance that must be added to that", unit="m", low=0.0, high=1.0)
    track_longest_gap: float = setting(0.5, "gap between clouds after which a motion does not go on", unit="s",
                                       low=0.01, high=60.0)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Observation:
    """A fit, the time of its cloud in nanoseconds, and the mean (3,) of the cloud's points, metres."""

    fit: BodyFit
    stamp: int
    middle: np.ndarray


class BodyTracker:
    """Follows one person; `counters` counts frames by how they were fitted: tracked, widened, searched."""

    def __init__(self, fitter: BodyFitter, settings: BodyTrackerSettings) -> None:
        """Track with the model of `fitter`, which also makes the full fits."""
        self._fitter = fitter
        self._settings = settings
        self._none = JointTargets.none(fitter.model)
        self.counters: Counter[str] = Counter()
        self._quick = False
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._before: _Observation | None = None
        self._last: _Observation | None = None
        self._best = np.inf
        self._frames = 0
        self._turned = False
        self._usual = 0.0
        self._hidden = False
        self.lost = True

    @property
    def last(self) -> BodyFit | None:
        """The body in the last cloud, None before the first."""
        return None if self._last is None else self._last.fit

    def fork(self, quick: bool) -> BodyTracker:
        """A tracker that knows the same person so far and goes its own way from here; `quick`: so are its searches."""
        made = copy(self)
        made._quick = quick
        made.counters = self.counters.copy()
        return made

    def accept(self) -> None:
        """Take the last body for the best there is: a search has found none that is closer."""
        if self._last is not None:
            self._best, self.lost = self._last.fit.two_way_distance, False

    def track_or_refit(
        self,
        points: np.ndarray,
        normals: np.ndarray | None,
        stamp: int,
        viewpoint: np.ndarray | None = None,
        seed: int | None = None,
        progress: Progress | None = None,
    ) -> BodyFit:
        """Fit the next cloud of the person; a full fit when there is no track or it is lost.

        Args:
            points: (N, 3) metres, z up, in one frame through the stream.
            normals: (N, 3) outward unit normals, or None to estimate them.
            stamp: nanoseconds; one that is not later than the last starts a new track.
            viewpoint: (3,) where the sensor stood when the cloud shows one side only.
            seed: of a full fit; overrides the fitter's.
            progress: of a full fit, see `BodyFitter.fit`.

        Raises:
            InputError: when the cloud cannot be the surface of a person; the track goes on with the next one.
        """
        with one_blas_thread():
            cloud = self._next_cloud(points, normals, stamp, viewpoint)
            fit = self._followed(cloud, stamp)
            if fit is None or self.lost:
                fit = self._searched(fit, cloud, seed, progress)
                self.lost = False
        return self._record(fit, cloud, stamp)

    def track(
        self, points: np.ndarray, normals: np.ndarray | None, stamp: int, viewpoint: np.ndarray | None = None
    ) -> BodyFit | None:
        """Fit the next cloud as `step` does, but never by a full fit: None when there is no body to start from.

        `lost` tells whether the body is not where the person is.
        """
        if self._last is None:
            # Normals take long, and nobody would use them.
            self._fitter.person_points(*check_cloud(points, normals), viewpoint)
            return None
        with one_blas_thread():
            cloud = self._next_cloud(points, normals, stamp, viewpoint)
            fit = self._followed(cloud, stamp)
        return None if fit is None else self._record(fit, cloud, stamp)

    def _next_cloud(
        self, points: np.ndarray, normals: np.ndarray | None, stamp: int, viewpoint: np.ndarray | None
    ) -> Cloud:
        points, normals = check_cloud(points, normals)
        if viewpoint is None:
            points, normals = downsample(points, normals, self._settings.track_points)
        if self._last is not None and stamp <= self._last.stamp:
            self.reset()
        self._hidden = viewpoint is not None and self._is_hidden(points, stamp, viewpoint)
        self._turned = normals is None and viewpoint is None and self._last is not None
        if self._turned and self._last is not None:
            vertices = self._fitter.model.vertices(self._predicted(self._last, points.mean(axis=0), stamp))
            normals = estimate_normals(points, None, (vertices, vertex_normals(vertices, self._fitter.model.faces)))
        return self._fitter.cloud(points, normals, viewpoint)

    def _followed(self, cloud: Cloud, stamp: int) -> BodyFit | None:
        """The last body after a few steps on the new cloud, and whether it is lost.

        The little that is seen of a person behind somebody would bend the body: it goes on as it is.
        """
        if self._hidden and self._last is not None:
            self.counters["hidden"] += 1
            self.lost = False
            return self._fitter.result(self._carried(self._last, stamp), cloud)
        middle = cloud.points.mean(axis=0)
        fit = None if self._last is None else self._tracked(self._predicted(self._last, middle, stamp), cloud)
        self.lost = fit is None or self._is_lost(fit)
        return fit

    def _record(self, fit: BodyFit, cloud: Cloud, stamp: int) -> BodyFit:
        self._before, self._last = self._last, _Observation(fit, stamp, cloud.points.mean(axis=0))
        if not self.lost and not self._hidden:
            self._best = min(self._best, fit.two_way_distance)
        self._frames += not self._hidden
        return fit

    def _tracked(self, start: BodyState, cloud: Cloud) -> BodyFit:
        """A few steps from where the person should be; when they do not get there, more steps that look farther."""
        fit = self._refined(start, cloud, NARROW, self._settings.track_steps)
        if not self._is_lost(fit):
            self.counters["tracked"] += 1
            return fit
        self.counters["widened"] += 1
        wide = self._refined(start, cloud, WIDE, WIDE_STEPS)
        return min(fit, wide, key=lambda found: found.two_way_distance)

    def _searched(self, tracked: BodyFit | None, cloud: Cloud, seed: int | None, progress: Progress | None) -> BodyFit:
        """The full fit, unless the tracked body is closer to the cloud; its distance is the new measure of lost."""
        self.counters["searched"] += 1
        # Normals that were turned by a body that is lost would mislead the search.
        normals = None if self._turned else cloud.normals
        # With the model's surface: one of its own would come and go with the searches.
        fit = self._fitter.fit(
            cloud.points, normals, viewpoint=cloud.viewpoint, seed=seed, progress=progress, own_surface=False,
            quick=self._quick,
        )  # fmt: skip
        if tracked is not None and tracked.two_way_distance <= fit.two_way_distance:
            fit = tracked
        else:
            self.reset()
        self._best = fit.two_way_distance
        return fit

    def _predicted(self, last: _Observation, middle: np.ndarray, stamp: int) -> BodyState:
        """The last body, moved on by its last motion in proportion to the time.

        After a long gap, which a search leaves in a live stream too, it moves as the middle of the cloud did.
        """
        state = last.fit.state
        if stamp - last.stamp > 1e9 * self._settings.track_longest_gap:
            return replace(state, center=state.center + middle - last.middle)
        if self._before is None:
            return state
        share, before = self._stretch(self._before, last, stamp), self._before.fit.state
        turn = rotation.log(np.swapaxes(before.rotation, -1, -2) @ state.rotation)
        return replace(
            state,
            center=state.center + share * (state.center - before.center),
            rotation=state.rotation @ rotation.exp(share * turn),
        )

    def _carried(self, last: _Observation, stamp: int) -> BodyState:
        """The last body, moved on as its torso moved, in the pose that it has."""
        state = last.fit.state
        if self._before is None:
            return state
        moved = state.center[0] - self._before.fit.state.center[0]
        return replace(state, center=state.center + self._stretch(self._before, last, stamp) * moved)

    @staticmethod
    def _stretch(before: _Observation, last: _Observation, stamp: int) -> float:
        return min((stamp - last.stamp) / (last.stamp - before.stamp), MOST_STRETCH)

    def _is_hidden(self, points: np.ndarray, stamp: int, viewpoint: np.ndarray) -> bool:
        """Whether much less of the person is seen from one side than usual; what is usual follows what is seen."""
        seen = len(points) * float(((points - viewpoint) ** 2).sum(axis=1).mean())
        passed = 0.0 if self._last is None else 1e-9 * (stamp - self._last.stamp)
        self._usual = max(seen, self._usual * 0.5 ** (passed / HALF_LIFE))
        return seen < HIDDEN * self._usual

    def _refined(self, start: BodyState, cloud: Cloud, widths: tuple[float, float], steps: int) -> BodyFit:
        weights = RefineWeights(sigma_start=widths[0], sigma_end=widths[1], iterations=steps)
        learned = BELIEF * min(self._frames, MOST_FRAMES)
        weights = replace(weights, shape=weights.shape + learned, shape_center=start.shape.mean(axis=0))
        # What turns to the sensor is taken to be seen: a limb that lags behind its place in the cloud is not hidden.
        facing = Cloud(cloud.points, cloud.normals, cloud.nearest, cloud.viewpoint)
        return self._fitter.result(self._fitter.gauss_newton.run(start, facing, self._none, weights), cloud)

    def _is_lost(self, fit: BodyFit) -> bool:
        return fit.two_way_distance > self._settings.track_lost_ratio * self._best + self._settings.track_lost_distance
