# SPDX-License-Identifier: Apache-2.0
"""The recipe of the recording with colour and depth: messages, frames and truth belong together."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.evaluate.rgbd import views
from flowing_puppet_ros.evaluate.rgbd.keypoints import LIMB_JOINTS, SeenKeypoints
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_depth, decode_image

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def recipe() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_rgbd_sample", BAGS / "make_rgbd_sample.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_messages_say_what_the_cameras_saw(recipe: ModuleType, tmp_path: Path) -> None:
    cameras = recipe.make_cameras().place(views.look_along(np.array([0.0, 1.0, 0.0]), 0.1), np.array([1.0, 2.0, 1.25]))
    point = np.array([1.2, 5.0, 1.0])
    pixel = cameras.colour.project(point)[0]
    depth = np.full((480, 640), 2.5)
    depth[0, 0] = np.nan
    seen = SeenKeypoints(np.tile(pixel, (12, 1)), np.full(12, 0.5), np.ones(12, bool), np.ones(12, bool))
    rgb = np.full((540, 960, 3), 90, np.uint8)
    frame = views.RgbdFrame(depth, rgb, cameras, [], np.zeros((0, 12, 3)), [seen], [seen], depth, depth)
    with BagWriter(tmp_path / "bag") as writer:
        recipe.Recipe(writer, cameras, with_detections=True).write_frame(recipe.START_NS, frame)
    with open_bag(tmp_path / "bag") as bag:
        messages = {record.topic: record.message for record in bag.messages(list(bag.topics))}
    frames = FrameTree()
    frames.add(messages["/tf_static"])
    sensed = messages["/camera/depth/image_rect_raw"]
    assert np.isnan(decode_depth(sensed)[0, 0]) and decode_depth(sensed)[0, 1] == pytest.approx(2.5)
    colour = messages["/camera/color/image_raw/compressed"]
    assert decode_image(colour).shape == (540, 960, 3)
    assert 0 < (stamp_ns(colour) - stamp_ns(sensed)) * 1e-9 < 0.02
    # From the depth camera's frame through TF and the colour camera's matrix and lens to the same pixel.
    pose = frames.lookup_pose(sensed.header.frame_id, colour.header.frame_id)
    assert pose is not None
    translation, rotation = pose
    info = messages["/camera/color/camera_info"]
    other = views.Camera.from_info(info.k, info.d, info.width, info.height, rotation, translation)
    np.testing.assert_allclose(other.project(cameras.depth.to_camera(point))[0], pixel, atol=1e-6)
    (puppet,) = messages["/camera/color/detections"].puppets
    assert [joint.name for joint in puppet.joints] == list(LIMB_JOINTS)
    assert (puppet.joints[0].x, puppet.joints[0].y) == pytest.approx(tuple(pixel))
