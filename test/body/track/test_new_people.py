# SPDX-License-Identifier: Apache-2.0
"""New people in a live stream of whole clouds: a reliable body at once, or a full fit beside the clouds."""

from typing import Any, cast

import numpy as np
import pytest
from kept_tasks import KeptTasks  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.body.track.multi_body_tracker import MultiBodyTracker, MultiBodyTrackerSettings
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread

TENTH = 100_000_000


def _make_clouds(fitter: BodyFitter, stamp: int) -> tuple[list[PersonCloud], list[np.ndarray]]:
    """Return the clouds of three people who stand beside each other, and their true vertices."""
    rng, clouds, truth = np.random.default_rng(4), [], []
    for number in range(3):
        body = fitter.model.sample(rng, pose_scale=0.3)
        vertices = fitter.model.vertices(body) + np.array([0.0, 1.5 * number, 0.0])
        clouds.append(PersonCloud(vertices + 0.002 * rng.standard_normal(vertices.shape), stamp=stamp))
        truth.append(vertices)
    return clouds, truth


@pytest.mark.slow
def test_new_people_have_a_body_in_their_first_cloud_where_it_is_reliable() -> None:
    fitter = BodyFitter(StitchedPuppet.load("neutral"), FitterSettings(threads=1))
    tracker, never = MultiBodyTracker(fitter, MultiBodyTrackerSettings(), 0), KeptTasks()
    clouds, truth = _make_clouds(fitter, TENTH)
    with one_blas_thread():
        bodies = tracker.step(clouds, TENTH, 0, cast(Any, never))
    assert len(bodies) >= 2, "several at once"
    for body in bodies:
        vertices = truth[int(body.id.removeprefix("b")) - 1]
        assert body.fit.reliable and np.linalg.norm(body.fit.vertices - vertices, axis=1).mean() < 0.03
    assert len(never.tasks) == (len(bodies) < 3), "one of the others has a full fit beside the clouds"


@pytest.mark.slow
def test_what_no_body_is_close_to_is_fitted_beside_the_clouds_and_tried_at_once_every_second() -> None:
    fitter = BodyFitter(StitchedPuppet.load("neutral"), FitterSettings(threads=1))
    tracker, never = MultiBodyTracker(fitter, MultiBodyTrackerSettings(), 0), KeptTasks()
    ball = np.random.default_rng(0).standard_normal((1000, 3))
    ball = 0.6 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    tries: list[int] = []
    at_once = fitter.fit_at_once
    fitter.fit_at_once = lambda *cloud: tries.append(len(cloud[0])) or at_once(*cloud)  # type: ignore[method-assign, func-returns-value]
    for number in (1, 2, 3, 12):
        cloud = PersonCloud(ball, stamp=number * TENTH)
        assert not tracker.step([cloud], number * TENTH, 0, cast(Any, never))
    assert tries == [1000, 1000] and len(never.tasks) == 1
