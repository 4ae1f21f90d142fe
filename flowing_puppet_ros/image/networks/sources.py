# SPDX-License-Identifier: Apache-2.0
"""Who may find people, in words for users."""

from __future__ import annotations

from flowing_puppet_ros.image.networks.files import REMEDY

IMAGE_SIDE_PX = 320
"""Longer side of a single image as the networks see it: more than in video, where the next image is another chance."""
SOURCES = ("auto", "neural", "own")
SOURCE_HELP = (
    "who finds people: neural, keypoint networks; own, the package's detector; auto, the networks if installed [auto]"
)
NETWORK_HELP = "description file (YAML) of a keypoint network of your own, ONNX or TFLite, in place of the package's"
NOT_INSTALLED = (
    "keypoint networks are not installed, people are found by the package's own detector, which knows upper bodies"
    f" from the front only: {REMEDY}"
)
