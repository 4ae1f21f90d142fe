# SPDX-License-Identifier: Apache-2.0
"""A room with people before a robot that stands or drives, through the body fitter's own messages."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.moving.fitter_run import FitterRun, run_fitter
from flowing_puppet_ros.evaluate.moving.robot_view import SENSINGS, RobotView, Sensing

pytestmark = pytest.mark.slow

MAX_JOINTS_CM = 5.0  # mean error of the joints in view when the robot stands


@pytest.fixture(scope="module")
def view() -> RobotView:
    """Return a short while of somebody who waves and somebody who walks, with 1.6 m/s of a robot that drives."""
    return RobotView(BodySource(), seed=1, seconds=0.8)


@pytest.fixture(scope="module")
def still(view: RobotView) -> FitterRun:
    """Return what a robot that stands makes of it."""
    return run_fitter(view, SENSINGS["still"])


def test_a_robot_that_stands_sees_both(still: FitterRun) -> None:
    summary = still.summarise("still")
    assert summary["joints_cm"] < MAX_JOINTS_CM
    assert summary["velocity_cm_s"] < 10.0
    assert (summary["ids"], summary["ghosts"]) == (2, 0)


@pytest.mark.parametrize("name", ["driving, fixed_frame", "upside down, fixed_frame"])
def test_in_a_fixed_frame_no_motion_of_the_sensor_matters(view: RobotView, still: FitterRun, name: str) -> None:
    found = run_fitter(view, SENSINGS[name])
    summary = found.summarise(name)
    assert summary["joints_cm"] < still.summarise("still")["joints_cm"] + 1.0
    assert summary["velocity_cm_s"] < 12.0
    assert (summary["ids"], summary["ghosts"]) == (2, 0)
    assert found.warnings == []


def test_without_a_fixed_frame_the_robots_own_motion_is_in_the_velocities(view: RobotView) -> None:
    found = run_fitter(view, Sensing(drives=True))
    assert np.nanmean(found.velocity_errors) > 0.8
    assert found.summarise("driving")["ids"] == 2
