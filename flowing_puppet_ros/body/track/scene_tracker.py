# SPDX-License-Identifier: Apache-2.0
"""Find the people in the clouds of a stream and fit a body to each: region, segmentation, viewpoint, tracks."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from flowing_puppet_ros.arrays import F64, I64
from flowing_puppet_ros.body.cloud.airborne import find_airborne
from flowing_puppet_ros.body.cloud.coverage import is_single_view
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, Progress
from flowing_puppet_ros.body.scene.rig_scene import shows_person
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.scene.sensor_height import SensorHeight
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights, find_candidates
from flowing_puppet_ros.body.segmentation.floor_grid import describe_problem
from flowing_puppet_ros.body.segmentation.people import segment_people
from flowing_puppet_ros.body.segmentation.planes import PlaneCache
from flowing_puppet_ros.body.segmentation.seen_free import SeenFree
from flowing_puppet_ros.body.settings import SegmentationSettings
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTracker, MultiBodyTrackerSettings
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.body.upright.found_body import ExpectedPerson, FitBudget, FoundBody, JudgedFit, SearchedScan
from flowing_puppet_ros.body.upright.person_finder import PersonFinder, PersonFinderSettings
from flowing_puppet_ros.body.upright.rejected_places import RejectedCandidate
from flowing_puppet_ros.body.upright.scan_rays import ScanRays
from flowing_puppet_ros.body.upright.upright_fit import MIN_MANY_POINTS
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.process.threads import usable_threads
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.settings import Settings, nested, setting

MAX_HEIGHT_M = 2.6
"""A cloud that is no wider is a person, when nobody can be told from their surroundings in it."""
_NOBODY = "there is nobody in the cloud of {} points; turn scene off to fit it all"
MAX_MISSES = 8
"""Candidates in a row that have to be nobody until no more are fitted in a scan of a recording, the likeliest first."""
MAX_FIRST_FITS, MAX_LIVE_FITS = 8, 2
"""Candidates to which a quick body is fitted in a scan of a live stream, while nobody is tracked and afterwards, so
that the first bodies do not wait for others, which come with the next."""
SEARCH_EVERY = 3  # scans of a live stream in which somebody is tracked: the others are not searched for new people
MAX_SCENE_POINTS = 300_000  # of a one-sided scene, evenly taken: more say nothing new about who is in it
_MOVES = (
    "much of what is seen seems to have moved, so the sensor moves against the frame in which people are tracked: set"
    " fixed_frame (odom), or check its transforms; until then furniture is more easily taken for people"
)
_NO_FLOOR = (
    "no floor is seen: how high people stand is inferred from their build, so they are not reliable; set"
    " segmentation.sensor_height, or publish base_footprint on /tf"
)
INFERRED_CONFIDENCE = 0.5  # of a body on an inferred floor, relative to one on a floor that is seen
MAX_REJECTED = 50  # candidates that are told of
MIN_DECIDING_POINTS = 60
"""Points of a person from which on they tell whether people are seen from one side."""
ONLY_ID = "b1"
"""Id of the person when all of a cloud is one person."""


@dataclass(frozen=True)
class SceneSettings(Settings):
    """Where people are searched for, how they are seen, and whether they are tracked."""

    view: str = setting(
        "auto",
        "people are seen from all sides (full) or from one sensor at the frame's origin (single); auto: decided by"
        " the first person's points",
        choices=("auto", "full", "single"),
    )
    track: bool = setting(True, "track people from cloud to cloud where no initial joints are given")
    scene: bool = setting(
        True,
        "segment the people from floor, walls and furniture where no initial joints are given; off: the whole cloud is"
        " one person",
    )
    segmentation: SegmentationSettings = nested(SegmentationSettings)
    people: PersonFinderSettings = nested(PersonFinderSettings)
    tracker: MultiBodyTrackerSettings = nested(MultiBodyTrackerSettings)


class SceneTracker:
    """Finds the people in clouds and fits a body to each: tracked, or every cloud for itself."""

    def __init__(self, fitter: BodyFitter, settings: SceneSettings, report: Report | None = None) -> None:
        """Fit with `fitter`; see `MultiBodyTracker` for the `report`."""
        self._fitter = fitter
        self._settings = settings
        self._tracker = MultiBodyTracker(fitter, settings.tracker, fitter.settings.seed, report)
        self._single_view: bool | None = None
        self._planes = PlaneCache()
        self._finder = PersonFinder(fitter, settings.people)
        self._seen_free = SeenFree()
        self._height = SensorHeight()
        self._sees_floor = True
        self._searched = np.empty(0, dtype=np.int64)
        self._was_searched = False
        self._since_search = 0
        self._report = report or Report()

    def warm_up(self) -> None:
        """Do beforehand what the first cloud would wait for."""
        self._fitter.warm_up()
        standing = self._fitter.model.vertices(self._fitter.model.rest_state())
        segment_people(standing, None, self._settings.segmentation)
        self._finder.warm_up()

    def reset(self) -> None:
        """Forget everybody."""
        self._tracker.reset()
        self._single_view = None
        self._planes = PlaneCache()
        self._finder.reset()
        self._seen_free.reset()
        self._height.reset()
        self._was_searched = False

    @property
    def rejected(self) -> Sequence[RejectedCandidate]:
        """What was no person in the last cloud in which people were looked for from one side, the likeliest first."""
        return sorted(self._finder.last_rejected, key=lambda one: -one.probability)[:MAX_REJECTED]

    @property
    def sees_one_side(self) -> bool:
        """Whether people are seen from one side: as set, or as the first one's points look."""
        return self._settings.view == "single" or (self._settings.view == "auto" and bool(self._single_view))

    def step(
        self, cloud: SceneCloud, seed: int, executor: Executor | None = None
    ) -> tuple[list[TrackedBody], list[str]]:
        """Return the bodies of everybody in the next cloud, and the ids of those who are out of sight for now.

        Full fits run on the `executor`, or in line. InputError when the cloud cannot be one of people.

            scene | track | what is done
            off   | off   | a full fit of the whole cloud, as one person
            off   | on    | the one person is tracked
            on    | off   | people are segmented and named, a full fit of each
            on    | on    | people are segmented with the help of the known bodies, and tracked

        In single views a new person has an upright body at once, which is refined by a full fit where it is doubtful.
        """
        settings = self._settings
        self.check(cloud)
        if not settings.scene:
            (person,) = self._with_viewpoint(cloud, [cloud.whole])
            if not settings.track:
                return [TrackedBody(ONLY_ID, self._fit(person, seed))], []
            return self._tracker.step_one(person, seed, executor), []
        known = self._tracker.predict_bodies(cloud.stamp) if settings.track else ()
        if self._is_one_sided(cloud, remember=True):
            live = executor is not None and settings.track
            expected = self._tracker.expect_people(cloud.stamp) if live else ()
            found = self._find(cloud, known, expected, settings.track, live)
            if not settings.track:
                fits = {id(body.person): body.fit for body in found}
                named = self._tracker.associate_only([body.person for body in found], cloud.stamp)
                improved = [(name, self._improve(person, fits[id(person)], seed)) for name, person in named]
                return [TrackedBody(name, self._doubt(fit)) for name, fit in improved], []
            first = {number: body.fit for number, body in enumerate(found) if body.fit is not None}
            seen = [body.person for body in found]
            judge = partial(self._judge, quick=live)
            moves = self._seen_free.moves
            bodies = self._tracker.step(seen, cloud.stamp, seed, executor, first, judge, moves)
            return [replace(body, fit=self._doubt(body.fit)) for body in bodies], self._tracker.occluded_ids
        people = self._with_viewpoint(cloud, self._segment(cloud, known, self._planes))
        if settings.track:
            return self._tracker.step(people, cloud.stamp, seed, executor), self._tracker.occluded_ids
        named = self._tracker.associate_only(people, cloud.stamp)
        return [TrackedBody(identity, self._fit(person, seed)) for identity, person in named], []

    def step_alone(self, cloud: SceneCloud, seed: int) -> list[TrackedBody]:
        """Return the bodies of everybody in a cloud that nothing joins to the others of the stream, under new ids."""
        try:
            bodies = self.fit_once(cloud, seed)
        except InputError:  # nobody
            return []
        return [replace(body, id=self._tracker.make_id()) for body in bodies]

    def fit_once(self, cloud: SceneCloud, seed: int, progress: Progress | None = None) -> list[TrackedBody]:
        """Return the bodies of everybody in a cloud that belongs to no stream; ids count from b1.

        Where nobody can be told from surroundings, a cloud of a person's size is the person.
        """
        extent = np.ptp(cloud.points, axis=0).max(initial=0.0) if len(cloud.points) else 0.0
        if self._settings.scene and self.is_one_sided_scene(cloud):
            proven = self.fit_found(self.find_once(cloud), seed, progress)
            if not proven:
                problem = describe_problem(self._in_range(cloud)[1], cloud.viewpoint, nobody=True)
                raise InputError("; ".join(filter(None, (_NOBODY.format(len(cloud.points)), problem))))
            return [TrackedBody(f"b{number}", fit) for number, fit in enumerate(proven, start=1)]
        people = self._segment(cloud) if self._settings.scene else []
        if not people and (not self._settings.scene or extent <= MAX_HEIGHT_M):
            people = [cloud.whole]
        if not people:
            raise InputError(_NOBODY.format(len(cloud.points)))
        people = self._with_viewpoint(cloud, people, remember=False)
        fits = [(person, self._fit(person, seed, progress)) for person in people]
        proven = [fit for person, fit in fits if person.proven or shows_person(person, fit)]
        return [TrackedBody(f"b{number}", fit) for number, fit in enumerate(proven, start=1)]

    def find_once(self, cloud: SceneCloud) -> list[FoundBody]:
        """Find the people in a one-sided scene that belongs to no stream, the likeliest first."""
        return self._find(cloud)

    def fit_found(self, found: Sequence[FoundBody], seed: int, progress: Progress | None = None) -> list[BodyFit]:
        """Return the bodies of people found in a scene, fitted again where that may help, without the doubtful."""
        fits = [(self._improve(body.person, body.fit, seed, progress), body.person.proven) for body in found]
        return [self._doubt(fit) for fit, proven in fits if proven or fit.reliable]

    def is_one_sided_scene(self, cloud: SceneCloud) -> bool:
        """Return whether a cloud shows people from one side, and more than one person alone."""
        extent = np.ptp(cloud.points, axis=0).max(initial=0.0) if len(cloud.points) else 0.0
        return bool(extent > MAX_HEIGHT_M) and self._is_one_sided(cloud, remember=False)

    def _is_one_sided(self, cloud: SceneCloud, remember: bool) -> bool:
        """Return whether people are seen from one side: known, set, decided before, or as the likeliest one looks."""
        if cloud.is_merged:
            return False
        if cloud.single_view or self._settings.view == "single":
            return True
        if self._settings.view == "full" or self._single_view is not None:
            return bool(self._single_view) and self._settings.view != "full"
        points = self._in_range(cloud)[1]
        candidates = (
            find_candidates(
                SceneHeights.of(points, cloud.viewpoint, height=self._find_height(cloud)),
                cloud.viewpoint,
                MIN_DECIDING_POINTS,
            )[0]
            if len(points)
            else []
        )
        if not candidates:
            return False
        likeliest = max(candidates, key=lambda candidate: len(candidate.rows))
        single = is_single_view(points[likeliest.rows] - cloud.viewpoint)
        if remember:
            self._single_view = single
        return single

    def _in_range(self, cloud: SceneCloud) -> tuple[I64, F64]:
        """Return the rows of the points that are finite and in range of the sensor, and no drops, and the points."""
        rows = np.flatnonzero(cloud.distance < self._settings.segmentation.max_range)
        if len(rows) > MAX_SCENE_POINTS:
            rows = rows[np.linspace(0, len(rows) - 1, MAX_SCENE_POINTS).astype(np.int64)]
        points = np.asarray(cloud.points[rows], dtype=np.float64)
        alone = find_airborne(points, cloud.viewpoint)
        return (rows[~alone], points[~alone]) if alone.any() else (rows, points)

    def _find(
        self,
        cloud: SceneCloud,
        known: Sequence[F64] = (),
        expected: Sequence[ExpectedPerson] = (),
        remember: bool = False,
        live: bool = False,
    ) -> list[FoundBody]:
        """Find the people of a single view; the known ones first. All, or of a live stream the likeliest."""
        rows, points = self._in_range(cloud)
        self._searched = rows
        normals = None if cloud.normals is None else cloud.normals[rows]
        # Who is tracked needs no search, and who comes can wait for a few scans.
        is_tracked = any(len(body) for body in known)
        only_known = live and is_tracked and self._since_search + 1 < SEARCH_EVERY and not self._finder.left_over
        self._since_search = self._since_search + 1 if only_known else 0
        come = self._seen_free.add(points, cloud.viewpoint) if remember and not only_known else None
        scene = self._lay_floor(cloud, points, remember) if len(points) else None
        scan = SearchedScan(scene, cloud.viewpoint, cloud.stamp, normals, known, expected, come)
        search = partial(self._finder.find, scan, self._make_budget(remember, live, is_tracked), remember, only_known)
        # Who is tracked will need the range image.
        if live and is_tracked and usable_threads(self._fitter.settings.threads) > 1:
            with ThreadPoolExecutor(1) as beside:
                drawn = beside.submit(cloud.with_image)
                found, cloud = search(), drawn.result()
        else:
            found = search()
        self._tell_problems(points, cloud.viewpoint, not found)
        people = cloud.with_fields([replace(body.person, rows=rows[body.person.rows]) for body in found])
        moved = [FoundBody(person, body.fit) for person, body in zip(people, found, strict=True)]
        return moved[: max(self._settings.segmentation.max_people, sum(body.fit is None for body in moved))]

    def _tell_problems(self, points: F64, viewpoint: F64, nobody: bool) -> None:
        """Say once what is wrong with the scans, if anything is, by the first points (N, 3) m."""
        if not self._was_searched and len(points):
            self._was_searched = True
            problem = describe_problem(points, viewpoint, nobody)
            if problem:
                self._report.warn(problem)
        if self._seen_free.moves:
            self._report.warn(_MOVES)

    def _lay_floor(self, cloud: SceneCloud, points: F64, remember: bool) -> SceneHeights:
        """Return the heights of the points (N, 3) m, N > 0, in range; where no floor is seen, over the likeliest."""
        height = self._height if remember else SensorHeight()
        given = self._find_height(cloud)
        make_rays = cache(lambda: ScanRays(points, cloud.viewpoint))  # few scans need them

        def rate(scene: SceneHeights) -> float:
            return self._finder.rate_floor(scene, make_rays())

        scene = height.lay_floor(points, cloud.viewpoint, cloud.stamp, given, rate)
        self._sees_floor = height.is_known
        return scene

    def _find_height(self, cloud: SceneCloud) -> float | None:
        """Return the height of a cloud's sensor over the floor, metres, where it is known."""
        return cloud.sensor_height or self._settings.segmentation.sensor_height or None

    def _doubt(self, fit: BodyFit) -> BodyFit:
        """Return a body, not reliable where nothing but people's build told how high the floor is."""
        if self._sees_floor:
            return fit
        self._report.warn(_NO_FLOOR)
        return replace(fit, reliable=False, confidence=INFERRED_CONFIDENCE * fit.confidence)

    def _make_budget(self, is_stream: bool, is_live: bool, is_tracked: bool) -> FitBudget:
        """Return how many bodies are fitted in a scan."""
        if is_live:
            return FitBudget(MAX_LIVE_FITS if is_tracked else MAX_FIRST_FITS, quick=True)
        return FitBudget(self._settings.people.max_fits, MAX_MISSES if is_stream else None)

    def _judge(self, person: PersonCloud, fit: BodyFit, turn: bool, quick: bool) -> JudgedFit:
        """Return what the cloud that was searched last says about a body: see `PersonFinder.judge`."""
        assert person.rows is not None
        return self._finder.judge(person, np.searchsorted(self._searched, np.sort(person.rows)), fit, turn, quick)

    def _improve(
        self, person: PersonCloud, fit: BodyFit | None, seed: int, progress: Progress | None = None
    ) -> BodyFit:
        """Return the body, or that of a full fit where many points are there and it is closer to them."""
        if fit is None or (not fit.reliable and len(person.points) >= MIN_MANY_POINTS):
            full = self._fit(person, seed, progress)
            if fit is None:
                return full
            if full.two_way_distance < fit.two_way_distance:
                return replace(self._finder.choose_facing(person, fit, full), confidence=fit.confidence)
        return fit

    def _segment(
        self, cloud: SceneCloud, known: Sequence[F64] = (), planes: PlaneCache | None = None
    ) -> list[PersonCloud]:
        people = segment_people(
            cloud.points, cloud.normals, self._settings.segmentation, self._sensor(cloud), known, planes
        )
        return [replace(person, stamp=cloud.stamp) for person in people]

    def check(self, cloud: SceneCloud) -> None:
        """Raise an InputError when a cloud has no point, or none in range."""
        if not len(cloud.points):
            raise InputError("the cloud has no finite point in the region of interest")
        distance, limit = cloud.distance.min(), self._settings.segmentation.max_range
        if self._sensor(cloud) is not None and distance > limit:
            raise InputError(
                f"the nearest point of the cloud is {distance:.3g} m from the origin of its frame, beyond the"
                f" segmentation.max_range of {limit:g} m; check the unit, or raise that"
            )

    def _fit(self, person: PersonCloud, seed: int, progress: Progress | None = None) -> BodyFit:
        return self._fitter.fit(
            person.points,
            person.normals,
            viewpoint=person.viewpoint,
            field=person.field,
            seed=seed,
            progress=progress,
        )

    def _sensor(self, cloud: SceneCloud) -> F64 | None:
        """Return where the sensor is for the segmentation, unless people are seen from all sides."""
        full = self._settings.view == "full" or (self._settings.view == "auto" and self._single_view is False)
        return None if cloud.is_merged or (full and not cloud.single_view) else cloud.viewpoint

    def _with_viewpoint(self, cloud: SceneCloud, people: list[PersonCloud], remember: bool = True) -> list[PersonCloud]:
        """Return the people with the viewpoint for their fits.

        of several sensors         | that of each
        known to be a single view  | the sensor's place
        setting full or single     | none, or the sensor's place
        auto, decided before       | as before
        auto, not decided          | what the first person's points look like
        """
        if cloud.is_merged:
            return cloud.with_fields(people)
        single = (
            True if cloud.single_view else {"single": True, "full": False}.get(self._settings.view, self._single_view)
        )
        if single is None and people:
            single = is_single_view(people[0].points - cloud.viewpoint)
            if remember:
                self._single_view = single
        return (
            cloud.with_fields([replace(person, viewpoint=cloud.viewpoint) for person in people]) if single else people
        )
