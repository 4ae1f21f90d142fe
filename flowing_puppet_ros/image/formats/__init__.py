# SPDX-License-Identifier: Apache-2.0
"""Files of keypoints, stick figures, tracks and videos, to and from arrays.

Paths come in; keypoints with names, confidences and pixels, and the frames of a video, go out. Read `keypoints` first:
everything that detects, tracks or draws people speaks in its names.
"""
