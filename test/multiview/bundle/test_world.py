# SPDX-License-Identifier: Apache-2.0
"""Units and axes of a calibration found by the people in it, and the usual mistakes, in one sentence each."""

from dataclasses import replace

import numpy as np
import pytest
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.multiview.bundle.diagnosis import People
from flowing_puppet_ros.multiview.bundle.world import AXES, settle_world
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.rig.rig import CameraRig, RigCamera

CAMERAS = ring()


def instants(cameras: dict[str, Camera] | None = None) -> list[People]:
    random = np.random.default_rng(7)
    found: list[People] = []
    for k in range(6):
        people = {"ann": walker((0.1 * k, 0.8), 0.3, k, 1.62), "bob": walker((-0.8, -0.1 * k), 2.0, k + 1, 1.8)}
        found.append(photograph(cameras or CAMERAS, people, 2.0, random, hide=False))
    return found


def make_rig(cameras: dict[str, Camera], unit: str = "") -> CameraRig:
    return CameraRig({name: RigCamera(camera) for name, camera in cameras.items()}, unit)


def settle(
    cameras: dict[str, Camera], unit: str = "auto", up: str = "auto", height: float = 0.0, of_file: str = ""
) -> tuple[dict[str, Camera], list[str]]:
    notes: list[str] = []
    rig = settle_world(make_rig(cameras, of_file), NAMES, instants(), unit, up, height, notes.append)
    return {name: each.camera for name, each in rig.cameras.items()}, notes


def scaled(factor: float) -> dict[str, Camera]:
    return {name: replace(each, translation=each.translation * factor) for name, each in CAMERAS.items()}


def turned(rotation: F64) -> dict[str, Camera]:
    return {name: replace(each, rotation=each.rotation @ rotation.T) for name, each in CAMERAS.items()}


def assert_same(found: dict[str, Camera], tolerance: float = 1e-9) -> None:
    for name, camera in CAMERAS.items():
        np.testing.assert_allclose(found[name].centre, camera.centre, atol=tolerance)
        np.testing.assert_allclose(found[name].rotation, camera.rotation, atol=tolerance)


def test_metres_with_z_up_stay_as_they_are_without_a_word() -> None:
    found, notes = settle(CAMERAS)
    assert_same(found)
    assert notes == []


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "mm"), (100.0, "cm")])
def test_a_unit_is_found_by_the_height_of_people(factor: float, unit: str) -> None:
    found, notes = settle(scaled(factor))
    assert_same(found)
    assert len(notes) == 1 and notes[0].endswith(f"the calibration is taken to be in {unit}")


def test_a_wrong_unit_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"with --unit m people would be 1\.7.e\+03 m tall: the calibration is in mm"):
        settle(scaled(1000.0), unit="m")
    with pytest.raises(InputError, match=r"people would be 5\.\d+ m tall: the unit of the calibration is not m, cm or"):
        settle(scaled(3.2))


def test_a_height_fixes_an_arbitrary_scale() -> None:
    found, _ = settle(scaled(3.2), height=1.71)  # the two are 1.62 and 1.80 m tall
    assert_same(found, 0.3)
    found, notes = settle(scaled(0.21), of_file="unknown")
    assert "people are taken to be 1.7 m tall" in notes[0]
    assert_same(found, 0.3)


@pytest.mark.parametrize("up", [name for name in AXES if name != "z"])
def test_an_upright_axis_is_found(up: str) -> None:
    """Whatever axis people stand along, they stand along z afterwards; the rest of the world is turned with it."""
    third = np.array([0.36, 0.48, 0.8])
    first = np.cross(AXES[up], third)
    first /= np.linalg.norm(first)
    world = np.stack([first, np.cross(AXES[up], first), AXES[up]], axis=1)  # z to `up`
    found, notes = settle(turned(world))
    assert notes == [f"people stand along {up}: the world is turned so that z is up"]
    for name, camera in CAMERAS.items():
        assert found[name].centre[2] == pytest.approx(camera.centre[2], abs=1e-6)


def test_a_wrong_axis_is_one_sentence() -> None:
    with pytest.raises(InputError, match="with --up=y people would not stand: in this calibration they stand along z"):
        settle(CAMERAS, up="y")


def test_swapped_cameras_are_named() -> None:
    swapped = dict(CAMERAS) | {"cam1": CAMERAS["cam3"], "cam3": CAMERAS["cam1"]}
    with pytest.raises(InputError, match="cam1 and cam3 are swapped"):
        settle(swapped)


@pytest.mark.parametrize("axis", range(3))
def test_a_mirrored_axis_is_named(axis: int) -> None:
    mirror = np.ones(3)
    mirror[axis] = -1
    placed = {
        name: replace(each, translation=-each.rotation @ (mirror * each.centre)) for name, each in CAMERAS.items()
    }
    with pytest.raises(InputError, match=f"the {'xyz'[axis]} axis of the world is mirrored"):
        settle(placed)


def test_poses_the_wrong_way_round_are_named() -> None:
    inverse = {name: replace(each, rotation=each.rotation.T, translation=each.centre) for name, each in CAMERAS.items()}
    with pytest.raises(InputError, match="the inverse, world to camera, is expected"):
        settle(inverse)
    flip = np.diag([1.0, -1.0, -1.0])
    backward = {
        name: replace(each, rotation=flip @ each.rotation, translation=flip @ each.translation)
        for name, each in CAMERAS.items()
    }
    with pytest.raises(InputError, match="z forward and y down are expected"):
        settle(backward)


def test_without_people_what_is_told_is_taken() -> None:
    notes: list[str] = []
    rig = settle_world(make_rig(scaled(1000.0)), NAMES, [], "mm", "z", 0.0, notes.append)
    assert_same({name: each.camera for name, each in rig.cameras.items()})
    assert "unit and axes are not checked" in notes[0]
