# SPDX-License-Identifier: Apache-2.0
"""The verb `fit` on scans in odd frames and units, from one side, with several people or a floor: joints are right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.body.scans.scan_frame import parse_axis, rotation_to_z_up
from flowing_puppet_ros.body.settings import FitterSettings, SegmentationSettings
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.cli.scans.fit_people import FitOptions, find_people
from flowing_puppet_ros.model.sp import StitchedPuppet

pytestmark = pytest.mark.slow

JOINTS = joints_of(raise_left=1.3, raise_right=0.2)
POINTS = cloud_of(JOINTS, 3000)[0]
HEIGHT = float(np.ptp(POINTS[:, 2]))
COMPARED = ("head_top", "neck", "belly", "pelvis", "left_hip", "left_knee", "left_ankle")
MAX_ERROR_M = 0.1  # mean over the joints, whose places in the capsules are not exactly the model's


def joint_error(fit: dict[str, Any], to_scan: Any, scale: float, joints: dict[str, np.ndarray] = JOINTS) -> float:
    """Return the mean distance in metres between fitted and true joints; `scale` is scan units per metre."""
    with np.load(fit["output"]) as arrays:
        found = dict(zip(arrays["joint_names"].tolist(), arrays["joints"], strict=True))
        assert float(arrays["metres_per_unit"]) == fit["metres_per_unit"]
        assert bool(arrays["up_clear"]) is fit["up_clear"]
    errors = []
    for name in COMPARED:
        # So fast a fit may face backwards, so that left and right are compared by their middle.
        pair = (name, name.replace("left", "right"))
        middles = [
            np.mean([place(one) for one in pair], axis=0) for place in (found.get, lambda one: to_scan(joints[one]))
        ]
        errors.append(np.linalg.norm(middles[0] - middles[1]))
    return float(np.mean(errors)) / scale


@pytest.mark.parametrize(
    ("up", "scale", "unit"),
    [("-y", 1 / 0.0254, "in"), ("-z", 1 / HEIGHT, "guess"), ("x", 1 / 0.3048, "ft")],
)
def test_people_in_any_frame_and_unit(
    tmp_path: Path, up: str, scale: float, unit: str, capsys: pytest.CaptureFixture[str]
) -> None:
    turn = scale * rotation_to_z_up(parse_axis(up)).T
    np.save(tmp_path / "a.npy", POINTS @ turn.T)
    _, (fit,), sentences = fitted(capsys, tmp_path / "a.npy", "--out", tmp_path / "o", *FAST)
    assert fit["up"] == parse_axis(up).tolist() and fit["up_clear"]
    assert fit["unit"] == unit and fit["metres_per_unit"] * scale == pytest.approx(
        1, rel=0.15 if unit == "guess" else 1e-9
    )
    assert joint_error(fit, lambda joint: turn @ joint, scale) < MAX_ERROR_M
    assert fit["unit_clear"] is (unit != "guess")
    assert (unit == "guess") is any("--unit" in sentence for sentence in sentences)


def test_one_side_of_a_person_far_from_the_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sensor = np.array([3.0, 0.8, 0.3])
    points, normals = cloud_of(JOINTS, 6000)
    rays = points - sensor
    cell = np.round(rays / np.linalg.norm(rays, axis=1, keepdims=True) / 0.012).astype(int)
    depth = np.linalg.norm(rays, axis=1)
    nearest: dict[tuple[int, ...], float] = {}
    for key, distance in zip(map(tuple, cell), depth, strict=True):
        nearest[key] = min(nearest.get(key, np.inf), distance)
    first = np.array([distance < nearest[key] + 0.03 for key, distance in zip(map(tuple, cell), depth, strict=True)])
    seen = points[first & ((rays * normals).sum(axis=1) < 0)]
    turn, place = rotation_to_z_up(parse_axis("-y")).T, np.array([40.0, -7.0, 12.0])

    def to_scan(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + place

    np.save(tmp_path / "map.npy", to_scan(seen))
    _, (fit,), _ = fitted(capsys, tmp_path / "map.npy", "--out", tmp_path / "o", *FAST)
    assert fit["view"] == "single" and fit["up"] == [0, -1, 0]
    assert joint_error(fit, to_scan, 1.0) < MAX_ERROR_M


def test_a_named_viewpoint_is_the_sensor(model: StitchedPuppet) -> None:
    fitter = BodyFitter(model, FitterSettings())
    options = FitOptions(
        Path(), "neutral", "z", "yes", "auto", "auto", (4.0, 1.0, -2.0), False, fitter.settings, SegmentationSettings()
    )
    scan = Scan(POINTS + np.array([1.0, 0, 0]), viewpoint=np.array([9.0, 9.0, 9.0]))
    (person,) = find_people(scan, Path("a.npy"), fitter, options)
    np.testing.assert_array_equal(person.sensor, [4.0, 1.0, -2.0])
    (person,) = find_people(scan, Path("a.npy"), fitter, replace(options, viewpoint=None, view="single"))
    np.testing.assert_array_equal(person.sensor, [9.0, 9.0, 9.0])
    (person,) = find_people(scan, Path("a.npy"), fitter, replace(options, view="full"))
    assert person.sensor is None


def test_two_people_in_one_file_become_two_bodies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    step = np.array([0.2, 1.6, 0.0])
    turn = rotation_to_z_up(parse_axis("y")).T
    np.save(tmp_path / "two.npy", np.concatenate([POINTS, POINTS + step]) @ turn.T)
    _, (summary,), sentences = fitted(capsys, tmp_path / "two.npy", "--out", tmp_path / "o", "--up", "y", *FAST)
    assert len(summary["people"]) == 2 and "2 people" in sentences[0]
    errors = [
        [joint_error(fit, lambda joint, move=move: turn @ (joint + move), 1.0) for fit in summary["people"]]
        for move in (np.zeros(3), step)
    ]
    assert max(map(min, errors)) < MAX_ERROR_M and max(map(max, errors)) > 1


@pytest.mark.parametrize("extra", [[], ["--scene", "--view", "full"]])
def test_a_floor_and_flying_points_do_not_turn_people_around(
    tmp_path: Path, extra: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    height = POINTS[:, 2].min() + rng.normal(0, 0.004, 4000)
    floor = np.column_stack([rng.uniform(-1.5, 1.5, (4000, 2)), height])
    flying = rng.uniform(-1.5, 1.5, (10, 3))
    turn = rotation_to_z_up(parse_axis("y")).T
    np.save(tmp_path / "hall.npy", np.concatenate([POINTS, floor, flying]) @ turn.T)
    _, (summary,), _ = fitted(capsys, tmp_path / "hall.npy", "--out", tmp_path / "o", *extra, *FAST)
    (fit,) = summary.get("people", [summary])
    assert fit["output"] == str(tmp_path / "o" / ("hall-1.npz" if extra else "hall.npz"))
    assert fit["up"] == [0, 1, 0]
    assert joint_error(fit, lambda joint: turn @ joint, 1.0) < MAX_ERROR_M


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "1,2,nan", ""])
def test_a_viewpoint_is_three_numbers(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["fit", "a.npy", "--out", str(tmp_path), f"--viewpoint={text}"])
    assert end.value.code == 2
    assert "--viewpoint" in capsys.readouterr().err
