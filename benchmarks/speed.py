# SPDX-License-Identifier: Apache-2.0
"""Speed as ratios measured in one run: the 3D fit on clouds of random bodies of the shipped model.

Times are processor time of the whole process, the minimum of several runs, which other programs on the machine disturb
little. Compiled code runs once before it is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from benchmarks import plain_search, replays, scenes, stages, streams
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.initialisation import sample_bodies
from flowing_puppet_ros.body.search import energy, levenberg
from flowing_puppet_ros.body.search.dpmp import BodyParticleSearch, SearchWeights
from flowing_puppet_ros.body.search.energy import JointTargets, ScoredParticles
from flowing_puppet_ros.body.search.part_points import build_part_points
from flowing_puppet_ros.body.search.particles import Particles, states_to_particles
from flowing_puppet_ros.body.search.schedule import four_stages
from flowing_puppet_ros.body.settings import BodyTrackerSettings, FitterSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.evaluate.tables import Row
from flowing_puppet_ros.evidence.cloud.data_term import CloudGrid, look_up
from flowing_puppet_ros.inference import diverse
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread

NOISE_M = 0.003  # deviation of the clouds' points
LOOK_UPS = 200_000  # queries of closest points
GROWTH = {"points": (2500, 5000, 10000), "particles": (10, 20, 40), "iterations": (5, 10, 20)}
BASE = {"points": 5000, "particles": 20, "iterations": 10}
PLAIN_SIZE = (10, 3)  # particles and iterations of the search that the plain version also runs
STAGE_FITS = 3  # the first of them compiles
TRACKED_POINTS, TRACKED_FRAMES, WALK_M = 5000, 6, 0.03  # points, frames, metres per frame


class Bench:
    """The measurements; each returns rows of one form."""

    def __init__(self, seed: int = 0) -> None:
        """Load the model and draw the body."""
        self._model = StitchedPuppet.load()
        self._points = build_part_points(self._model)
        self._seed = seed
        self._body = self._model.sample(np.random.default_rng(seed))
        self._none = JointTargets.none(self._model)

    def measure_look_ups(self) -> list[Row]:
        """Measure closest points by the grid against a cKDTree, in millions per second, and the error of the grid."""
        points, normals = self._sample_cloud(10000)
        grid, tree = CloudGrid.build(points, normals), cKDTree(points)
        rng = np.random.default_rng(self._seed)
        asked = points[rng.integers(0, len(points), LOOK_UPS)] + 0.03 * rng.standard_normal((LOOK_UPS, 3))
        fast = _time(lambda: _look_up_all(grid.nearest, grid.origin, grid.cell, asked))
        slow = _time(lambda: tree.query(asked))
        found = points[_look_up_all(grid.nearest, grid.origin, grid.cell, asked)]
        extra = np.linalg.norm(asked - found, axis=1) - tree.query(asked)[0]
        rates = {"grid_millions_a_second": LOOK_UPS / fast / 1e6, "tree_millions_a_second": LOOK_UPS / slow / 1e6}
        return [rates | {"ratio": slow / fast, "grid_too_far_mm": 1000 * float(extra.mean())}]

    def measure_steps(self) -> list[Row]:
        """Measure the steps of the search against plain versions, on 20 particles per part."""
        grid, cloud = self._make_clouds(5000)
        start, weights = self._make_start(BASE["particles"], grid), SearchWeights()
        scored = [
            ScoredParticles.score(p, group, grid, self._none) for p, group in zip(self._points, start, strict=True)
        ]
        upper, edge = 4, 3
        parent, child = scored[self._model.tree.edges[edge][0]], scored[self._model.tree.edges[edge][1]]
        weight = self._model.interfaces[edge].weight
        ends = parent.interfaces[edge], child.interfaces[edge]
        centers = parent.particles.center, child.particles.center
        size = (6 * BASE["particles"], 2 * BASE["particles"])
        foundation = np.random.default_rng(self._seed).exponential(0.1, size)
        part, group, count = self._points[upper], start[upper], weights.lm_points
        pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
            "Levenberg-Marquardt moves": (
                lambda: levenberg.levenberg_marquardt(part, group, grid, self._none, weights.lm_steps, count),
                lambda: plain_search.improve(part, group, cloud, self._none, weights.lm_steps, count),
            ),
            "data costs": (
                lambda: ScoredParticles.score(part, group, grid, self._none),
                lambda: ScoredParticles.score(part, group, cloud, self._none),
            ),
            "stitching costs": (
                lambda: energy.stitching_costs(weight, *ends, centers, 4.0),
                lambda: plain_search.stitching_costs(weight, parent, child, edge, 4.0),
            ),
            "diverse selection": (
                lambda: diverse.select_diverse(foundation, BASE["particles"], 0, 0.1),
                lambda: plain_search.select_diverse(foundation, BASE["particles"], 0, 0.1),
            ),
        }
        return [_make_ratio_row(step, _time(fast), _time(slow)) for step, (fast, slow) in pairs.items()]

    def measure_search(self) -> list[Row]:
        """Measure a whole search against a plain version that queries a cKDTree."""
        grid, cloud = self._make_clouds(5000)
        particles, iterations = PLAIN_SIZE
        fast = self._time_search(BodyParticleSearch, grid, particles, iterations)
        slow = self._time_search(plain_search.PlainSearch, cloud, particles, iterations, repeats=1)
        return [_make_ratio_row(f"search of {particles} particles, {iterations} iterations", fast, slow)]

    def measure_growth(self) -> list[Row]:
        """Measure seconds of a search and of its grid by the number of points, particles and iterations."""
        rows = []
        for name, values in GROWTH.items():
            for value in values:
                size = BASE | {name: value}
                points, normals = self._sample_cloud(size["points"])
                built = _time(lambda p=points, n=normals: CloudGrid.build(p, n))  # type: ignore[misc]
                grid = CloudGrid.build(points, normals)
                seconds = self._time_search(BodyParticleSearch, grid, size["particles"], size["iterations"])
                rows.append(size | {"grid_seconds": built, "search_seconds": seconds})
        return rows

    def measure_tracking(self) -> list[Row]:
        """Measure milliseconds per frame of a tracked walk after the first, for clouds from all sides and from one."""
        rows = []
        for sides in ("all", "one"):
            tracker = BodyTracker(self._fitter, BodyTrackerSettings(max_points=TRACKED_POINTS))
            seconds = []
            for frame in range(TRACKED_FRAMES):
                state = replace(self._body, center=self._body.center + np.array([WALK_M * frame, 0.0, 0.0]))
                points, normals, eye = self._sample_sensed_cloud(state, sides, frame)
                started = time.process_time()
                tracker.track_or_refit(PersonCloud(points, normals, frame * 50_000_000, eye))
                seconds.append(time.process_time() - started)
            row = {"sides": sides, "points": len(points), "searched": tracker.counters["searched"]}
            rows.append(row | {"milliseconds_a_frame": 1000 * float(np.median(seconds[1:]))})
        return rows

    def measure_stages(self) -> list[Row]:
        """Measure milliseconds of each stage of tracked clouds without normals, and of whole and one-sided fits."""
        rows = []
        for sides in ("all", "one"):
            tracker, runs = BodyTracker(self._fitter, BodyTrackerSettings(max_points=TRACKED_POINTS)), []
            for frame in range(TRACKED_FRAMES):
                state = replace(self._body, center=self._body.center + np.array([WALK_M * frame, 0.0, 0.0]))
                points, _, eye = self._sample_sensed_cloud(state, sides, frame)
                person = PersonCloud(points, None, frame * 50_000_000, eye)
                with stages.measure_stages(stages.REFINEMENT) as spent:
                    tracker.track_or_refit(person)
                runs.append(spent)
            # The first cloud is searched, the second may compile.
            rows += stages.make_rows(f"tracked, {sides} side{'s' if sides == 'all' else ''}", runs[2:])
        fitter = BodyFitter(self._model, FitterSettings(threads=1))
        seen = self._sample_sensed_cloud(self._body, "one", 0)
        for path, functions, cloud in (
            ("whole fit", stages.SEARCH, (*self._sample_cloud(10000), None)),
            ("one-sided fit", stages.ONE_SIDED_SEARCH, seen),
        ):
            runs = []
            for _ in range(STAGE_FITS):
                with stages.measure_stages(functions) as spent:
                    fitter.fit(*cloud[:2], viewpoint=cloud[2])
                runs.append(spent)
            rows += stages.make_rows(path, runs[1:])
        return rows

    def measure_scene(self) -> list[Row]:
        """Measure milliseconds of each stage of a scan of a scene with 90,000 points and five people."""
        return scenes.measure_scene(self._seed)

    def measure_fits(self) -> list[Row]:
        """Measure seconds of whole fits to 10,000 points: the defaults, and the thesis's particles and iterations."""
        points, normals = self._sample_cloud(10000)
        BodyFitter(self._model, FitterSettings(particles=4, iterations=1, restarts=0)).fit(points, normals)
        rows = []
        for particles, iterations in ((FitterSettings().particles, FitterSettings().iterations), (80, 120)):
            fitter = BodyFitter(self._model, FitterSettings(particles=particles, iterations=iterations))
            wall, started = time.perf_counter(), time.process_time()
            fit = fitter.fit(points, normals)
            row = {"particles": particles, "iterations": iterations, "processor_seconds": time.process_time() - started}
            rows.append(
                row | {"seconds": time.perf_counter() - wall, "two_way_distance_cm": 100 * fit.two_way_distance}
            )
        return rows

    def measure_images(self) -> list[Row]:
        """Measure milliseconds per image of the 2D tracker by image size and people, with the flow preset fast."""
        return streams.measure_tracking(self._seed)

    def measure_replay(self) -> list[Row]:
        """Measure replays of the repository's small recording of four cameras on one thread and on all cores."""
        return replays.measure_replay(self._seed)

    def measure_memory(self) -> list[Row]:
        """Measure the peak memory of replays of recordings of different lengths."""
        return replays.measure_memory(self._seed)

    @cached_property
    def _fitter(self) -> BodyFitter:
        return BodyFitter(self._model, FitterSettings())

    def _sample_cloud(
        self, count: int, state: BodyState | None = None, frame: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([self._seed, frame])
        vertices = self._model.vertices(self._body if state is None else state)
        points, normals = sample_surface(vertices, self._model.faces, rng, count)
        return points + NOISE_M * rng.standard_normal(points.shape), normals

    def _sample_sensed_cloud(
        self, state: BodyState, sides: str, frame: int
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Sample a cloud with normals or, for one side, without: the points that face a sensor at 3 m."""
        if sides == "all":
            return *self._sample_cloud(TRACKED_POINTS, state, frame), None
        points, normals = self._sample_cloud(2 * TRACKED_POINTS, state, frame)
        eye = self._body.center[0] + np.array([3.0, 0.0, 0.3])
        near = ((eye - points) * normals).sum(axis=1) > 0
        return points[near], None, eye

    def _make_clouds(self, count: int) -> tuple[CloudGrid, plain_search.PlainCloud]:
        points, normals = self._sample_cloud(count)
        return CloudGrid.build(points, normals), plain_search.PlainCloud.of_tree(points, normals)

    def _make_start(self, particles: int, grid: CloudGrid) -> list[Particles]:
        rng = np.random.default_rng(self._seed)
        return states_to_particles(self._model, sample_bodies(self._model, grid.points.mean(axis=0), particles, rng))

    def _time_search(
        self, kind: type[BodyParticleSearch], cloud: Any, particles: int, iterations: int, repeats: int = 2
    ) -> float:
        search, start = kind(self._model, self._points, SearchWeights()), self._make_start(particles, cloud)
        stages = four_stages(self._model.tree)

        def run() -> None:
            search.optimise(start, cloud, self._none, stages, iterations, np.random.default_rng(self._seed))

        return _time(run, repeats)


@njit(cache=True)
def _look_up_all(nearest: np.ndarray, origin: np.ndarray, cell: float, asked: np.ndarray) -> np.ndarray:
    found = np.empty(len(asked), dtype=np.int64)
    for row in range(len(asked)):
        found[row] = look_up(nearest, origin, cell, asked[row, 0], asked[row, 1], asked[row, 2])
    return found


def _time(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the minimum processor seconds of one call of `work`; short ones run often enough to be measured."""
    best = np.inf
    with one_blas_thread():
        started = time.process_time()
        work()
        calls = max(1, int(0.02 / max(time.process_time() - started, 1e-6)))
        for _ in range(repeats):
            started = time.process_time()
            for _ in range(calls):
                work()
            best = min(best, (time.process_time() - started) / calls)
    return float(best)


def _make_ratio_row(what: str, fast: float, slow: float) -> Row:
    return {"what": what, "milliseconds": 1000 * fast, "plain_milliseconds": 1000 * slow, "ratio": slow / fast}
