# SPDX-License-Identifier: Apache-2.0
"""The verb `export`: the same person from fits in any frame and unit and from recordings; errors in one sentence."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from moving_person import write_bag, write_fit  # type: ignore[import-not-found]
from shown_commands import check  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.doctor.inspect import inspect_input
from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet


def exported(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, object]:
    assert main(["export", *map(str, arguments), "--json"]) == 0
    summary: dict[str, object] = json.loads(capsys.readouterr().out)
    return summary


def joints_of(path: Path) -> np.ndarray:
    return np.array([frame["joints"] for frame in json.loads(path.read_text())["people"][0]["frames"]])


@pytest.mark.parametrize(("up", "unit"), [([0, 0, 1], "m"), ([0, 1, 0], "cm"), ([0, -1, 0], "mm"), ([0.1, 0, 1], "m")])
def test_frame_and_unit_of_a_scan_make_no_difference(
    up: list[float], unit: str, model: StitchedPuppet, states: list[BodyState], motion: BodyMotion, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    up_axis = np.array(up) / np.linalg.norm(up)
    fit = write_fit(tmp_path / "fit.npz", model, states[-1], up_axis, unit)
    exported(capsys, fit, "--to", "json", "--out", tmp_path)
    np.testing.assert_allclose(joints_of(tmp_path / "fit.json")[0], motion.joints[-1], atol=1e-4)


def test_a_recording_becomes_a_motion(
    model: StitchedPuppet, states: list[BodyState], motion: BodyMotion, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    bag = write_bag(tmp_path / "out.mcap", model, states)
    summary = exported(capsys, bag, "--to", "json", "--out", tmp_path / "files")
    assert summary["frames"] == {"out-b1": 12}
    np.testing.assert_allclose(joints_of(tmp_path / "files" / "out-b1.json"), motion.joints, atol=1e-4)
    for form in ("glb", "bvh", "trc"):
        exported(capsys, bag, "--to", form, "--out", tmp_path / "files")
        assert (tmp_path / "files" / f"out-b1.{form}").stat().st_size > 1000
    files = exported(capsys, bag, "--to", "obj", "--out", tmp_path / "files")["files"]
    assert len(files) == 12  # type: ignore[arg-type]


def test_optical_frames_are_turned_upright(
    model: StitchedPuppet, states: list[BodyState], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "out.mcap", model, states[:1], "camera_optical_frame")
    exported(capsys, bag, "--to", "json", "--out", tmp_path)
    exported(capsys, bag, "--to", "json", "--out", tmp_path / "named", "--up=-y")
    turned = joints_of(tmp_path / "out-b1.json")
    np.testing.assert_allclose(turned, joints_of(tmp_path / "named" / "out-b1.json"))
    neck = model.joint_names.index("neck")
    np.testing.assert_allclose(turned[0, neck, 1], -model.joints(model.vertices(states[0]))[neck, 1], atol=1e-4)


def test_the_doctor_sends_fits_here(model: StitchedPuppet, states: list[BodyState], tmp_path: Path) -> None:
    found = inspect_input(write_fit(tmp_path / "fit.npz", model, states[0], np.array([0.0, 0, 1]), "m"))
    command = found.findings[-1].command
    assert (found.kind, command.split()[:2]) == ("fitted body", ["flowing-puppet", "export"])
    check(shlex.split(command))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none.npz", "does not exist; give an .npz that `fit` wrote"),
        ("other.npz", "is not a fit; give the .npz that `flowing-puppet fit` writes"),
        ("scan.ply", "is not a fit"),
        ("empty.mcap", "has no fitted bodies; `flowing-puppet replay` writes them"),
        ("bag.mcap", "has nobody called z9, only b1"),
    ],
)
def test_errors_are_one_sentence(
    name: str, words: str, model: StitchedPuppet, states: list[BodyState], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    np.savez(tmp_path / "other.npz", points=np.zeros((3, 3)))
    (tmp_path / "scan.ply").write_text("ply\n")
    write_bag(tmp_path / "bag.mcap", model, states[:1])
    with BagWriter(tmp_path / "empty.mcap") as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu")
        writer.write("/imu", 1, BagMessageFactory().make("sensor_msgs/msg/Imu"))
    assert main(["export", str(tmp_path / name), "--to", "glb", "--out", str(tmp_path), "--id", "z9"]) == 2
    said = capsys.readouterr().err.strip()
    assert words in said
    assert len(said.splitlines()) == 1
