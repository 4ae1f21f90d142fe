# SPDX-License-Identifier: Apache-2.0
"""The tracker of flowing puppets: propagate by flow, associate detections, fuse, drop.

Consecutive images, their optical flow and optional detections come in; the puppets of each image go out, with stable
ids. Read `tracker` first, then `propagation` and `track`.
"""
