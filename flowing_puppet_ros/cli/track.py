# SPDX-License-Identifier: Apache-2.0
"""Track people in a video, a folder of frames or a bag: joints, part outlines and depth order in every frame.

People come from the keypoints of --init or of a bag, else from keypoint networks where these are installed, else from
the package's own detector; optical flow propagates them.
At the end the best hypotheses of the arms are chosen and all joints smoothed along the flow, over the whole input. With
--live no frame is used before its turn; with --method thesis the loop of the thesis places the joints instead.
"""

from __future__ import annotations

import argparse

from flowing_puppet_ros.image.networks.sources import NETWORK_HELP, SOURCE_HELP, SOURCES
from flowing_puppet_ros.image.video.settings import ClipSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("input", help="video file, folder of images, or bag (.mcap, .db3 or a rosbag2 folder)")
    parser.add_argument("--out", required=True, help="tracks.json to write")
    parser.add_argument("--source", default="auto", choices=SOURCES, help=SOURCE_HELP)
    parser.add_argument("--network", default="", metavar="FILE", help=NETWORK_HELP)
    parser.add_argument(
        "--init",
        help="people of one or more frames, for the detector: keypoints.json, or a file or folder of COCO, OpenPose, "
        "AlphaPose or MediaPipe keypoints",
    )
    parser.add_argument("--topic", default="", help="image topic of a bag [the first camera with detections]")
    parser.add_argument("--salvage", action="store_true", help="read what is whole of a truncated or damaged .mcap")
    parser.add_argument("--model", default="neutral", choices=("neutral", "female", "male"), help="body [neutral]")
    parser.add_argument("--parts", type=int, default=10, choices=(10, 14), help="14 adds hands and feet [10]")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object")
    parser.add_argument("--overlay", help="video to write: the puppets on the frames and on the flow (.mp4 or .avi)")
    parser.add_argument("--live", action="store_true", help="use no frame after the current one, as the nodes do")
    parser.add_argument(
        "--method",
        default="smoothed",
        choices=("smoothed", "thesis"),
        help="smoothed: joints smoothed along the flow; thesis: the loop of the thesis, a slow reference [smoothed]",
    )
    ClipSettings.add_arguments(parser, main="tracker")


def run(arguments: argparse.Namespace) -> int:
    """Track through the whole input and write the tracks."""
    from flowing_puppet_ros.cli.work import track  # loaded for who does more than ask for help

    return track.run(arguments)
