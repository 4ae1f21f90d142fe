# SPDX-License-Identifier: Apache-2.0
"""People in images and video, by the first data path: image, optical flow, puppet flow, tracked puppets.

An image (H,W,3) comes in, and with a tracker its optical flow; joints in pixels, part contours and a depth order of the
parts go out, for every person. Read `tracking.tracker` first: one step of a flowing puppet.
"""
