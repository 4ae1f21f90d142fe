# SPDX-License-Identifier: Apache-2.0
"""What the doctor says of files, which verb it sends them to, and what it says of the machine."""

import json
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]
from shown_commands import check  # type: ignore[import-not-found]

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.doctor import machine
from flowing_puppet_ros.doctor.inspect import inspect_input

MAN = cloud_of(joints_of())[0]
"""A man of 1.67 m on an area of no floor."""


def write_cloud(path: Path, points: np.ndarray) -> Path:
    np.savetxt(path, points)
    return path


def floor(size: float, count: int) -> np.ndarray:
    """Return points on a horizontal square under the man's feet."""
    flat = np.random.default_rng(0).uniform(-size / 2, size / 2, (count, 3))
    flat[:, 2] = MAN[:, 2].min()
    return flat


ROOM = np.concatenate([MAN, floor(6, 30_000)])


@pytest.mark.parametrize(
    ("points", "severity", "words", "flags"),
    [
        (MAN, "note", "the unit is taken for m", ""),
        (MAN * 1000, "note", "the unit is taken for mm", ""),
        (MAN, "ready", "a body can be fitted to all sides", ""),
        (MAN * 7.7, "ready", "a room or a street in m", "--scene"),
        (ROOM, "ready", "a room or a street in m", "--scene"),
        (np.concatenate([MAN, floor(2, 10_000)]), "ready", "a floor or a wall is in the scan", "--scene"),
        (np.concatenate([MAN, MAN + np.array([0, 1.5, 0])]), "note", "2 pieces stand apart", ""),
        (MAN[:20], "error", "20 points show no person", ""),
        (MAN * 1e-5, "warning", "an adult's in no unit", "--unit m"),
    ],
)
def test_scans(points: np.ndarray, severity: str, words: str, flags: str, tmp_path: Path) -> None:
    found = inspect_input(write_cloud(tmp_path / "scan.xyz", points))
    matching = [finding for finding in found.findings if words in finding.sentence]
    assert matching, found.findings
    assert matching[0].severity == severity
    assert flags in matching[0].command
    for finding in found.findings:
        if finding.command:
            check(shlex.split(finding.command))


def test_images_videos_and_keypoints(tmp_path: Path) -> None:
    picture = np.zeros((240, 320, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), picture)
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((240, 320), 1500, np.uint16))
    video = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5, (320, 240))
    for _ in range(4):
        video.write(picture)
    video.release()
    people = {"joint_names": ["left_wrist"], "frames": {"0": [[[1, 2, 0.5]], [[3, 4, 0.5]]]}}
    (tmp_path / "keypoints.json").write_text(json.dumps(people))
    (tmp_path / "notes.md").write_text("nothing")
    kinds = {"photo.png": "image", "film.avi": "video", "keypoints.json": "keypoints", "notes.md": "unknown"}
    for name, kind in (kinds | {"depth.png": "depth image"}).items():
        found = inspect_input(tmp_path / name)
        assert found.kind == kind
        assert found.is_usable is (kind != "unknown")
    said = {name: " ".join(each.sentence for each in inspect_input(tmp_path / name).findings) for name in kinds}
    assert "5 frames a second" in said["film.avi"]
    assert "2 people in 1 frames, 1 joints each" in said["keypoints.json"]
    depth = inspect_input(tmp_path / "depth.png").findings
    assert "320x240, 1500 to 1500 units" in depth[0].sentence
    check(shlex.split(depth[1].command))
    assert depth[1].command.split()[3:5] == ["--camera-info", "FX,FY,CX,CY"]


@pytest.mark.parametrize(
    ("verb", "flags", "command"),
    [
        ("replay", ["--out", "o.mcap"], "flowing-puppet fit scan.xyz --out fits"),
        ("track", ["--out", "o.json"], "flowing-puppet fit scan.xyz --out fits"),
        ("pose", ["--out", "o.json"], "flowing-puppet fit scan.xyz --out fits"),
    ],
)
def test_a_verb_that_refuses_its_input_names_the_one_that_reads_it(
    verb: str, flags: list[str], command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    write_cloud(Path("scan.xyz"), MAN[:50])
    assert main([verb, "scan.xyz", *flags]) == 2
    said = capsys.readouterr().err
    assert said.rstrip().endswith(f"; `{command}` reads it")
    assert len(said.splitlines()) == 1


def test_the_right_verb_is_not_sent_elsewhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "scan.xyz"
    empty.write_text("")
    assert main(["fit", str(empty), "--out", str(tmp_path)]) == 2
    assert "`" not in capsys.readouterr().err


def test_absent_extras_and_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {"": ["numpy", "no-such-package"], "neural": ["no-such-network"], "video": ["numpy"]}
    monkeypatch.setattr(machine, "read_requirements", lambda: listed)
    found = {finding.sentence: finding for finding in machine.inspect_machine().findings}
    missing = next(
        finding for sentence, finding in found.items() if "packages are missing: no-such-package" in sentence
    )
    assert (missing.severity, missing.command) == ("error", "pip install no-such-package")
    extra = next(finding for sentence, finding in found.items() if "the extra neural" in sentence)
    assert (extra.severity, extra.command) == ("note", "pip install no-such-network")
    assert any("the extra video" in sentence and each.severity == "ready" for sentence, each in found.items())
