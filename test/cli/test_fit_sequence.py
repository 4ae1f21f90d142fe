# SPDX-License-Identifier: Apache-2.0
"""`fit --sequence`: one shape for the scans of one person over time, whose joints are right in each."""

import json
from pathlib import Path

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

LIMBS = [f"{side}_{joint}" for side in ("left", "right") for joint in ("elbow", "wrist", "knee", "ankle")]


def bone(places: dict[str, np.ndarray], first: str, second: str) -> float:
    return float(np.linalg.norm(places[first] - places[second]))


@pytest.mark.slow
def test_one_person_has_one_shape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = [joints_of(raise_left=lift, raise_right=0.3, bend=0.2) for lift in (0.4, 0.7, 1.0)]
    moved = [np.array([0.1 * k, 0.0, 0.0]) for k in range(3)]
    for k, (pose, step) in enumerate(zip(poses, moved, strict=True)):
        np.save(tmp_path / f"scan{k}.npy", 1000 * (cloud_of(pose, seed=k)[0] + step))
    scans = [tmp_path / f"scan{k}.npy" for k in range(3)]
    # So fast a fit may face backwards; the joints of the first scan say where the front is, in all.
    first = {name: (1000 * place).tolist() for name, place in poses[0].items()}
    (tmp_path / "first.json").write_text(json.dumps({"joints": first}))
    flags = ("--out", tmp_path / "o", "--sequence", "--measure", "--joints", tmp_path / "first.json", *FAST)
    status, fits, _ = fitted(capsys, *scans, *flags)
    assert status == 0
    assert [Path(fit["output"]).name for fit in fits] == ["scan0.npz", "scan1.npz", "scan2.npz"]
    shapes, errors, thighs = [], [], []
    for fit, pose, step in zip(fits, poses, moved, strict=True):
        with np.load(fit["output"]) as arrays:
            shapes.append(arrays["all_shape_coefficients"])
            places = dict(zip(arrays["joint_names"].tolist(), arrays["joints"] / 1000, strict=True))
        errors.append(np.mean([np.linalg.norm(places[name] - pose[name] - step) for name in LIMBS]))
        thighs.append(bone(places, "left_hip", "left_knee"))
    assert np.ptp(np.array(shapes), axis=0).max() == 0, "one shape"
    assert np.abs(shapes[0]).max() > 0.1, "and not the mean shape"
    assert np.ptp(thighs) < 0.02
    assert max(errors) < 0.06, errors
    statures = [fit["measurements"]["stature"] for fit in fits]
    assert np.ptp(statures) < 0.01


def test_what_is_no_sequence_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "more").mkdir()
    points = cloud_of(joints_of())[0]
    for path in (tmp_path / "a.npy", tmp_path / "more" / "a.npy"):
        np.save(path, points)
    both = (tmp_path / "a.npy", tmp_path / "more" / "a.npy", "--out", tmp_path / "o", "--sequence")
    status, _, (sentence,) = fitted(capsys, *both)
    assert status == 2 and "several inputs are called a" in sentence
    status, _, (sentence,) = fitted(capsys, *both, "--scene")
    assert status == 2 and "leave --scene" in sentence
