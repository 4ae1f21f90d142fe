# SPDX-License-Identifier: Apache-2.0
"""Find the pose of the people in single images: joints, part outlines, depth order, and other hypotheses of the arms.

Keypoint networks where these are installed, else the package's own detector, say where people are, or the keypoints of
--init. The images of --init are found by name where it has names, or else counted from 0 in the order of the images.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.cli.work.settings import GENDERS, PoseVerbSettings
from flowing_puppet_ros.image.networks.sources import NETWORK_HELP, SOURCE_HELP, SOURCES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("images", nargs="+", type=Path, help="image files, or folders of images")
    parser.add_argument("--out", required=True, type=Path, help="poses.json to write")
    parser.add_argument(
        "--init",
        type=Path,
        help="people of each image, for the detector: keypoints.json, or a file or folder of COCO, OpenPose, AlphaPose "
        "or MediaPipe keypoints",
    )
    parser.add_argument("--source", default="auto", choices=SOURCES, help=SOURCE_HELP)
    parser.add_argument("--network", default="", metavar="FILE", help=NETWORK_HELP)
    parser.add_argument(
        "--model", default="neutral", choices=(*GENDERS, "auto"), help="body; auto: the likeliest [neutral]"
    )
    parser.add_argument("--parts", type=int, default=10, choices=(10, 14), help="14 adds hands and feet [10]")
    parser.add_argument("--json", action="store_true", help="print one JSON object per image")
    PoseVerbSettings.add_arguments(parser, main="pose")


def run(arguments: argparse.Namespace) -> int:
    """Pose the people of every image; return 1 if an image could not be read, after all others are done."""
    from flowing_puppet_ros.cli.work import pose  # loaded for who does more than ask for help

    return pose.run(arguments)
