# SPDX-License-Identifier: Apache-2.0
"""Keypoint networks as the source of people: MoveNet and BlazePose, whose weights come inside packages, or your own.

An image (H, W, 3) comes in, and perhaps people who are known; keypoints in pixels go out, with the probability that
each is right. Read `keypoint_networks` first; `files` says where the weights come from, `choice` which source is used.
"""
