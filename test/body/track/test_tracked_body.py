# SPDX-License-Identifier: Apache-2.0
"""What is known of a person's motion: against a walk whose speed is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.track.tracked_body import TorsoMotion, TrackedBody, TrackStatus
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.model.sp import StitchedPuppet

SPEED = np.array([1.2, -0.4, 0.0])
INTERVAL_NS = 100_000_000


def body_at(place: np.ndarray) -> BodyFit:
    model = StitchedPuppet.load()
    state = model.rest_state()
    state = replace(state, center=state.center + place)
    vertices = model.vertices(state)
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, np.int8))
    return BodyFit(state, vertices, model.joints(vertices), 0.0, np.ones(16), 1.0, True, 0.0, seen)


def test_the_velocity_is_that_of_the_walk_in_spite_of_noise() -> None:
    rng = np.random.default_rng(0)
    motion = TorsoMotion()
    measured = []
    for k in range(30):
        noise = rng.normal(scale=0.01, size=3)
        found = motion.add("b1", k * INTERVAL_NS, body_at(0.1 * k * SPEED + noise))
        measured.append(found.velocity)
    assert np.linalg.norm(measured[6:] - SPEED, axis=1).mean() < 0.06, "two places alone would miss by 0.2 m/s"
    np.testing.assert_allclose(np.mean(measured[6:], axis=0), SPEED, atol=0.03)


def test_a_turn_is_followed_within_half_a_second() -> None:
    motion, place = TorsoMotion(), np.zeros(3)
    for k in range(20):
        velocity = SPEED if k < 10 else -SPEED
        place = place + 0.1 * velocity
        found = motion.add("b1", k * INTERVAL_NS, body_at(place))
        if k in (9, 15):
            np.testing.assert_allclose(found.velocity, velocity, atol=1e-6)


def test_the_first_body_is_new_and_so_is_the_first_of_a_new_recording() -> None:
    motion, fit = TorsoMotion(), body_at(np.zeros(3))
    assert motion.add("b1", 5, fit).status is TrackStatus.NEW
    assert motion.add("b1", 10, fit).status is TrackStatus.TRACKED
    assert motion.add("b1", 20, fit, hidden=True).status is TrackStatus.HIDDEN
    again = motion.add("b1", 1, body_at(SPEED))
    assert again.status is TrackStatus.NEW
    assert not again.velocity.any()


def test_a_turned_frame_turns_body_and_velocity_alike() -> None:
    motion = TorsoMotion()
    motion.add("b1", 0, body_at(np.zeros(3)))
    found = motion.add("b1", INTERVAL_NS, body_at(0.1 * SPEED))
    turned = found.move(rotation.exp(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    np.testing.assert_allclose(turned.velocity, [0.4, 1.2, 0.0], atol=1e-6)
    joints = np.stack([-found.fit.joints[:, 1], found.fit.joints[:, 0], found.fit.joints[:, 2]], axis=1)
    np.testing.assert_allclose(turned.fit.joints, joints, atol=1e-12)
    assert turned.fit.vertices[:, 1].mean() == pytest.approx(found.fit.vertices[:, 0].mean())


def test_a_jump_that_nobody_can_make_is_not_sure_until_the_next_body_agrees() -> None:
    motion, fit = TorsoMotion(), body_at(np.zeros(3))
    around = TrackedBody("b1", fit).move(rotation.exp(np.array([0.0, 0.0, np.pi])), np.zeros(3)).fit
    step = 67_000_000
    assert motion.add("b1", 0, fit).fit.reliable
    assert motion.add("b1", step, fit).fit.reliable
    turned = motion.add("b1", 2 * step, around)
    assert not turned.fit.reliable
    assert turned.fit.confidence <= 0.3
    assert motion.add("b1", 3 * step, around).fit.reliable, "two bodies agree"
    assert not motion.add("b1", 4 * step, body_at(np.array([2.0, 0.0, 0.0]))).fit.reliable
    assert motion.add("b1", 6 * 10**9, body_at(np.array([8.0, 0.0, 0.0]))).fit.reliable, "time enough to walk there"
