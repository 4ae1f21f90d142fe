# SPDX-License-Identifier: Apache-2.0
"""Generative, part-based human body models for robot perception: flowing puppets in 2D, stitched puppets in 3D."""

__version__ = "0.1.0"
