# SPDX-License-Identifier: Apache-2.0
"""Several depth cameras around one man: paired, in one frame, one body, and what is said when one is off or gone."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from camera_circle import (  # type: ignore[import-not-found]
    AWAY_M,
    FACTORY,
    FOCAL,
    HEIGHT,
    LIMBS,
    MAN,
    TENTH,
    WIDTH,
    axes_of,
    depth_from,
    frames_of,
    messages_of,
)
from capsule_man import cloud_of  # type: ignore[import-not-found]

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.reporting import Report
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints
from flowing_puppet_ros.stream.pairing.depth_rig import MAX_MISSED, DepthRig, DepthRigSettings
from flowing_puppet_ros.stream.sensor_places import SensorPlaces


def room_from(angle: float) -> np.ndarray:
    """Return the depths (H, W) m of the walls, the floor and the ceiling of a room of 7 x 7 m."""
    columns, rows = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    rays = np.stack([columns / FOCAL, rows / FOCAL, np.ones_like(rows)], axis=-1) @ axes_of(angle).T
    eye = AWAY_M * np.array([np.cos(angle), np.sin(angle), 0.0])
    ends = np.where(rays > 0, np.array([3.5, 3.5, 1.6]), np.array([-3.5, -3.5, -0.92]))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nanmin((ends - eye) / rays, axis=-1))


def make_rig(cameras: str = "cam0,cam1", frames: Any = None) -> tuple[DepthRig, Report]:
    report, tree = Report(), FrameTree()
    tree.add(frames_of((0.0, 2.0)) if frames is None else frames)
    places = SensorPlaces(tree, "auto", "", "", report)
    return DepthRig(DepthRigSettings(cameras=cameras), places, report, FACTORY), report


def feed(rig: DepthRig, stamps: Iterable[tuple[int, int]]) -> Iterator[Any]:
    """Yield the moments of images by the sensors (number, stamp)."""
    for number, stamp in stamps:
        for port, message in messages_of(number, stamp, np.ones((HEIGHT, WIDTH))):
            yield from rig.add(port, message)


def test_images_of_one_time_are_one_moment_in_the_root_of_the_cameras() -> None:
    rig, _ = make_rig()
    stamps = [(number, time * TENTH + number * 20_000_000) for time in range(10, 14) for number in (0, 1)]
    moments = [*feed(rig, stamps), *rig.flush()]
    assert [stamp_ns(moment) for moment in moments] == [time * TENTH for time in range(10, 14)]
    assert all(set(moment.seen) == {"cam0", "cam1"} for moment in moments)
    assert {moment.header.frame_id for moment in moments} == {"world"}


def test_who_is_silent_is_gone_on_without_and_said_to_be() -> None:
    rig, report = make_rig()
    stamps = [(number, time * TENTH) for time in range(10, 30) for number in (0, 1) if number == 0 or time < 13]
    moments = [*feed(rig, stamps), *rig.flush()]
    alone = [stamp_ns(moment) // TENTH for moment in moments if set(moment.seen) == {"cam0"}]
    assert alone == list(range(17, 30))  # half a second after its last image
    assert report.drain_warnings() == ["nothing comes from cam1: bodies are fitted without it"]


def test_clouds_that_are_never_near_in_time_are_used_one_by_one_and_it_is_said() -> None:
    rig, report = make_rig()
    stamps = [(number, time * TENTH + number * TENTH // 2) for time in range(10, 40) for number in (0, 1)]
    moments = [*feed(rig, stamps), *rig.flush()]
    assert len(moments) > 60 - 2 * MAX_MISSED
    (sentence,) = report.drain_warnings()
    assert "is within rig.slop, 0.035 s" in sentence


def test_a_camera_without_a_transform_is_left_out_with_a_sentence() -> None:
    two = frames_of((0.0, 2.0))
    two.transforms = two.transforms[:1]
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({"rig.cameras": "cam0,cam1"}), FACTORY)
    component.handle("/tf_static", two)
    rig = component._rig
    assert rig is not None
    moment = next(iter([*feed(rig, [(0, TENTH), (1, TENTH)]), *rig.flush()]))
    scene, place, _ = rig.merge(moment, component._decode)
    assert len(scene.parts) == 1 and place.is_fixed
    (sentence,) = component.report.drain_warnings()
    assert sentence.startswith("cam1 is left out: ") and "cam1_optical_frame" in sentence


def test_two_sensors_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match="a name of its own"):
        make_rig("cam0, cam0")


def test_a_rig_is_warmed_up_by_the_images_of_one_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({"rig.cameras": "cam0,cam1"}), FACTORY)
    warmed: list[Any] = []
    monkeypatch.setattr("flowing_puppet_ros.stream.components.warm_up.run", lambda made, _: warmed.append(made))
    monkeypatch.setattr(component._people.scene, "warm_up", lambda: None)
    monkeypatch.setattr(component._outputs, "warm_up", lambda: None)
    component.warm_up()
    assert {"depth", "puppets"} <= {port.name for port in warmed[0].inputs}


def measure(angles: tuple[float, ...], frames: Any = None) -> tuple[list[float], BodyFitterComponent]:
    """Return the mean error, m, of the man's limbs in each body that cameras at some angles give together."""
    points = cloud_of(MAN, 60_000)[0]
    names = ",".join(f"cam{number}" for number in range(len(angles)))
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({"rig.cameras": names}), FACTORY)
    outputs = component.handle("/tf_static", frames or frames_of(angles))
    for number, angle in enumerate(angles):
        for port, message in messages_of(number, TENTH, depth_from(angle, points)):
            outputs += component.handle(port, message)
    outputs += component.flush()
    errors = []
    for message in (message for name, message in outputs if name == "bodies"):
        assert message.header.frame_id == "world" and stamp_ns(message) == TENTH
        for body in message.bodies:
            joints = decode_body_joints(body)
            gaps = [np.linalg.norm(np.array(joints[name][:3]) - MAN[name]) for name in LIMBS]
            errors.append(float(np.mean(gaps)))
    return errors, component


@pytest.mark.slow
def test_a_camera_that_is_not_where_it_is_said_to_be_is_told_of_and_one_that_is_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flowing_puppet_ros.stream.pairing.depth_rig.COMPARED_MOMENTS", 2)
    points = cloud_of(MAN, 60_000)[0]
    for shift, expected in ((0.0, 0), (0.15, 1)):
        angles = (0.0, 1.2)
        component = BodyFitterComponent(BodyFitterSettings.from_mapping({"rig.cameras": "cam0,cam1"}), FACTORY)
        component.handle("/tf_static", frames_of(angles, shift))
        rig = component._rig
        assert rig is not None
        depth = [depth_from(angle, points) for angle in angles]
        depth = [np.where(image == 0, room_from(angle), image) for angle, image in zip(angles, depth, strict=True)]
        for time in range(10, 14):
            for number, image in enumerate(depth):
                for port, message in messages_of(number, time * TENTH, image):
                    for moment in rig.add(port, message):
                        rig.merge(moment, component._decode)
        found = [sentence for sentence in component.report.drain_warnings() if "do not fit together" in sentence]
        assert len(found) == expected, (shift, found)


@pytest.mark.slow
def test_cameras_around_a_man_of_capsules_give_one_body_that_is_closer_than_one_camera_alone() -> None:
    (one,), _ = measure((np.pi / 2,))  # from his left, which hides his right arm
    (both,), _ = measure((np.pi / 2, -0.7))
    assert both < 0.04
    assert both < 0.8 * one
