# SPDX-License-Identifier: Apache-2.0
"""Two people walk past each other before one depth camera; the nearer one hides the other for a while."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.evaluate.body.synthetic_scans import RaycastScene, make_box
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

pytestmark = pytest.mark.slow

FACTORY, PERIOD = BagMessageFactory(), 0.1  # seconds
CLOUDS, HEIGHT, SPEED = 44, 1.1, 0.45  # the camera's height in metres; metres a second
DISTANCES = (2.4, 3.4)  # metres from the camera
SEEN = 150  # points, of some 600, below which the farther one counts as hidden


def _walker(model: StitchedPuppet, index: int, cloud: int) -> tuple[BodyState, np.ndarray]:
    """One of the two at a cloud: walking along y, the first to the left, the second to the right; and the middle."""
    way = 1.0 if index == 0 else -1.0
    state = model.sample(np.random.default_rng(20 + index), pose_scale=0.3)
    turn = rotation.exp(np.array([0.0, 0.0, way * np.pi / 2]))
    place = np.array([DISTANCES[index], way * SPEED * PERIOD * (cloud - CLOUDS / 2), 0.0])
    state = replace(state, center=state.center @ turn.T, rotation=turn @ state.rotation)
    low = model.vertices(state)[:, 2].min()
    state = replace(state, center=state.center + place - np.array([0.0, 0.0, low + HEIGHT]))
    return state, model.vertices(state).mean(axis=0)


def _seen(model: StitchedPuppet, states: list[BodyState], rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """What the camera at the origin sees (N, 3) of two people on a floor, and how many points are the second."""
    around = [
        (model.vertices(states[0]), model.faces),
        make_box(np.array([3.0, 0.0, -HEIGHT - 0.05]), np.array([8.0, 10.0, 0.1]), np.eye(3)),
    ]
    y, z = np.meshgrid(np.linspace(-0.6, 0.6, 120), np.linspace(-0.55, 0.4, 100))
    rays = np.stack([np.ones(y.size), y.ravel(), z.ravel()], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance, on_second = RaycastScene(model.vertices(states[1]), model.faces, around).cast(np.zeros(3), rays)
    hit = np.isfinite(distance)
    noisy = distance[hit] + 0.005 * rng.standard_normal(np.count_nonzero(hit))
    return rays[hit] * noisy[:, None], int(np.count_nonzero(on_second))


def test_two_people_who_pass_each_other_keep_their_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    model, rng, searched = StitchedPuppet.load(), np.random.default_rng(0), []
    truth: list[tuple[BodyState, np.ndarray]] = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any = None, **_: Any) -> BodyFit:
        """Find whoever stands in the points, a little beside where they are."""
        searched.append(points.mean(axis=0))
        state = min(truth, key=lambda pair: float(np.linalg.norm(pair[1] - searched[-1])))[0]
        state = replace(state, center=state.center + np.array([0.02, -0.02, 0.0]))
        return fitter.assess(state, fitter.prepare_cloud(points, normals, viewpoint))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    settings = BodyFitterSettings.from_mapping(
        {"view": "single", "fitter.max_points": 800, "fitter.threads": 1, "tracker.gauss_newton_steps": 3}
    )
    component = BodyFitterComponent(settings, FACTORY)
    errors: dict[str, list[float]] = {}
    owner: dict[str, int] = {}
    hidden = 0
    for cloud in range(CLOUDS):
        truth[:] = [_walker(model, index, cloud) for index in range(2)]
        points, second = _seen(model, [state for state, _ in truth], rng)
        hidden += second < SEEN
        header = make_header(FACTORY, int((cloud + 1) * PERIOD * 1e9), "lidar")
        made = dict(component.handle("points", make_cloud(FACTORY, header, points)))
        for body in made["bodies"].bodies:
            joint = next(joint.position for joint in body.joints if joint.name == "pelvis")
            pelvis, at = np.array([joint.x, joint.y, joint.z]), model.joint_names.index("pelvis")
            apart = [float(np.linalg.norm(pelvis - model.joints(model.vertices(state))[at])) for state, _ in truth]
            errors.setdefault(body.id, []).append(apart[owner.setdefault(body.id, int(np.argmin(apart)))])
    assert hidden > 2, "the nearer one does hide the other"
    assert sorted(owner) == ["b1", "b2"] and sorted(owner.values()) == [0, 1]
    near, far = (errors[identity] for identity in sorted(owner, key=lambda identity: owner[identity]))
    assert len(near) >= CLOUDS - 1, "who is always seen is always shown"
    assert len(far) > CLOUDS - 14
    assert max(map(max, errors.values())) < 0.2
    assert np.mean(near) < 0.06 and np.mean(far) < 0.08
    assert component.report.drain_warnings() == []
