# SPDX-License-Identifier: Apache-2.0
"""`fit --joints` starts from given joints in the scan's frame and unit; `fit --measure` measures in metres."""

import json
from pathlib import Path

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

JOINTS = joints_of(bend=1.2, raise_left=1.4, raise_right=0.2)
POINTS, NORMALS = cloud_of(JOINTS)
LIMBS = [f"{side}_{joint}" for side in ("left", "right") for joint in ("elbow", "wrist", "knee", "ankle")]
TO_Y_UP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])


def write_joints(path: Path, turn: np.ndarray, scale: float, **other: object) -> Path:
    """Write the man's joints in some frame and unit."""
    joints = {name: [*(scale * turn @ place).tolist(), 1.0] for name, place in JOINTS.items()}
    path.write_text(json.dumps({"frame": "scan", "joints": joints} | other))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("turn", "scale", "up"), [(np.eye(3), 1.0, [0, 0, 1]), (TO_Y_UP, 1000.0, [0, 1, 0])])
def test_a_fit_begins_at_given_joints(
    turn: np.ndarray, scale: float, up: list[int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "man.npy", scale * POINTS @ turn.T)
    given = write_joints(tmp_path / "joints.json", turn, scale)
    status, (fit,), _ = fitted(
        capsys, tmp_path / "man.npy", "--out", tmp_path / "o", "--joints", given, "--measure", *FAST
    )
    assert (status, fit["up"], fit["metres_per_unit"]) == (0, up, 1 / scale)
    with np.load(fit["output"]) as arrays:
        places = dict(zip(arrays["joint_names"], arrays["joints"] / scale, strict=True))
        measured = dict(zip(arrays["measurement_names"], arrays["measurements"], strict=True))
    errors = [np.linalg.norm(places[name] - turn @ JOINTS[name]) for name in LIMBS]
    assert np.mean(errors) < 0.05, dict(zip(LIMBS, errors, strict=True))
    assert measured == pytest.approx(fit["measurements"])
    stature = np.ptp(cloud_of(joints_of())[0][:, 2])
    assert fit["measurements"]["stature"] == pytest.approx(stature, abs=0.08)  # he is made of capsules
    assert fit["measurements"]["arm_length"] == pytest.approx(0.28 + 0.25, abs=0.05)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2", "is not a JSON file; expected is"),
        ('{"left_wrist": [1, 2, 3]}', "has no joints; expected is"),
        ('{"frame": "map", "joints": {}}', "joints in the frame 'map'; give them in the scan's own"),
        ('{"joints": {"left_wrist": "here"}}', "left_wrist is 'here'; expected is [x, y, z, confidence]"),
        ('{"joints": {"left_wrist": [0, 0, 1], "tail": [0, 0, 0]}}', "only 1 of the 2 initial joints"),
    ],
)
def test_joints_that_start_nothing(text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "man.npy", POINTS)
    (tmp_path / "joints.json").write_text(text)
    status, _, (sentence,) = fitted(
        capsys, tmp_path / "man.npy", "--out", tmp_path / "o", "--joints", tmp_path / "joints.json", *FAST
    )
    assert status == 2
    assert words in sentence


def test_joints_in_another_unit_than_the_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "man.npy", POINTS)
    given = write_joints(tmp_path / "joints.json", np.eye(3), 1000.0)
    status, _, (sentence,) = fitted(
        capsys, tmp_path / "man.npy", "--out", tmp_path / "o", "--unit", "m", "--joints", given, *FAST
    )
    assert status == 2
    assert "from those of any person, and span" in sentence
    assert "give them in the scan's own frame and unit" in sentence


def test_joints_are_of_one_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "man.npy", POINTS)
    given = write_joints(tmp_path / "joints.json", np.eye(3), 1.0)
    several = (tmp_path / "man.npy", tmp_path / "man.npy", "--out", tmp_path / "o", "--joints", given)
    status, _, (sentence,) = fitted(capsys, *several)
    assert status == 2 and "give one INPUT" in sentence
