# SPDX-License-Identifier: Apache-2.0
"""Puppets in images and video: keypoints, tracking, silhouettes."""
