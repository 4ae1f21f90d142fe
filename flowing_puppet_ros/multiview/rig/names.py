# SPDX-License-Identifier: Apache-2.0
"""What forms, units and axes of calibrations are called."""

from __future__ import annotations

FORMS = {
    "pose2sim": "TOML of Pose2Sim, Anipose and Caliscope",
    "easymocap": "folder with intri.yml and extri.yml",
    "qualisys": ".qca.txt",
    "ros": "folder of camera_info YAML with transforms.yaml",
    "colmap": "folder with cameras.txt and images.txt",
}
"""Forms that are read and written."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in a unit of length."""
AXES = ("x", "-x", "y", "-y", "z", "-z")
"""Directions that may point up."""
