# SPDX-License-Identifier: Apache-2.0
"""Cameras and clocks found from people who walk, against those with which their pixels were made."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from walkers import NAMES, photograph, ring, walker  # type: ignore[import-not-found]

from flowing_puppet_ros.arrays import F64
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.multiview.association.settings import AssociationSettings
from flowing_puppet_ros.multiview.association.view import PersonInView
from flowing_puppet_ros.multiview.bundle.adjustment import Freedom, adjust, choose_instants, triangulate_linear
from flowing_puppet_ros.multiview.bundle.calibrate import RefinedRig, Scale, refine_rig
from flowing_puppet_ros.multiview.bundle.clocks import find_coarse_offsets
from flowing_puppet_ros.multiview.bundle.joint_tracks import CameraFrames, JointTrack, PeopleTracks, associate_tracks
from flowing_puppet_ros.multiview.bundle.uncertainty import bound_uncertainty
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.multiview.triangulation import TriangulationSettings

RATE = 30.0
CAMERAS = ring()


def people_at(t: float) -> dict[str, F64]:
    """Return two people who walk in circles, each the other way round."""
    a = 0.9 * t
    return {
        "ann": walker((1.2 * np.cos(a), 1.2 * np.sin(a)), a + np.pi / 2, 6 * t, 1.65),
        "bob": walker((0.6 * np.sin(a), -0.8 * np.cos(a)), a, 5 * t, 1.85),
    }


def record(late: dict[str, float] | None = None, count: int = 90, noise: float = 2.0) -> CameraFrames:
    """Return what the cameras' trackers say; the clock of a camera is `late` by so many images."""
    random = np.random.default_rng(5)
    found: dict[str, list[tuple[float, list[object]]]] = {name: [] for name in CAMERAS}
    for k in range(count):
        for name, camera in CAMERAS.items():
            group = photograph({name: camera}, people_at(k / RATE), noise, random, hide=False)[name]
            found[name].append((k / RATE + (late or {}).get(name, 0.0) / RATE, group))
    return found  # type: ignore[return-value]


def turn(camera: Camera, degrees: float, axis: tuple[float, float, float]) -> Camera:
    """Return a camera that was turned where it stands."""
    rotation = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix() @ camera.rotation
    return replace(camera, rotation=rotation, translation=-rotation @ camera.centre)


def angle(one: Camera, other: Camera) -> float:
    return float(np.degrees(Rotation.from_matrix(one.rotation @ other.rotation.T).magnitude()))


@pytest.fixture(scope="module")
def refined() -> RefinedRig:
    """A rig with one camera turned by two degrees and another one late by 3.4 images."""
    start = dict(CAMERAS) | {"cam2": turn(CAMERAS["cam2"], 2.0, (0.6, 0.8, 0.0))}
    return refine_rig(NAMES, start, record({"cam3": 3.4}), Freedom(), Scale())


@pytest.mark.slow
def test_a_turned_camera_is_turned_back(refined: RefinedRig) -> None:
    for name, camera in CAMERAS.items():
        assert angle(refined.cameras[name], camera) < 0.1, name
        assert np.linalg.norm(refined.cameras[name].centre - camera.centre) < 0.01, name


@pytest.mark.slow
def test_a_late_clock_is_found_to_a_tenth_of_an_image(refined: RefinedRig) -> None:
    offsets = np.array([refined.offsets[name] for name in CAMERAS]) * RATE
    np.testing.assert_allclose(offsets, [0, 0, -3.4, 0], atol=0.1)


@pytest.mark.slow
def test_the_report_is_that_of_the_noise(refined: RefinedRig) -> None:
    """The mean length of a two-dimensional error of 2 px is 2 sqrt(pi / 2), less what three unknowns of eight take.

    Between two images, errors are averaged: a straight line has two thirds of the variance on the average.
    """
    assert refined.before.mean["cam2"] > 15
    expected = 2 * np.sqrt(np.pi / 2) * np.sqrt(5 / 8)
    assert np.sqrt(2 / 3) * expected < refined.after.all_mean < expected
    assert sorted(refined.heights.values()) == pytest.approx([1.65, 1.85], rel=0.06)


@pytest.mark.slow
def test_scale_by_a_distance_or_a_height() -> None:
    frames, freedom = record(count=8), Freedom(clocks=False)
    known = float(np.linalg.norm(CAMERAS["cam1"].centre - CAMERAS["cam3"].centre))
    doubled = refine_rig(NAMES, CAMERAS, frames, freedom, Scale(("cam1", "cam3"), 2 * known))
    gap = np.linalg.norm(doubled.cameras["cam1"].centre - doubled.cameras["cam3"].centre)
    assert gap == pytest.approx(2 * known)
    by_height = refine_rig(NAMES, CAMERAS, frames, freedom, Scale(height=1.0))
    assert next(iter(by_height.heights.values())) == pytest.approx(1.0)
    with pytest.raises(InputError, match="there is no camera 'cam9'"):
        refine_rig(NAMES, CAMERAS, frames, freedom, Scale(("cam1", "cam9"), 1.0))


@pytest.mark.slow
def test_a_camera_that_was_turned_before_somebody_on_one_spot_stays_where_it_stood() -> None:
    """A network's joints are off the same way in all images, and one spot hardly tells turn from move."""
    random = np.random.default_rng(8)
    people = [{"ann": walker((0.1, 0.0), 0.5, 6 * k / RATE)} for k in range(60)]
    bias = {name: random.normal(0, 4, (len(NAMES), 2)) for name in CAMERAS}
    frames: dict[str, list[tuple[float, list[PersonInView]]]] = {name: [] for name in CAMERAS}
    for k, each in enumerate(people):
        for name, group in photograph(CAMERAS, each, 2.0, random).items():
            frames[name].append((k / RATE, [replace(p, joints=p.joints + bias[name]) for p in group]))
    tracks = associate_tracks(NAMES, CAMERAS, frames, {}, AssociationSettings(), TriangulationSettings())
    turned = CAMERAS | {"cam2": turn(CAMERAS["cam2"], 2.0, (0.6, 0.8, 0.0))}
    rolled = CAMERAS | {"cam2": turn(CAMERAS["cam2"], 1.2, (0.0, 0.0, 1.0))}
    start = dict.fromkeys(CAMERAS, 0.0)
    found = {
        case: adjust(former, start, former, tracks, Freedom(clocks=False)).cameras["cam2"]
        for case, former in (("right", CAMERAS), ("turned", turned), ("rolled", rolled))
    }
    assert angle(found["turned"], found["right"]) < 0.1
    assert angle(found["rolled"], found["right"]) < 0.1
    assert np.linalg.norm(found["turned"].centre - CAMERAS["cam2"].centre) < 0.02


def test_clocks_that_differ_by_half_a_second_are_found_to_an_image() -> None:
    found = find_coarse_offsets(NAMES, CAMERAS, record({"cam4": 15.0}, noise=0.5), 1.0)
    assert found["cam4"] * RATE == pytest.approx(-15, abs=1)
    assert found["cam2"] == found["cam3"] == 0


def test_a_camera_that_sees_nobody_else_is_one_sentence() -> None:
    frames = dict(record(count=12))
    frames["cam2"] = [(time, []) for time, _ in frames["cam2"]]
    with pytest.raises(PuppetError, match="cam2 shows nobody whom the other cameras show"):
        refine_rig(NAMES, CAMERAS, frames, Freedom(clocks=False), Scale())


def watch(seed: int, bias: float, noise: float) -> PeopleTracks:
    """Return the tracks of somebody on one spot; errors of `bias` px stay, those of `noise` px change."""
    random = np.random.default_rng(seed)
    times = np.arange(40) / RATE
    people = np.stack([walker((0.1, 0.0), 0.5, 6 * t) for t in times])
    tracks = {}
    for name, camera in CAMERAS.items():
        pixels = camera.project(people.reshape(-1, 3))[0].reshape(len(times), len(NAMES), 2)
        pixels = pixels + random.normal(0, bias, (len(NAMES), 2)) + random.normal(0, noise, pixels.shape)
        tracks[name] = JointTrack(times, camera.undistort(pixels), np.full(pixels.shape[:2], 0.9))
    return PeopleTracks(NAMES, {"ann": tracks}, 1 / RATE)


@pytest.mark.slow
@pytest.mark.parametrize(("bias", "noise"), [(0.0, 3.0), (3.0, 1.0)])
def test_the_bound_of_a_roll_is_the_spread_of_rolls_that_are_found(bias: float, noise: float) -> None:
    """All other cameras are right: what a plain least squares of the fourth one finds spreads as the bound says."""
    zero = dict.fromkeys(CAMERAS, 0.0)
    spread, bounds = [], []
    for seed in range(12):
        tracks = watch(seed, bias, noise)
        instants = choose_instants(tracks, list(CAMERAS))
        plane, weight = instants.observe(np.zeros(4))
        # One camera's pose from the joints as the others place them: a plain least squares of its own.
        others = [CAMERAS[name] for name in ("cam1", "cam3", "cam4")]
        rotation, translation = np.stack([c.rotation for c in others]), np.stack([c.translation for c in others])
        truth = triangulate_linear(rotation, translation, plane[[0, 2, 3]], weight[[0, 2, 3]])
        camera = CAMERAS["cam2"]

        def miss(values: F64, camera: Camera = camera, truth: F64 = truth, seen: F64 = plane[1]) -> F64:
            turned = Rotation.from_rotvec(values[:3]).as_matrix() @ camera.rotation
            local = (truth - camera.centre - values[3:]) @ turned.T
            return np.asarray(camera.focal * (local[:, :2] / local[:, 2:] - seen)).ravel()

        found = least_squares(miss, np.zeros(6)).x
        spread.append(np.degrees(found[2]))
        bounds.append(bound_uncertainty(CAMERAS, zero, tracks)["cam2"])
    rms = np.sqrt(np.mean(np.square(spread)))
    assert np.mean([each.roll for each in bounds]) == pytest.approx(rms, rel=0.5)
