# SPDX-License-Identifier: Apache-2.0
"""The body fitter component follows a person through clouds, when it is told to."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.evaluate.body.synthetic_scans import sample_surface
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
FRAME, STEP = 50_000_000, 0.03  # nanoseconds, metres
SETTINGS: dict[str, Any] = {"tracker.max_points": 600, "tracker.gauss_newton_steps": 2, "view": "full"}


@pytest.fixture(autouse=True)
def found(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The seeds of all full fits, each of which finds a standing person at the first cloud's place."""
    seeds = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, seed: int, **_: Any) -> BodyFit:
        seeds.append(seed)
        state = fitter.model.rest_state()
        there = replace(state, center=state.center + np.array([0.0, 0.0, 1.0]))
        return fitter.assess(there, fitter.prepare_cloud(points, normals, None))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    return seeds


@pytest.fixture(scope="module")
def clouds() -> list[Any]:
    """A person walking through three clouds, 50 ms apart."""
    model = StitchedPuppet.load()
    standing = model.vertices(model.rest_state())
    made = []
    for frame in range(3):
        rng = np.random.default_rng(frame)
        points, normals = sample_surface(standing + np.array([STEP * frame, 0, 1.0]), model.faces, rng, 600)
        header = make_header(FACTORY, (frame + 1) * FRAME, "map")
        made.append(make_cloud(FACTORY, header, points, normals))
    return made


def _pelvis(component: BodyFitterComponent, cloud: Any) -> np.ndarray:
    body = dict(component.handle("points", cloud))["bodies"].bodies[0]
    place = next(joint.position for joint in body.joints if joint.name == "pelvis")
    return np.array([place.x, place.y, place.z])


@pytest.mark.slow
def test_a_tracked_person_is_searched_for_once(clouds: list[Any], found: list[int]) -> None:
    for scene in (True, False):
        found.clear()
        component = BodyFitterComponent(BodyFitterSettings.from_mapping({**SETTINGS, "scene": scene}), FACTORY)
        pelvis = [_pelvis(component, cloud) for cloud in clouds]
        np.testing.assert_allclose(np.diff(pelvis, axis=0), np.tile([STEP, 0, 0], (2, 1)), atol=0.005)
        assert len(found) == 1
        component.reset()
        _pelvis(component, clouds[0])
        assert len(found) == 2 and found[1] != found[0], "the second person has another number"


@pytest.mark.slow
def test_without_tracking_every_cloud_is_searched(clouds: list[Any], found: list[int]) -> None:
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({**SETTINGS, "track": False}), FACTORY)
    for cloud in clouds:
        _pelvis(component, cloud)
    assert found == [component.seed_of((frame + 1) * FRAME) for frame in range(3)]
