# SPDX-License-Identifier: Apache-2.0
"""Silhouettes joined with depth: one body of a man of capsules from both, and what is said when they do not belong."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from camera_circle import (  # type: ignore[import-not-found]
    ANGLES,
    DEPTHS,
    FACTORY,
    HALL_M,
    HEIGHT,
    LIMBS,
    MAN,
    MATRIX,
    POINTS,
    TENTH,
    WIDTH,
    axes_of,
    camera_at,
    frames_of,
    mask_of,
    messages_of,
    silhouettes_at,
)

from flowing_puppet_ros.fusion.rig.silhouette_person import SilhouettePerson
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_silhouettes
from flowing_puppet_ros.stream.messages.geometry import make_header, make_transform, stamp_ns
from flowing_puppet_ros.stream.messages.puppets import decode_body_joints


def lose(depth: np.ndarray, angle: float, above: float) -> np.ndarray:
    """Return a depth image without what lies higher than `above` m, as a black shirt leaves it."""
    rows = np.arange(HEIGHT)[:, None] - (HEIGHT - 1) / 2
    return np.asarray(np.where(-rows * depth / MATRIX[0] > above, 0.0, depth))


def run(
    stamps: Iterable[int],
    sets: Mapping[int, Any],
    depths: Mapping[int, np.ndarray],
    settings: Mapping[str, Any] | None = None,
) -> tuple[dict[int, list[Any]], BodyFitterComponent]:
    """Return stamp -> bodies of a fitter that is given depth images (by the cameras' numbers) and sets (by stamp)."""
    names = ",".join(f"cam{number}" for number in depths)
    component = BodyFitterComponent(
        BodyFitterSettings.from_mapping({"rig.cameras": names, **(settings or {})}), FACTORY
    )
    component.set_expected("silhouettes", True)
    frames = frames_of(ANGLES)
    frames.transforms.append(make_transform(FACTORY, make_header(FACTORY, 0, "world"), "hall", HALL_M, np.eye(3)))
    outputs = component.handle("/tf_static", frames)
    for stamp in stamps:
        for number, depth in depths.items():
            for port, message in messages_of(number, stamp, depth):
                outputs += component.handle(port, message)
        if stamp in sets:
            outputs += component.handle("silhouettes", sets[stamp])
    outputs += component.flush()
    return {stamp_ns(message): list(message.bodies) for name, message in outputs if name == "bodies"}, component


def error_of(body: Any, names: list[str] = LIMBS) -> float:
    joints = decode_body_joints(body)
    return float(np.mean([np.linalg.norm(np.array(joints[name][:3]) - MAN[name]) for name in names]))


def test_a_moved_person_is_seen_at_the_same_pixels() -> None:
    camera, turn, step = camera_at(0.4), axes_of(1.1), np.array([1.0, -2.0, 0.5])
    person = SilhouettePerson(
        "a1", {"cam": (camera, np.ones((HEIGHT, WIDTH), np.uint8))}, {"neck": (0.1, 0.2, 0.3, 0.9)}
    )
    moved = person.move(turn, step)
    place = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(moved.joints["neck"][:3], turn @ place + step)
    seen, depth = camera.project(place)
    again, same_depth = moved.views["cam"][0].project(turn @ place + step)
    np.testing.assert_allclose(again, seen, atol=1e-9)
    assert same_depth == pytest.approx(depth)


def test_only_the_silhouette_that_points_do_not_lie_in_is_contradicted() -> None:
    views = dict(zip(("a", "b", "c"), decode_silhouettes(silhouettes_at(TENTH)), strict=True))
    mask = np.roll(views["b"][1], 40, axis=1)  # 0.4 m
    person = SilhouettePerson("a1", views | {"b": (views["b"][0], mask)}, {})
    own = POINTS[::20]
    assert SilhouettePerson("a1", views, {}).find_unusable(own, []) == ([], [])
    assert person.find_unusable(own, []) == ([], ["b"])
    assert person.find_unusable(own[:50], []) == ([], [])  # too few to tell
    other = SilhouettePerson("a2", {"b": views["b"]}, {})  # who stands before him
    assert person.find_unusable(own, [other]) == (["b"], [])


def test_a_moment_waits_for_its_silhouettes_but_not_for_ever() -> None:
    component = BodyFitterComponent(BodyFitterSettings.from_mapping({"rig.cameras": "cam0"}), FACTORY)
    joined, second = component._joined, 10 * TENTH
    assert joined.is_awaited(second, second, second)  # the first may still come
    assert not joined.is_awaited(second, second, 4 * second)  # fusion.wait is 2 s
    joined.add(silhouettes_at(second))
    assert not joined.is_awaited(second, second, second)
    assert not joined.is_awaited(second + TENTH // 5, second, 2 * second)  # within rig.slop
    assert joined.is_awaited(second + TENTH, second, 2 * second)
    two = silhouettes_at(second + TENTH)
    two.people = ["a7", "a8"]
    joined.add(two)
    assert joined.is_awaited(second + TENTH, second, 2 * second)  # the other one's is to come
    other = silhouettes_at(second + TENTH)
    other.person.id, other.people = "a8", two.people
    joined.add(other)
    assert not joined.is_awaited(second + TENTH, second, 2 * second)


@pytest.mark.slow
def test_where_depth_is_missing_silhouettes_complete_the_body() -> None:
    """Depth sees him up to the hips only; arms are known by the silhouettes, which are in a frame of their own."""
    arms = [name for name in LIMBS if "elbow" in name or "wrist" in name]
    low = {number: lose(DEPTHS[number], ANGLES[number], 0.0) for number in range(3)}
    both, component = run([TENTH], {TENTH: silhouettes_at(TENTH, frame="hall")}, low)
    (body,) = both[TENTH]
    assert body.id == "a7" and body.reliable
    assert error_of(body) < 0.045 and error_of(body, arms) < 0.045
    assert component.report.drain_warnings() == []
    alone, _ = run([TENTH], {}, low, {"fusion.wait": 0.0})
    assert all(error_of(other, arms) > 0.1 or not other.reliable for other in alone[TENTH])


@pytest.mark.slow
def test_one_depth_camera_among_colour_cameras_gives_the_same_on_one_thread_and_two() -> None:
    found = []
    for threads in (1, 2):
        bodies, _ = run([TENTH], {TENTH: silhouettes_at(TENTH)}, {0: DEPTHS[0]}, {"fitter.threads": threads})
        (body,) = bodies[TENTH]
        assert error_of(body) < 0.045
        found.append(decode_body_joints(body))
    assert found[0] == found[1]


@pytest.mark.slow
def test_a_silhouette_of_somebody_else_is_left_out_and_told_of() -> None:
    stamps = [number * TENTH for number in (10, 11, 12)]
    wrong = np.roll(mask_of(DEPTHS[1]), 45, axis=1)
    sets = {stamp: silhouettes_at(stamp, {1: wrong}) for stamp in stamps}
    bodies, component = run(stamps, sets, {0: DEPTHS[0], 2: DEPTHS[2]})
    assert [error_of(body) < 0.045 for stamp in stamps for body in bodies[stamp]] == [True] * 3
    (sentence,) = component.report.drain_warnings()
    assert sentence.startswith("what the depth sensors saw of a person lies beside the silhouette of colour1")
    assert component.counters["silhouettes that depth contradicts"] == 3


@pytest.mark.slow
def test_who_has_no_silhouettes_for_a_moment_keeps_body_and_id() -> None:
    stamps = [number * TENTH for number in range(10, 14)]
    sets = {stamp: silhouettes_at(stamp) for stamp in (stamps[0], stamps[1], stamps[3])}
    bodies, _ = run(stamps, sets, {0: DEPTHS[0], 2: DEPTHS[2]})
    assert {stamp: [body.id for body in found] for stamp, found in bodies.items()} == {each: ["a7"] for each in stamps}
    assert all(error_of(found[0]) < 0.045 for found in bodies.values())


@pytest.mark.slow
def test_who_was_found_by_depth_alone_keeps_the_id_when_silhouettes_come() -> None:
    stamps = [number * TENTH for number in range(10, 14)]
    sets = {stamp: silhouettes_at(stamp) for stamp in stamps[2:]}
    bodies, component = run(stamps, sets, {0: DEPTHS[0], 2: DEPTHS[2]})
    assert [[body.id for body in bodies[stamp]] for stamp in stamps] == [["b1"]] * 4
    assert component.counters["people of silhouettes and depth"] == 2
    assert component.report.drain_warnings() == []


@pytest.mark.slow
def test_silhouettes_of_another_time_or_of_an_unknown_place_are_told_of_and_depth_goes_on() -> None:
    depths, stamps = {0: DEPTHS[0], 2: DEPTHS[2]}, [number * TENTH for number in range(10, 21)]
    late = {stamp: silhouettes_at(stamp + TENTH // 2) for stamp in stamps}
    bodies, component = run(stamps, late, depths)
    assert [len(bodies[stamp]) for stamp in stamps] == [1] * 11 and error_of(bodies[TENTH * 20][0]) < 0.06
    (sentence,) = component.report.drain_warnings()
    assert "are 0.050 s from it, beyond the rig.slop of 0.035 s" in sentence
    bodies, component = run([TENTH], {TENTH: silhouettes_at(TENTH, frame="elsewhere")}, depths)
    assert len(bodies[TENTH]) == 1
    (sentence,) = component.report.drain_warnings()
    assert sentence.startswith("silhouettes are left out: ") and "elsewhere" in sentence
