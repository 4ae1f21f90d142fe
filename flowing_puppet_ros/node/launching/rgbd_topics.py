# SPDX-License-Identifier: Apache-2.0
"""The topics of a camera with colour and depth below its namespace, by the layouts of the drivers in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.launching.topics import TopicKind, list_topics

COLOUR_NAMES = (
    "color/image_raw",  # RealSense, Orbbec
    "rgb/color/rect/image",  # ZED, from 5 on
    "rgb/image_rect_color",  # ZED up to 4, HSR, OpenNI
    "rgb/image_raw",  # Azure Kinect, HSR, OpenNI
)
DEPTH_NAMES = (
    "aligned_depth_to_color/image_raw",  # RealSense with align_depth.enable
    "depth_to_rgb/image_raw",  # Azure Kinect
    "depth/depth_registered",  # ZED
    "depth_registered/image_rect",  # OpenNI with depth_image_proc
    "depth_registered/image_rect_raw",  # HSR
    "depth_registered/image_raw",
    "depth_registered/image",  # HSR
    "depth/image_rect_raw",  # RealSense, not registered
    "depth/image_raw",  # Orbbec, registered with depth_registration; Azure Kinect, not registered
)
"""Names below a camera's namespace, preferred ones first: depth that is registered to colour before other depth."""
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_TRANSPORTS = ("/compressed", "/compressedDepth")
_RGBD = TopicKind("camera", _IMAGES, r"^$", r"")


@dataclass(frozen=True, slots=True)
class RgbdTopics:
    """The topics of a camera: images of colour and depth, and the camera_info of each."""

    image: str
    image_info: str
    depth: str
    depth_info: str

    @property
    def rectified(self) -> bool:
        """Whether the colour images are rectified, by their name."""
        return "rect" in self.image


def choose_rgbd(topics: Mapping[str, Sequence[str]], camera: str) -> RgbdTopics:
    """Return the topics of the camera below a namespace among those published, {name: types}.

    Raises:
        InputError: when colour or depth is missing, or there are several cameras; the sentence lists the candidates.
    """
    images = set()
    for name, types in topics.items():
        if set(types) & set(_IMAGES):
            for transport in _TRANSPORTS:
                name = name.removesuffix(transport)
            images.add(name)
    image, depth = _choose(images, camera, COLOUR_NAMES, "colour"), _choose(images, camera, DEPTH_NAMES, "depth")
    image_info = f"{image.rpartition('/')[0]}/camera_info"
    depth_info = f"{depth.rpartition('/')[0]}/camera_info"
    if image_info not in topics:
        raise InputError(f"nobody publishes {image_info}, without which colour and depth cannot be joined")
    return RgbdTopics(image, image_info, depth, depth_info if depth_info in topics else image_info)


def find_rgbd(camera: str) -> RgbdTopics:
    """Return the topics of the camera below a namespace on the running graph; InputError as `choose_rgbd`."""
    return choose_rgbd(list_topics(_RGBD), camera)


def list_depth_topics(cameras: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the remappings and parameters of the body fitter of depth cameras together, by their namespaces.

    None without cameras. InputError as `choose_rgbd`.
    """
    names = [name.strip("/") for name in cameras]
    found = {name: find_rgbd(name) for name in names}
    inputs = {f"{name}/depth": topics.depth for name, topics in found.items()}
    inputs |= {f"{name}/camera_info": topics.depth_info for name, topics in found.items()}
    return inputs, {"rig.cameras": ",".join(names)} if names else {}


def _choose(images: set[str], camera: str, names: Sequence[str], what: str) -> str:
    below = f"/{camera.strip('/')}/" if camera.strip("/") else "/"
    for name in names:
        found = sorted(image for image in images if image.startswith(below) and image.endswith(f"/{name}"))
        if len(found) > 1:
            raise InputError(f"the {what} images could be {', '.join(found)}; choose with camera:=NAMESPACE")
        if found:
            return found[0]
    listed = ", ".join(sorted(image for image in images if image.startswith(below))) or "none"
    raise InputError(
        f"there are no {what} images below {below} under a known name ({', '.join(names)}); the images there are"
        f" {listed}; start the driver, or start camera.launch.py and lidar.launch.py with the names"
    )
