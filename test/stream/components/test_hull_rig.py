# SPDX-License-Identifier: Apache-2.0
"""The rig of a visual hull: cameras that move, and a calibration that cannot be."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from golden_streams import FACTORY, Stream, drive, hull_stream, read_golden  # type: ignore[import-not-found]

from flowing_puppet_ros.multiview.bundle import rig_check
from flowing_puppet_ros.stream.components.visual_hull import VisualHullComponent, VisualHullSettings
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform, stamp_ns
from flowing_puppet_ros.stream.messages.message_types import TRANSFORMS
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints


@pytest.fixture(scope="module")
def recorded() -> dict[str, list[Any]]:
    return read_golden()


def test_a_hull_says_that_people_would_be_giants(
    recorded: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The poses are in millimetres: nobody is found, and nothing else would say why."""
    monkeypatch.setattr(rig_check, "_SETS", 2)
    stream = deepcopy(hull_stream(recorded))
    for item in stream[0][1].transforms:
        for axis in "xyz":
            setattr(item.transform.translation, axis, 1000 * getattr(item.transform.translation, axis))
    component = VisualHullComponent(VisualHullSettings(cameras="cam1,cam2", hull_every=1), FACTORY)
    assert drive(component, stream) == []
    (sentence,) = component.report.drain_warnings()
    tall = float(sentence.split("would be ")[1].split(" m tall")[0])
    assert 1300 < tall < 2200 and "in mm" in sentence and "--unit" in sentence


def move_rig(stream: Stream, speed: np.ndarray, late: bool) -> Stream:
    """The same stream from a rig that drives: its root frame moves on /tf, told between the stamps of the images.

    `late` transforms but the first come after all images that they are needed for.
    """
    stamps = sorted({stamp_ns(message) for port, message in stream if port.endswith("/image")})
    start, half = stamps[0], (stamps[1] - stamps[0]) // 2
    moving: Stream = []
    for stamp in (start - half, start + half, stamps[-1] + half):
        header = make_header(FACTORY, stamp, "odom")
        pose = make_transform(FACTORY, header, "world", speed * (stamp - start) * 1e-9, np.eye(3))
        moving.append(("/tf", FACTORY.make(TRANSFORMS, transforms=[pose])))
    early = moving[:1] if late else moving
    return stream[:1] + early + stream[1:] + moving[len(early) :]


@pytest.mark.parametrize("late", [False, True])
def test_cameras_that_move_are_taken_where_they_were(recorded: dict[str, list[Any]], late: bool) -> None:
    stream, speed = hull_stream(recorded), np.array([0.9, -0.4, 0.1])
    settings = VisualHullSettings(cameras="cam1,cam2", hull_every=1)
    still = [m for port, m in drive(VisualHullComponent(settings, FACTORY), stream) if port == "hull/joints"]
    component = VisualHullComponent(settings, FACTORY)
    driven = [m for port, m in drive(component, move_rig(stream, speed, late)) if port == "hull/joints"]
    assert [m.header.frame_id for m in driven] == ["odom"] * 2 and component.report.drain_warnings() == []
    for one, other in zip(still, driven, strict=True):
        moved = speed * (stamp_ns(one) - stamp_ns(still[0])) * 1e-9
        before, after = (decode_body_joints(m.bodies[0]) for m in (one, other))
        assert before.keys() == after.keys()
        for name, joint in before.items():
            np.testing.assert_allclose(after[name][:3], joint[:3] + moved, atol=1e-3)
    assert np.linalg.norm(moved) > 0.01
