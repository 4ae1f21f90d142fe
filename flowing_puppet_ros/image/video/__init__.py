# SPDX-License-Identifier: Apache-2.0
"""A stream or a clip of images with the detector beside the tracker.

Frames come in; tracked puppets go out. `live_tracker` runs detections beside tracking as the node does,
`tracking_by_detection` runs the detector at every image, `offline_smoother` sees a clip as a whole. Read `live_tracker`
first.
"""
