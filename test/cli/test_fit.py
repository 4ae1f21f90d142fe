# SPDX-License-Identifier: Apache-2.0
"""The verb `fit`: its contract field by field, directions, scenes, and every kind of unusable input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def man() -> tuple[np.ndarray, np.ndarray]:
    points, normals = cloud_of(joints_of(raise_left=0.4), 4000)
    return points, normals


def test_every_field_of_the_contract(
    tmp_path: Path, man: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    # Millimetres, y up, far from the origin.
    place = np.array([4000.0, 900.0, -2500.0])
    points, normals = 1000 * man[0][:, [1, 2, 0]] + place, man[1][:, [1, 2, 0]]
    np.savez(tmp_path / "a.npz", points=points, normals=normals)
    status, (summary,), _ = fitted(capsys, tmp_path / "a.npz", "--out", tmp_path / "o", *FAST)
    assert status == 0
    assert summary["up"] == [0, 1, 0] and summary["metres_per_unit"] == 0.001 and summary["view"] == "full"
    model = StitchedPuppet.load("neutral")
    count = len(model.part_of_vertex)
    with np.load(summary["output"]) as archive:
        fit = {key: archive[key] for key in archive.files}
    shapes = {
        "vertices": (count, 3), "body_vertices": (count, 3), "surface_to_body": (16,),
        "part_of_vertex": (count,), "part_names": (16,), "part_rotation": (16, 3, 3),
        "part_center": (16, 3), "joint_names": (len(model.joint_names),), "joints": (len(model.joint_names), 3),
        "shape_coefficients": (16, 4), "pose_coefficients": (16, 12), "energy": (), "seconds": (), "confidence": (),
        "reliable": (),
    }  # fmt: skip
    assert {key: fit[key].shape for key in shapes} == shapes
    assert fit["vertices"].dtype == np.float32
    assert all(np.isfinite(array).all() for array in fit.values() if array.dtype.kind == "f")
    assert np.array_equal(fit["faces"], model.faces) and fit["faces"].dtype.kind == "i"
    assert np.array_equal(fit["part_of_vertex"], model.part_of_vertex)
    assert fit["part_names"].tolist() == list(model.tree.names)
    assert fit["joint_names"].tolist() == list(model.joint_names)
    for part, coefficients in enumerate(fit["pose_coefficients"]):
        assert not coefficients[model.pose_count(part) :].any()
    squares = fit["part_rotation"] @ fit["part_rotation"].swapaxes(1, 2)
    np.testing.assert_allclose(squares, np.tile(np.eye(3), (16, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(fit["part_rotation"]), 1, atol=1e-5)
    _in_the_input_frame(fit, points)
    # The joints are those of the body beneath the surface, of one shape, a little way from it.
    assert np.ptp(fit["all_shape_coefficients"], axis=0).max() == 0
    apart = np.linalg.norm(fit["vertices"] - fit["body_vertices"], axis=1)
    assert 0.001 * apart.mean() < 0.03
    assert summary["surface_to_body_m"] <= 0.001 * apart.mean()
    assert np.abs(fit["surface_to_body"]).max() <= apart.max()
    np.testing.assert_allclose(model.joints(fit["body_vertices"]), fit["joints"], atol=0.5)
    assert fit["seconds"] == pytest.approx(summary["seconds"]) and fit["energy"] == summary["energy"]
    assert bool(fit["reliable"]) is summary["reliable"]
    mesh = read_scan(tmp_path / "o" / "a.ply")
    np.testing.assert_allclose(mesh.points, fit["vertices"], rtol=1e-6)


def _in_the_input_frame(fit: dict[str, np.ndarray], points: np.ndarray) -> None:
    """Check that everything is in millimetres at the input's place, with y up."""
    np.testing.assert_allclose(fit["vertices"].mean(axis=0), points.mean(axis=0), atol=100)
    np.testing.assert_allclose(np.ptp(fit["vertices"][:, 1]), np.ptp(points[:, 1]), rtol=0.1)
    joint = dict(zip(fit["joint_names"].tolist(), fit["joints"], strict=True))
    assert joint["head_top"][1] - joint["left_ankle"][1] > 1200
    left = joint["left_shoulder"] - joint["right_shoulder"]
    assert np.linalg.norm(left) > 200
    assert fit["part_rotation"][0] @ [0, 1, 0] @ left > 0.8 * np.linalg.norm(left)
    for part in range(16):
        own = fit["vertices"][fit["part_of_vertex"] == part].mean(axis=0)
        assert np.linalg.norm(own - fit["part_center"][part]) < 80
    assert fit["part_rotation"][0] @ [0, 0, 1] @ np.array([0, 1, 0]) > 0.8


def test_people_who_lie_askew_are_fitted_from_head_to_foot(
    tmp_path: Path, man: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    turn = np.linalg.qr(np.array([[1.0, 1.0, 0.2], [0.0, 1.0, 0.0], [0.3, 0.1, 1.0]]))[0]
    turn *= np.linalg.det(turn)
    np.savez(tmp_path / "askew.npz", points=man[0] @ turn.T, normals=man[1] @ turn.T)
    arguments: list[str | Path] = ["--upright", "any", "--up", "y", "--out", tmp_path / "o", *FAST]
    _, (summary,), _ = fitted(capsys, tmp_path / "askew.npz", *arguments)
    assert np.array(summary["up"]) @ turn @ [0, 0, 1] > 0.9


def test_people_of_a_scene_become_files_of_their_own(
    tmp_path: Path, man: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    standing = man[0] - [0, 0, man[0][:, 2].min()]
    floor = np.column_stack([rng.uniform(-2, 3, (8000, 2)), rng.normal(0, 0.004, 8000)])
    scene = np.concatenate([standing, standing + np.array([1.2, 1.0, 0.0]), floor])
    np.save(tmp_path / "empty_hall.npy", floor)
    np.save(tmp_path / "hall.npy", scene[rng.permutation(len(scene))])
    arguments: list[str | Path] = ["--scene", "--view", "full", "--out", tmp_path / "o", *FAST]
    inputs = [tmp_path / "hall.npy", tmp_path / "empty_hall.npy"]
    status, (summary, empty), sentences = fitted(capsys, *inputs, *arguments)
    assert status == 1 and "shows no person" in empty["error"]
    assert [sentence for sentence in sentences if "empty_hall" in sentence and "shows no person" in sentence]
    assert len(summary["people"]) == 2
    middles = []
    for number, person in enumerate(summary["people"], start=1):
        assert person["output"] == str(tmp_path / "o" / f"hall-{number}.npz")
        with np.load(person["output"]) as fit:
            middles.append(fit["vertices"].mean(axis=0))
    assert np.linalg.norm(middles[0] - middles[1]) == pytest.approx(np.hypot(1.2, 1.0), abs=0.2)


def unusable() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "none": np.empty((0, 3)),
        "ten": rng.uniform(0, 1.7, (10, 3)),
        "nan": np.full((500, 3), np.nan),
        "plane": np.pad(rng.uniform(0, 1.7, (500, 2)), ((0, 0), (0, 1))),
        "line": np.outer(np.linspace(0, 1.7, 300), [0.1, 0.2, 1.0]),
        "same": np.tile(rng.uniform(0, 1.7, (20, 3)), (50, 1)),
        "galaxy": 1e20 * rng.normal(size=(500, 3)),
        "flat": rng.uniform(0, 1, 30),
    }


@pytest.mark.parametrize("extra", [[], ["--view", "single", "--up", "z", "--unit", "m"], ["--scene"]])
def test_unusable_clouds_are_one_sentence_each_or_flagged(
    tmp_path: Path, extra: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    clouds = unusable()
    for name, cloud in clouds.items():
        np.save(tmp_path / f"{name}.npy", cloud)
    files = [tmp_path / f"{name}.npy" for name in clouds]
    status, summaries, (*sentences, last) = fitted(capsys, *files, "--out", tmp_path / "o", *FAST, *extra)
    failed = sum("error" in summary for summary in summaries)
    assert status == (2 if failed == len(files) else 1)
    assert f"{failed} of {len(files)} inputs failed: " in last
    assert len(sentences) == len(summaries) == len(files)
    for summary, sentence in zip(summaries, sentences, strict=True):
        if "error" in summary:
            assert summary["error"] in sentence
        else:  # one side of a person may be nearly a plane, so that only the result tells
            assert "plane" in summary["input"] and "single" in extra and summary["reliable"] is False


def test_what_is_no_person_is_flagged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball *= 0.6 / np.linalg.norm(ball, axis=1, keepdims=True)
    trunk, legs = rng.uniform([-0.5, -0.15, 0.5], [0.5, 0.15, 0.8], (3000, 3)), []
    for x in (-0.45, 0.45):
        for y in (-0.1, 0.1):
            legs.append(rng.uniform([x - 0.05, y - 0.05, 0], [x + 0.05, y + 0.05, 0.5], (500, 3)))
    for name, cloud in (("ball", ball), ("dog", np.concatenate([trunk, *legs]))):
        np.save(tmp_path / f"{name}.npy", cloud)
    files = [tmp_path / "ball.npy", tmp_path / "dog.npy"]
    status, summaries, sentences = fitted(capsys, *files, "--out", tmp_path / "o", "--up", "z", *FAST)
    assert status == 0 and [summary["reliable"] for summary in summaries] == [False, False]
    assert len(sentences) == 2 and all("not reliable" in sentence for sentence in sentences)
