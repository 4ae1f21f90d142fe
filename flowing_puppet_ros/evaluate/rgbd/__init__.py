# SPDX-License-Identifier: Apache-2.0
"""Synthetic colour and depth of people whose every vertex is known, as a camera sees them.

Bodies and a room go in; depth images with a sensor's errors, drawn colour images, keypoints as a network would give
them and the truth come out. Read `views` first, then `rendering` and `depth_sensor`.
"""
