# SPDX-License-Identifier: Apache-2.0
"""The tracker of flowing puppets: propagate by flow, associate detections, fuse, drop.

Images in order, their optical flow and detections, when there are any, come in; the puppets of one image go out, with
ids that stay. Read `tracker` first, then `propagation` and `track`.
"""
