# SPDX-License-Identifier: Apache-2.0
"""Make the golden bag: a tiny synthetic recording of a body in four cameras, its truth, and what a replay makes of it.

The body is Anny (see learn/anny/body.py), never a sample of the learned puppets. `--expected` replays the existing
bag and writes the expected results; do that when an algorithm changes on purpose, and review the difference.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.draw.mesh_render import render
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.model import rotation
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages import geometry, images, message_types

HERE = Path(__file__).resolve().parent
FOLDER = HERE / "golden"
FRAMES = 8
RATE_HZ = 30
SIZE_PX = (192, 240)
FOCAL_PX = 215.0
START_NS = 1_600_000_000 * geometry.NANOSECONDS
DETECTOR_DELAY_NS = 5_000_000
PHASES = 1.2  # range of the swing in the recording, rad
UNDETECTED_FRAMES = (3, 6)  # frames without a detection, through which the flow must propagate the puppet
DETECTOR_NOISE_PX = 1.0  # standard deviation
SEED = 7
SETTINGS = {"visual_hull": {"hull_every": 4}}
COCO = (
    *("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow"),
    *("right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee"),
    *("left_ankle", "right_ankle"),
)


def make_pose(body: AnnyBody, phase: float) -> NDArray[np.float64]:
    """Make bone rotations (B, 3, 3) of a person who walks on the spot with swinging arms; phase in radians."""
    turns = {
        "LeftArm": (-0.35, -0.7 * np.sin(phase), 0.0),
        "RightArm": (0.35, 0.7 * np.sin(phase), 0.0),
        "LeftForeArm": (0.0, -0.4 - 0.2 * np.sin(phase), 0.0),
        "RightForeArm": (0.0, -0.4 + 0.2 * np.sin(phase), 0.0),
        "LeftUpLeg": (0.0, 0.3 * np.sin(phase), 0.0),
        "RightUpLeg": (0.0, -0.3 * np.sin(phase), 0.0),
        "LeftLeg": (0.0, 0.25 + 0.2 * np.cos(phase), 0.0),
        "RightLeg": (0.0, 0.25 - 0.2 * np.cos(phase), 0.0),
        "Spine1": (0.0, 0.0, 0.1 * np.sin(phase)),
    }
    vectors = np.zeros((len(body.bone_names), 3))
    for name, vector in turns.items():
        vectors[body.bone_index(name)] = vector
    return np.asarray(rotation.exp(vectors))


def make_cameras() -> dict[str, Camera]:
    """Make four cameras around the origin, 3 m away, that look slightly down."""
    found = {}
    for k, azimuth in enumerate(np.radians((25.0, 110.0, 205.0, 290.0))):
        place = np.array([3.0 * np.cos(azimuth), 3.0 * np.sin(azimuth), 0.5])
        forward = np.array([0.0, 0.0, -0.1]) - place
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        matrix = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2 - 0.5], [0, FOCAL_PX, SIZE_PX[1] / 2 - 0.5], [0, 0, 1]])
        found[f"cam{k + 1}"] = Camera(matrix, np.zeros(5), SIZE_PX, axes, -axes @ place)
    return found


def make_texture(rng: np.random.Generator, shape: tuple[int, int], colour: float) -> NDArray[np.uint8]:
    """Make a smooth random image (H, W, 3) around a grey level."""
    coarse = rng.uniform(-1, 1, (shape[0] // 12 + 1, shape[1] // 12 + 1, 3)).astype(np.float32)
    fine = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(colour + 45 * fine, 0, 255), np.uint8)


def make_clothing(rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make vertex colours (V, 3) from the rest pose (V, 3): skin, a striped shirt, dark trousers."""
    z, stripe = rest[:, 2], np.sin(40 * rest[:, 2]) * np.sin(25 * rest[:, 1]) > 0
    skin, shirt, trousers = np.array([224.0, 172, 140]), np.array([200.0, 60, 50]), np.array([40.0, 50, 90])
    colours = np.where(stripe[:, None], shirt, shirt * 0.6)
    colours = np.where((z < 0.05)[:, None], np.where(stripe[:, None], trousers, trousers * 1.7), colours)
    return np.where((z > 0.58)[:, None] | (np.abs(rest[:, 1]) > 0.48)[:, None], skin, colours)


class GoldenBagWriter:
    """Writer of the golden bag's messages."""

    def __init__(self, writer: BagWriter) -> None:
        """Announce the topics and write the poses of the cameras."""
        self.writer, self.factory, self.cameras = writer, BagMessageFactory(), make_cameras()
        writer.add_topic("/tf_static", message_types.TRANSFORMS, "latched")
        world = geometry.make_header(self.factory, START_NS, "world")
        poses = []
        for name, camera in self.cameras.items():
            writer.add_topic(f"/{name}/image/compressed", message_types.COMPRESSED_IMAGE, "sensor")
            writer.add_topic(f"/{name}/camera_info", message_types.CAMERA_INFO, "sensor")
            writer.add_topic(f"/{name}/detections", message_types.PUPPETS)
            child = f"{name}_optical_frame"
            poses.append(geometry.make_transform(self.factory, world, child, camera.centre, camera.rotation.T))
        writer.write("/tf_static", START_NS, self.factory.make(message_types.TRANSFORMS, transforms=poses))

    def write_image(self, name: str, stamp: int, rgb: NDArray[np.uint8]) -> None:
        """Write one image with its camera_info."""
        header = geometry.make_header(self.factory, stamp, f"{name}_optical_frame")
        matrix = self.cameras[name].matrix
        info = geometry.make_camera_info(self.factory, header, SIZE_PX, matrix, np.zeros(5))
        data = images.encode_jpeg(rgb, 90)
        image = self.factory.make(message_types.COMPRESSED_IMAGE, header=header, format="jpeg", data=data)
        self.writer.write(f"/{name}/camera_info", stamp, info)
        self.writer.write(f"/{name}/image/compressed", stamp, image)

    def write_detection(self, name: str, stamp: int, pixels: NDArray[np.float64]) -> None:
        """Write COCO keypoints (17, 2) px as the output of a single-person detector."""
        joints = [
            self.factory.make("flowing_puppet_msgs/msg/PuppetJoint", name=joint, x=x, y=y, confidence=0.8)
            for joint, (x, y) in zip(COCO, pixels, strict=True)
        ]
        puppet = self.factory.make("flowing_puppet_msgs/msg/Puppet", confidence=0.8, joints=joints)
        header = geometry.make_header(self.factory, stamp, f"{name}_optical_frame")
        array = self.factory.make(message_types.PUPPETS, header=header, puppets=[puppet])
        self.writer.write(f"/{name}/detections", stamp + DETECTOR_DELAY_NS, array)


def make_bag() -> None:
    """Render and write bags/golden/golden.mcap and truth.json."""
    rng = np.random.default_rng(SEED)
    body = AnnyBody("neutral")
    rest = body.make_rest_body(body.sample_phenotype(rng))
    colours = make_clothing(rest.vertices)
    truth = {}
    with BagWriter(FOLDER / "golden.mcap") as writer:
        recording = GoldenBagWriter(writer)
        backgrounds = {name: make_texture(rng, SIZE_PX[::-1], 120.0) for name in recording.cameras}
        for frame in range(FRAMES):
            stamp = START_NS + frame * geometry.NANOSECONDS // RATE_HZ
            vertices, joints = body.pose(rest, make_pose(body, PHASES * (frame / (FRAMES - 1) - 0.5)))
            named = body.locate_landmarks(vertices, joints)
            truth[str(stamp)] = {joint: np.round(place, 5).tolist() for joint, place in named.items()}
            places = np.stack([named[joint] for joint in COCO])
            for name, camera in recording.cameras.items():
                picture = render(
                    vertices, body.triangles, camera, SIZE_PX, colours=colours, background=backgrounds[name]
                )
                recording.write_image(name, stamp, picture.rgb)
            for name, camera in recording.cameras.items():
                noise = rng.normal(0, DETECTOR_NOISE_PX, (len(COCO), 2))
                if frame not in UNDETECTED_FRAMES:
                    recording.write_detection(name, stamp, camera.project(places)[0] + noise)
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", "utf8")


def read_results(path: Path) -> dict[str, Any]:
    """Read the joints of a replayed bag by topic and stamp, pixels and metres, and the version of OpenCV.

    {"puppets": ..., "bodies": ..., "opencv": "MAJOR.MINOR"}
    """
    found: dict[str, Any] = {"puppets": {}, "bodies": {}, "opencv": ".".join(cv2.__version__.split(".")[:2])}
    with open_bag(path) as bag:
        for record in bag.messages([f"/{name}/puppets" for name in make_cameras()] + ["/bodies"]):
            stamp = str(geometry.stamp_ns(record.message))
            if record.topic == "/bodies":
                found["bodies"][stamp] = [
                    {j.name: [round(c, 4) for c in (j.position.x, j.position.y, j.position.z)] for j in each.joints}
                    for each in record.message.bodies
                ]
            else:
                found["puppets"].setdefault(record.topic, {})[stamp] = [
                    {j.name: [round(j.x, 2), round(j.y, 2)] for j in each.joints} for each in record.message.puppets
                ]
    return found


def make_expected() -> None:
    """Replay the golden bag and write bags/golden/expected.json."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        summary = replay(FOLDER / "golden.mcap", out, ReplayOptions(settings=SETTINGS))
        for warning in summary["warnings"]:
            print(f"make_golden: {warning}", file=sys.stderr)
        (FOLDER / "expected.json").write_text(json.dumps(read_results(out), indent=1) + "\n", "utf8")


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--expected", action="store_true", help="only write the expected results, from the existing bag"
    )
    arguments = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    if not arguments.expected:
        make_bag()
    make_expected()
    return 0


if __name__ == "__main__":
    sys.exit(main())
