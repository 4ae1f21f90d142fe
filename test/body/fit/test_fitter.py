# SPDX-License-Identifier: Apache-2.0
"""Fits to a man made of capsules, whose surface and joints owe nothing to the learned body model."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capsule_man import Joints, cloud_of, dog, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.body.cloud.normals import estimate_normals
from flowing_puppet_ros.body.cloud.single_view import SingleViewCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter, check_cloud
from flowing_puppet_ros.body.scans.scan import write_ply
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

LIMB_JOINTS = tuple(
    f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
)
YAW = 2.0
TURN = np.array([[np.cos(YAW), -np.sin(YAW), 0.0], [np.sin(YAW), np.cos(YAW), 0.0], [0.0, 0.0, 1.0]])
PLACE = np.array([1.0, -2.0, 0.9])


@pytest.fixture(scope="module")
def man() -> tuple[np.ndarray, np.ndarray, Joints]:
    """Points, normals and joints of a man with a yaw of 2 rad, away from the origin."""
    joints = joints_of()
    points, normals = cloud_of(joints)
    return points @ TURN.T + PLACE, normals @ TURN.T, {name: TURN @ at + PLACE for name, at in joints.items()}


@pytest.fixture(scope="module")
def fitter() -> BodyFitter:
    return BodyFitter(StitchedPuppet.load("neutral"), FitterSettings())


def errors_of(fitter: BodyFitter, fit: BodyFit, joints: Joints) -> np.ndarray:
    found = dict(zip(fitter.model.joint_names, fit.joints, strict=True))
    return np.array([np.linalg.norm(found[name] - joints[name]) for name in LIMB_JOINTS])


def started(
    joints: Joints, noise: float, without: tuple[str, ...] = ()
) -> dict[str, tuple[float, float, float, float]]:
    rng = np.random.default_rng(3)
    initial = {}
    for name, at in joints.items():
        x, y, z = at + rng.normal(0, noise, 3)
        initial[name] = (np.nan, np.nan, np.nan, 0.0) if name in without else (float(x), float(y), float(z), 1.0)
    return initial


def test_unknown_yaw_is_found_and_sides_are_right(
    fitter: BodyFitter, man: tuple[np.ndarray, np.ndarray, Joints]
) -> None:
    points, normals, joints = man
    done: list[float] = []
    fit = fitter.fit(points, normals, progress=done.append)
    errors = errors_of(fitter, fit, joints)
    assert errors.mean() < 0.08
    assert errors.max() < 0.2
    assert fit.two_way_distance < 0.02
    assert fit.reliable
    assert done == sorted(done) and done[-1] == 1.0
    assert 0 < fit.confidence <= 1 and np.all((fit.part_confidence >= 0) & (fit.part_confidence <= 1))
    np.testing.assert_allclose(fit.state.shape, np.tile(fit.state.shape[0], (16, 1)))


def test_rough_joints_with_gaps_are_improved(fitter: BodyFitter, man: tuple[np.ndarray, np.ndarray, Joints]) -> None:
    points, normals, joints = man
    floor = np.random.default_rng(0).uniform([-1, -4, 0], [3, 0, 0.02], (800, 3))
    points = np.concatenate([points, floor])
    normals = np.concatenate([normals, np.tile([0.0, 0.0, 1.0], (800, 1))])
    initial = started(joints, 0.03, without=("left_wrist", "right_knee", "neck"))
    fit = fitter.fit(points, normals, initial=initial | {"tail": (0.0, 0.0, 0.0, 1.0)})
    errors = errors_of(fitter, fit, joints)
    assert errors.mean() < 0.07
    assert errors.max() < 0.17


def test_one_side_is_enough_for_a_body(fitter: BodyFitter, man: tuple[np.ndarray, np.ndarray, Joints]) -> None:
    points, normals, joints = man
    sensor = PLACE + TURN @ np.array([3.0, 0.5, 0.2])
    facing = ((sensor - points) * normals).sum(axis=1) > 0
    fit = fitter.fit(points[facing], None, viewpoint=sensor)
    assert errors_of(fitter, fit, joints).mean() < 0.15


def two_people() -> tuple[np.ndarray, np.ndarray]:
    points, normals = cloud_of(joints_of(), 2500)
    return np.concatenate([points, points + np.array([0.2, 0.9, 0.0])]), np.concatenate([normals, normals])


def ball() -> tuple[np.ndarray, np.ndarray]:
    normals = np.random.default_rng(0).normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.5 * normals, normals


def crate() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    points, side = rng.uniform(-0.5, 0.5, (3000, 3)), rng.integers(0, 3, 3000)
    normals = np.zeros_like(points)
    normals[np.arange(3000), side] = rng.choice([-1.0, 1.0], 3000)
    points[np.arange(3000), side] = normals[np.arange(3000), side] / 2
    return points * [0.6, 0.5, 1.7], normals


@pytest.mark.parametrize("cloud", [two_people, ball, crate, dog])
def test_what_is_no_single_person_is_not_reliable(cloud: Callable[[], tuple[np.ndarray, np.ndarray]]) -> None:
    small = FitterSettings(
        particles=10, iterations=8, local_particles=6, local_iterations=3, max_limb_repairs=0, max_points=1500
    )
    fit = BodyFitter(StitchedPuppet.load("neutral"), small).fit(*cloud())
    assert not fit.reliable
    assert np.isfinite(fit.vertices).all() and np.isfinite(fit.energy)


def test_unusable_clouds_are_refused_in_one_sentence(fitter: BodyFitter) -> None:
    cloud = np.random.default_rng(0).normal(size=(100, 3))
    for bad, words in (
        (np.empty((0, 3)), "0 finite points"),
        (cloud[:3], "3 finite points"),
        (np.full((100, 3), np.nan), "0 finite points"),
        (cloud[:, :2], "shape"),
        (np.zeros((100, 3)), "0 m wide"),
        (1e300 * cloud, "m wide"),
        (np.concatenate([cloud, [[1e5, 0, 0]]]), "1e[+]05 m wide"),
        (np.repeat(cloud[:40], 30, axis=0), "40 distinct points"),
        (np.outer(np.linspace(0, 2, 100), [1, 2, 3]), "on a line"),
        (np.pad(cloud[:, :2], ((0, 0), (0, 1))), "in a plane"),
    ):
        with pytest.raises(InputError, match=words):
            fitter.fit(bad)
    assert check_cloud(cloud, np.zeros((100, 3)))[1] is None
    with pytest.raises(InputError, match="normals"):
        fitter.fit(cloud, cloud[:50])
    with pytest.raises(InputError, match="initial joints"):
        fitter.fit(cloud, initial={"nose": (0, 0, 0, 1), "neck": (np.nan, 0, 0, 1)})
    far = {name: (50.0 + k, 0.0, float(k % 3), 1.0) for k, name in enumerate(LIMB_JOINTS)}
    with pytest.raises(InputError, match="around the initial joints"):
        fitter.fit(cloud, initial=far)


def test_normals_do_not_depend_on_how_far_off_the_origin_is(man: tuple[np.ndarray, np.ndarray, Joints]) -> None:
    points, normals, _ = man
    viewpoint, map_origin = np.array([3.0, 0.5, 0.2]), np.array([5e5, 5.5e6, 300.0])
    for here, there in (
        (estimate_normals(points), estimate_normals(points + map_origin)),
        (
            SingleViewCloud.seen_from(points, None, viewpoint).normals,
            SingleViewCloud.seen_from(points + map_origin, None, viewpoint + map_origin).normals,
        ),
    ):
        assert ((here * there).sum(axis=1) > 0.999).mean() > 0.98
    assert ((estimate_normals(points) * normals).sum(axis=1) > 0.7).mean() > 0.9


def test_normals_look_beyond_the_points_of_one_ring() -> None:
    rng = np.random.default_rng(0)
    elevation, azimuth = np.radians(np.arange(-15.0, 15.1, 2.0)), np.radians(np.arange(-3.0, 3.0, 0.2))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    # A pillar of 0.3 m, 3.5 m ahead.
    near = 3.5 * np.cos(a) - np.sqrt(0.3**2 - (3.5 * np.sin(a)) ** 2)
    outward = np.stack([near * np.cos(a) - 3.5, near * np.sin(a), np.zeros(len(a))], axis=1) / 0.3
    points = np.stack([near * np.cos(a), near * np.sin(a), near * np.tan(e)], axis=1)
    points *= 1 + 0.01 * rng.standard_normal((len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = (SingleViewCloud.seen_from(points, None, np.zeros(3)).normals * outward).sum(axis=1)
    assert np.median(cosine) > 0.95 and (cosine > 0.8).mean() > 0.9


def test_fit_verb_writes_the_contract_and_goes_on_after_a_bad_input(
    tmp_path: Path, man: tuple[np.ndarray, np.ndarray, Joints], capsys: pytest.CaptureFixture[str]
) -> None:
    points, normals, _ = man
    np.save(tmp_path / "man.npy", 100 * np.concatenate([points, normals], axis=1))
    (tmp_path / "empty.xyz").write_bytes(b"")
    flags = ["--particles", "8", "--iterations", "6", "--local-particles", "6", "--local-iterations", "2"]
    flags += ["--max-limb-repairs", "0", "--up", "z", "--json", "--out"]
    status = main(["fit", str(tmp_path / "empty.xyz"), str(tmp_path / "man.npy"), *flags, str(tmp_path / "fits")])
    assert status == 1, "one of two inputs failed"
    output = capsys.readouterr()
    failed, good = (json.loads(line) for line in output.out.splitlines())
    assert "empty.xyz" in failed["error"] and "empty.xyz" in output.err
    assert good["metres_per_unit"] == 0.01
    with np.load(tmp_path / "fits" / "man.npz") as fit:
        model = StitchedPuppet.load("neutral")
        count = len(model.part_of_vertex)
        assert fit["vertices"].shape == (count, 3) and fit["vertices"].dtype == np.float32
        assert np.array_equal(fit["faces"], model.faces) and fit["part_of_vertex"].shape == (count,)
        assert fit["part_names"].tolist() == list(model.tree.names)
        assert fit["part_rotation"].shape == (16, 3, 3) and fit["part_center"].shape == (16, 3)
        assert fit["joint_names"].tolist() == list(model.joint_names)
        assert fit["joints"].shape == (len(model.joint_names), 3)
        assert fit["shape_coefficients"].shape == (16, 4) and fit["pose_coefficients"].shape == (16, 12)
        assert fit["energy"] > 0 and fit["seconds"] > 0
        np.testing.assert_allclose(fit["vertices"].mean(axis=0), 100 * points.mean(axis=0), atol=15)
        torso = fit["vertices"][fit["part_of_vertex"] == 0]
        assert np.linalg.norm(torso.mean(axis=0) - fit["part_center"][0]) < 10
    assert (tmp_path / "fits" / "man.ply").stat().st_size > 10000

    cloud, fitted = str(tmp_path / "man.npy"), str(tmp_path / "fits" / "man.npz")
    pairs = tmp_path / "pairs.npz"
    assert main(["correspond", fitted, fitted, "--scan-a", cloud, "--scan-b", cloud, "--out", str(pairs)]) == 0
    with np.load(pairs) as found:
        assert found["points"].shape == (len(points), 3)
        assert np.median(np.linalg.norm(found["points"] - 100 * points, axis=1)) < 10


def test_verbs_refuse_bad_arguments_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    triangle = np.eye(3), np.array([[0, 1, 2]])
    write_ply(tmp_path / "a.ply", *triangle)
    for arguments in (
        ["fit", str(tmp_path / "missing.ply"), "--out", str(tmp_path / "o")],
        ["fit", str(tmp_path / "a.ply"), str(tmp_path / "b" / "a.obj"), "--out", str(tmp_path / "o")],
        ["fit", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.ply")],
        ["fit", str(tmp_path / "a.ply"), "--out", str(tmp_path / "o"), "--particles", "1"],
        ["correspond", *[str(tmp_path / "a.ply")] * 2, "--scan-a", "a", "--scan-b", "b", "--out", "c"],
    ):
        assert main(arguments) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("flowing-puppet")]
        assert len(lines) == 1
