# SPDX-License-Identifier: Apache-2.0
"""`evaluate rgbd --lost-depth`: what it needs."""

import pytest

from flowing_puppet_ros.cli import main


def test_lost_depth_needs_several_cameras(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "rgbd", "--lost-depth", "patches"]) == 2
    assert "--lost-depth compares what several cameras see; give --cameras" in capsys.readouterr().err
