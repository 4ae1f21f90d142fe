# SPDX-License-Identifier: Apache-2.0
"""Which way is up, and how large people are, by rough bodies in clouds of a man made of capsules."""

from __future__ import annotations

import numpy as np
import pytest
from capsule_man import Joints, cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.fit.up_axis_search import choose_up_axis, explain_roughly, measure_stature
from flowing_puppet_ros.body.scans.scan_frame import UP_AXES, parse_axis, propose_up_axes, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import ScanUnit
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.model.sp import StitchedPuppet

METRE = ScanUnit.named("m")
WIDE = joints_of(raise_left=1.6, raise_right=1.6, bend=0.0)  # arms spread wider than the man is tall


@pytest.fixture(scope="module")
def fitter() -> BodyFitter:
    return BodyFitter(StitchedPuppet.load("neutral"), FitterSettings())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("up", "joints"), [*((up, joints_of()) for up in UP_AXES if up != "x"), ("y", WIDE), ("-y", WIDE)]
)
def test_the_head_is_up_whatever_the_axis(fitter: BodyFitter, up: str, joints: Joints) -> None:
    points = cloud_of(joints, 2000)[0] @ rotation_to_z_up(parse_axis(up))
    ups = propose_up_axes(points, upright=True)
    ball = np.random.default_rng(0).normal(size=(500, 3)) * 0.3 + 3.0  # no person tells nothing
    assert choose_up_axis(fitter, [ball, points], ups, METRE, [None, None]).tolist() == parse_axis(up).tolist()


@pytest.mark.slow
def test_bodies_are_closest_in_the_size_of_an_adult(fitter: BodyFitter) -> None:
    points = cloud_of(joints_of(), 2000)[0]
    up = [parse_axis("z")]
    costs = {
        scale: explain_roughly(fitter, points, ScanUnit("m", scale, scale), up, None).cost for scale in (0.6, 1.0, 1.6)
    }
    assert costs[1.0] < 0.9 * min(costs[0.6], costs[1.6])


def test_stature_is_that_of_the_joints_whatever_the_pose(fitter: BodyFitter) -> None:
    model = fitter.model
    standing, body = model.rest_state(), model.sample(np.random.default_rng(1), shape_scale=0.0)
    height = float(np.ptp(model.vertices(standing)[:, 2]))
    joints = model.joints(model.vertices(body))
    assert measure_stature(model, 0.6 * joints) == pytest.approx(0.6 * height, rel=0.06)
    man = joints_of()
    placed = np.stack([man.get(name, np.zeros(3)) for name in model.joint_names])
    assert measure_stature(model, placed) == pytest.approx(1.75, rel=0.06)
