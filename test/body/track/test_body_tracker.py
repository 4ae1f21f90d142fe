# SPDX-License-Identifier: Apache-2.0
"""Tracking one person through clouds: warm starts, loss and recovery, jumps of time."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, Progress
from flowing_puppet_ros.body.settings import BodyTrackerSettings, FitterSettings
from flowing_puppet_ros.body.track.body_tracker import BodyTracker
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.body.synthetic_scans import RaycastScene, sample_surface, scan_whole
from flowing_puppet_ros.evidence.cloud.sensor_field import PINHOLE, SensorField, SensorProjection
from flowing_puppet_ros.evidence.cloud.sensor_rig import SensorRig
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

FRAME = 50_000_000  # nanoseconds
SETTINGS = BodyTrackerSettings(max_points=1500)


class _KnowingFitter(BodyFitter):
    """Its full fit finds the body that it was told, at once."""

    truth: BodyState

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
        return self.assess(self.truth, self.prepare_cloud(points, normals, viewpoint, field))


@pytest.fixture(scope="module")
def fitter() -> _KnowingFitter:
    return _KnowingFitter(StitchedPuppet.load(), FitterSettings())


@pytest.fixture(scope="module")
def person(fitter: _KnowingFitter) -> BodyState:
    state = fitter.model.sample(np.random.default_rng(3), shape_scale=0.7, pose_scale=0.7)
    return replace(state, center=state.center + np.array([2.0, 1.0, 1.0]))


def _at(person: BodyState, frame: float, speed: float = 0.04) -> BodyState:
    """The person walking along x and turning about the vertical through its pelvis."""
    turn = rotation.exp(np.array([0.0, 0.0, 0.05 * frame]))
    middle = person.center[0]
    center = (person.center - middle) @ turn.T + middle + np.array([speed * frame, 0.0, 0.0])
    return replace(person, center=center, rotation=turn @ person.rotation)


def _cloud(
    model: StitchedPuppet, state: BodyState, seed: int = 0, noise: float = 0.003
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points, normals = sample_surface(model.vertices(state), model.faces, rng, 1500)
    return points + noise * rng.standard_normal(points.shape), normals


def _step(
    tracker: BodyTracker,
    points: np.ndarray,
    normals: np.ndarray | None,
    stamp: int,
    viewpoint: np.ndarray | None = None,
) -> BodyFit:
    return tracker.track_or_refit(PersonCloud(points, normals, stamp, viewpoint))


def _error(fitter: BodyFitter, fit: BodyFit, truth: BodyState) -> float:
    return float(np.linalg.norm(fit.vertices - fitter.model.vertices(truth), axis=1).mean())


def test_a_walk_is_followed_without_searching(fitter: _KnowingFitter, person: BodyState) -> None:
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = _at(person, 0)
    for frame in range(6):
        truth = _at(person, frame)
        fit = _step(tracker, *_cloud(fitter.model, truth, frame), frame * FRAME)
        assert _error(fitter, fit, truth) < 0.012
    assert tracker.counters == {"searched": 1, "tracked": 5}


@pytest.mark.slow
def test_motion_goes_on_at_its_velocity(fitter: _KnowingFitter, person: BodyState) -> None:
    """At 25 cm a frame the last body is too far to start from; the extrapolated one is not."""
    moving, standing = BodyTracker(fitter, SETTINGS), BodyTracker(fitter, SETTINGS)
    fitter.truth = _at(person, 0)
    for tracker, frames in ((moving, (0, 0.2, 0.6, 1.2, 2.0, 3.0, 4.0)), (standing, (0, 0, 0, 0, 0, 0, 4.0))):
        for count, frame in enumerate(frames):
            truth = _at(person, frame, speed=0.25)
            fit = _step(tracker, *_cloud(fitter.model, truth, count), count * FRAME)
        if tracker is moving:
            assert _error(fitter, fit, truth) < 0.015
    assert moving.counters["searched"] == 1
    assert standing.counters["widened"] == 1


@pytest.mark.slow
def test_a_lost_person_is_searched_for(fitter: _KnowingFitter, person: BodyState) -> None:
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = person
    for frame in range(3):
        _step(tracker, *_cloud(fitter.model, person, frame), frame * FRAME)
    elsewhere = replace(person, center=person.center + np.array([3.0, -2.0, 0.0]))
    fitter.truth = elsewhere
    fit = _step(tracker, *_cloud(fitter.model, elsewhere), 3 * FRAME)
    assert _error(fitter, fit, elsewhere) < 0.012
    assert tracker.counters["searched"] == 2
    # The jump is no velocity.
    fit = _step(tracker, *_cloud(fitter.model, elsewhere), 4 * FRAME)
    assert _error(fitter, fit, elsewhere) < 0.012
    assert tracker.counters["searched"] == 2


@pytest.mark.parametrize("stamp", [-FRAME, 0])
def test_time_that_jumps_back_starts_a_new_track(fitter: _KnowingFitter, person: BodyState, stamp: int) -> None:
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = person
    _step(tracker, *_cloud(fitter.model, person), 0)
    _step(tracker, *_cloud(fitter.model, person), stamp)
    assert tracker.counters["searched"] == 2


def test_a_person_is_found_again_after_a_gap(fitter: _KnowingFitter, person: BodyState) -> None:
    """As after the first search of a live stream: seconds later, somewhere else, in about the same pose."""
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = person
    _step(tracker, *_cloud(fitter.model, person), 0)
    later = _at(replace(person, center=person.center + np.array([0.5, -1.5, 0.0])), 4)
    fit = _step(tracker, *_cloud(fitter.model, later), 80 * FRAME)
    assert _error(fitter, fit, later) < 0.012
    assert tracker.counters["searched"] == 1


@pytest.mark.slow
def test_a_wrong_search_does_not_replace_a_better_track(fitter: _KnowingFitter, person: BodyState) -> None:
    tracker = BodyTracker(fitter, BodyTrackerSettings(max_points=1500, lost_ratio=1.0, lost_distance=0.0))
    fitter.truth = person
    for frame in range(4):
        fit = _step(tracker, *_cloud(fitter.model, person, frame, noise=0.002 * frame), frame * FRAME)
        fitter.truth = _at(person, 30)
        assert _error(fitter, fit, person) < 0.015
    assert tracker.counters["searched"] > 1


def test_shape_is_learned_over_one_sided_frames(fitter: _KnowingFitter, person: BodyState) -> None:
    """From the mean shape, every frame from another side brings the shape nearer to the person's."""
    model, tracker = fitter.model, BodyTracker(fitter, SETTINGS)
    fitter.truth = replace(person, shape=np.zeros_like(person.shape))
    middle = person.center[0]
    shapes = []
    for frame in range(8):
        angle = 0.8 * frame
        eye = middle + 3 * np.array([np.cos(angle), np.sin(angle), 0.0])
        points, normals = _cloud(model, person, frame)
        near = ((eye - points) * normals).sum(axis=1) > 0
        fit = _step(tracker, points[near], normals[near], frame * FRAME, eye)
        shapes.append(fit.state.shape[0])
    error = np.linalg.norm(np.array(shapes)[:, :3] - person.shape[0, :3], axis=1)
    assert error[-1] < 0.5 * error[0]
    change = np.linalg.norm(np.diff(shapes, axis=0), axis=1)
    assert change[-1] < change[1]


def test_the_same_clouds_give_the_same_bytes(fitter: _KnowingFitter, person: BodyState) -> None:
    def run() -> bytes:
        tracker = BodyTracker(fitter, SETTINGS)
        fitter.truth = person
        for frame in range(3):
            fit = _step(tracker, *_cloud(fitter.model, _at(person, frame), frame), frame * FRAME)
        return fit.vertices.tobytes()

    assert run() == run()


@pytest.mark.parametrize(
    "spoil", [lambda p: p[:10], lambda p: np.full_like(p, np.nan), lambda p: p[:, :2], lambda p: 1000 * p]
)
def test_a_bad_cloud_is_named_and_the_track_goes_on(
    fitter: _KnowingFitter, person: BodyState, spoil: Callable[[np.ndarray], np.ndarray]
) -> None:
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = person
    points, normals = _cloud(fitter.model, person)
    _step(tracker, points, normals, 0)
    with pytest.raises(InputError):
        _step(tracker, spoil(points), None, FRAME)
    _step(tracker, points, normals, 2 * FRAME)
    assert tracker.counters == {"searched": 1, "tracked": 1}


def test_clouds_without_normals_are_tracked(fitter: _KnowingFitter, person: BodyState) -> None:
    pytest.importorskip("open3d")  # casts the rays
    tracker = BodyTracker(fitter, SETTINGS)
    fitter.truth = person
    model = fitter.model
    for frame in range(3):
        truth = _at(person, frame)
        scan = scan_whole(
            RaycastScene(model.vertices(truth), model.faces), np.random.default_rng(frame), 1500, noise=0.003
        )
        fit = _step(tracker, scan.points, None, frame * FRAME)
        assert _error(fitter, fit, truth) < 0.015


def test_legs_that_are_out_of_view_stay_where_they_are(fitter: _KnowingFitter, person: BodyState) -> None:
    """Of the person who comes nearer the sensor sees no more than what is above the hips; the body stays whole."""
    viewpoint = person.center[0] + np.array([3.0, 0.0, 0.3])
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    projection = SensorProjection(viewpoint, axes, np.full(2, 100.0), np.zeros(2), PINHOLE)
    field = SensorField(projection, np.array([-np.inf, -np.inf, np.inf, 10.0]), np.zeros((0, 0), np.float32))
    feet = np.isin(fitter.model.part_of_vertex, [fitter.model.tree.index(f"{side}_foot") for side in ("left", "right")])
    error, gap = {}, {}
    for limit in (field, None):
        tracker = BodyTracker(fitter, SETTINGS)
        fitter.truth = person
        for frame in range(4):
            truth = _at(person, frame, speed=0.02)
            points, normals = _cloud(fitter.model, truth, frame)
            seen = (((viewpoint - points) * normals).sum(axis=1) > 0) & ~field.find_unknown(points)
            fit = tracker.track_or_refit(
                PersonCloud(points[seen], normals[seen], frame * FRAME, viewpoint, field=limit)
            )
        vertices = fitter.model.vertices(truth)
        assert field.find_unknown(vertices[feet]).all()
        gap[limit] = np.linalg.norm(fit.vertices - vertices, axis=1)[feet].mean()
        error[limit] = fit.two_way_distance
    assert gap[field] < 0.05 < gap[None]
    assert error[field] < 0.02 < error[None]
