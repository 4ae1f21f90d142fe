# SPDX-License-Identifier: Apache-2.0
"""`evaluate rgbd --lost-depth`: what it needs."""

import pytest

from flowing_puppet_ros.cli import main


def test_all_cameras_but_one_are_several(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "rgbd", "--lost-depth", "clothes", "one"]) == 2
    assert "--lost-depth one takes the depth of all cameras but one away; give --cameras" in capsys.readouterr().err
