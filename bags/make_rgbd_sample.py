# SPDX-License-Identifier: Apache-2.0
"""Make a recording of colour and depth without a camera: three drawn people, one walks, one waves, one sits and talks.

The people are Anny bodies (learn/anny/body.py) moved by joint angles over time, seen by a depth camera with a sensor's
errors and by a colour camera 5 cm beside it, of another size, with another lens, 17 ms later, on the topics of a common
driver. `truth.json` beside the bag has their joints by stamp, in the depth camera's frame, as `evaluate bag --truth`
reads them. Where the keypoint networks are installed they find the people; else, or with `--detections`, the bag has
`detections`: the true joints with 5 px of noise.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource, TrueBody
from flowing_puppet_ros.evaluate.rgbd import depth_sensor, rendering, sequences, views
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, SeenKeypoints
from flowing_puppet_ros.evaluate.rgbd.motions import pose_motion
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointNetworks
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages import geometry, images, message_types

HERE = Path(__file__).resolve().parent
SECONDS, RATE_HZ, FINE_RATE_HZ = 4.0, 15, 60
COLOUR_LAG_FRAMES = 1  # of the fine rate, by which the colour image is later
START_NS = 1_700_000_000 * geometry.NANOSECONDS
DETECTOR_DELAY_NS, DETECTOR_NOISE_PX = 8_000_000, 5.0
EYE_M, PITCH_RAD = np.array([0.0, 0.0, 1.25]), 0.12
CAST = {"walking": (3.6, 0.95, -0.15), "waving": (3.1, 0.05, 0.15), "seated": (2.9, -1.0, 0.5)}
"""Motion of each person: x and y of their place in metres, and by how much, rad, they turn from the camera."""

SEED = 11
CAMERAS = {"depth": "camera_depth_optical_frame", "color": "camera_color_optical_frame"}


def make_cameras() -> views.RgbdPair:
    """Return the depth camera and the colour camera beside it, in the rig's frame."""
    colour = views.make_camera((960, 540), 690.0, (0.09, -0.18, 0.001, -0.0008, 0.05))
    other = views.make_pair().colour
    placed = Camera(colour.matrix, colour.distortion, colour.size, other.rotation, other.translation)
    return views.RgbdPair(views.make_camera(), placed)


def make_people(source: BodySource) -> dict[str, list[TrueBody]]:
    """Return every person at the fine rate."""
    frames = round(SECONDS * FINE_RATE_HZ) + COLOUR_LAG_FRAMES
    found = {}
    for number, (motion, (x, y, turn)) in enumerate(CAST.items()):
        rng = np.random.default_rng([SEED, number])
        bodies = pose_motion(source, motion, rng, frames, FINE_RATE_HZ, np.pi + turn)
        found[motion] = [body.translate(np.array([x, y, 0.0])) for body in bodies]
    return found


class Recipe:
    """The messages of the recording."""

    def __init__(self, writer: BagWriter, cameras: views.RgbdPair, with_detections: bool) -> None:
        """Announce the topics and write where the cameras are."""
        self.writer, self.factory, self.with_detections = writer, BagMessageFactory(), with_detections
        self.cameras = {"depth": cameras.depth, "color": cameras.colour}
        writer.add_topic("/tf_static", message_types.TRANSFORMS, "latched")
        writer.add_topic("/camera/depth/image_rect_raw", message_types.IMAGE, "sensor")
        writer.add_topic("/camera/color/image_raw/compressed", message_types.COMPRESSED_IMAGE, "sensor")
        for name in CAMERAS:
            writer.add_topic(f"/camera/{name}/camera_info", message_types.CAMERA_INFO, "sensor")
        if with_detections:
            writer.add_topic("/camera/color/detections", message_types.PUPPETS)
        header = geometry.make_header(self.factory, START_NS, "map")
        poses = [
            geometry.make_transform(self.factory, header, frame, camera.centre, camera.rotation.T)
            for (name, frame), camera in zip(CAMERAS.items(), self.cameras.values(), strict=True)
        ]
        writer.write("/tf_static", START_NS, self.factory.make(message_types.TRANSFORMS, transforms=poses))

    def write_frame(self, stamp: int, frame: views.RgbdFrame) -> None:
        """Write the depth image of a stamp and the colour image after it, with their camera_info."""
        later = stamp + COLOUR_LAG_FRAMES * geometry.NANOSECONDS // FINE_RATE_HZ
        depth = images.make_image(
            self.factory, self._header(stamp, "depth"), depth_sensor.to_millimetres(frame.depth), "16UC1"
        )
        colour = self.factory.make(
            message_types.COMPRESSED_IMAGE,
            header=self._header(later, "color"),
            format="jpeg",
            data=images.encode_jpeg(frame.rgb, 92),
        )
        self.writer.write("/camera/depth/camera_info", stamp, self._make_info(stamp, "depth"))
        self.writer.write("/camera/depth/image_rect_raw", stamp, depth)
        self.writer.write("/camera/color/camera_info", later, self._make_info(later, "color"))
        self.writer.write("/camera/color/image_raw/compressed", later, colour)
        if self.with_detections:
            self._write_detections(later, frame.keypoints)

    def _header(self, stamp: int, camera: str) -> Any:
        return geometry.make_header(self.factory, stamp, CAMERAS[camera])

    def _make_info(self, stamp: int, name: str) -> Any:
        camera = self.cameras[name]
        header = self._header(stamp, name)
        return geometry.make_camera_info(self.factory, header, camera.size, camera.matrix, camera.distortion)

    def _write_detections(self, stamp: int, people: Sequence[SeenKeypoints]) -> None:
        puppets = []
        for person in people:
            joints = [
                self.factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=name, x=x, y=y, confidence=confidence)
                for name, (x, y), confidence in zip(LIMB_JOINTS, person.pixels, person.confidence, strict=True)
            ]
            confidence = float(person.confidence.mean())
            puppets.append(self.factory.make("flowing_puppet_msgs/msg/Puppet", confidence=confidence, joints=joints))
        array = self.factory.make(message_types.PUPPETS, header=self._header(stamp, "color"), puppets=puppets)
        self.writer.write("/camera/color/detections", stamp + DETECTOR_DELAY_NS, array)


def list_joints(source: BodySource, body: TrueBody, camera: Camera) -> dict[str, list[float]]:
    """Return the joints of a body in a camera's frame, metres, by name."""
    places = np.round(camera.to_camera(body.joints), 5)
    return dict(zip(source.joint_names, places.tolist(), strict=True))


def make_frames(
    source: BodySource, people: Sequence[Sequence[TrueBody]]
) -> tuple[views.RgbdStudio, views.RgbdPair, Any]:
    """Return the studio, the cameras in the world, and an iterator over (stamp, frame)."""
    studio = views.RgbdStudio(source, make_cameras())
    cameras = studio.cameras.place(views.look_along(np.array([1.0, 0.0, 0.0]), PITCH_RAD), EYE_M)
    rng = np.random.default_rng(SEED)
    chair = sequences.make_chair(source, people[list(CAST).index("seated")][0], rng)
    extent: list[TrueBody] = [body for person in people for body in (person[0], person[-1])]
    room: list[rendering.PaintedMesh] = [*studio.furnish(rng, extent, cameras), *chair]

    def draw() -> Any:
        step = FINE_RATE_HZ // RATE_HZ
        for index in range(round(SECONDS * RATE_HZ)):
            now = [person[step * index] for person in people]
            later = [person[step * index + COLOUR_LAG_FRAMES] for person in people]
            stamp = START_NS + index * geometry.NANOSECONDS // RATE_HZ
            yield stamp, studio.look(rng, now, room, cameras, DETECTOR_NOISE_PX, later)

    return studio, cameras, draw()


def make(out: Path, with_detections: bool) -> None:
    """Write the bag folder `out`."""
    source = BodySource()
    people = make_people(source)
    _, cameras, frames = make_frames(source, list(people.values()))
    truth = {}
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    with BagWriter(partial / out.name) as writer:
        recipe = Recipe(writer, cameras, with_detections)
        for stamp, frame in tqdm(frames, "colour and depth", round(SECONDS * RATE_HZ), unit="frame"):
            recipe.write_frame(stamp, frame)
            truth[str(stamp)] = [list_joints(source, body, cameras.depth) for body in frame.bodies]
    (partial / out.name / "truth.json").write_text(json.dumps(truth) + "\n", "utf8")
    (partial / out.name / "recipe.sha256").write_text(recipe_digest(with_detections) + "\n", "utf8")
    shutil.rmtree(out, ignore_errors=True)
    (partial / out.name).replace(out)
    partial.rmdir()


def recipe_digest(with_detections: bool) -> str:
    """Return a hash of all that decides what the bag holds."""
    modules = sorted((HERE.parent / "flowing_puppet_ros" / "evaluate" / "rgbd").glob("*.py"))
    parts = [path.read_bytes() for path in (Path(__file__), *modules)]
    return hashlib.sha256(b"".join([*parts, str(with_detections).encode()])).hexdigest()


def has_networks() -> bool:
    """Return whether the keypoint networks, which find drawn people, are installed."""
    try:
        KeypointNetworks.load()
    except InputError:
        return False
    return True


def main() -> int:
    """Run from the command line and print the path of the bag."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "cache" / "rgbd", help="folder of the bag [%(default)s]")
    parser.add_argument("--detections", action="store_true", help="the bag has detections [without networks only]")
    arguments = parser.parse_args()
    digest = arguments.out / "recipe.sha256"
    try:
        if arguments.out.exists() and not digest.exists():
            raise InputError(f"{arguments.out} exists and is not this recording: name another --out")
        with_detections = arguments.detections or not has_networks()
        if with_detections:
            print("the people's keypoints are their true joints with 5 px of noise, on detections", file=sys.stderr)
        if not digest.exists() or digest.read_text("utf8").strip() != recipe_digest(with_detections):
            make(arguments.out, with_detections)
    except PuppetError as error:
        print(f"make_rgbd_sample: {error}", file=sys.stderr)
        return error.exit_status
    print(arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
