# SPDX-License-Identifier: Apache-2.0
"""What suffixes, units and axes of scans are called."""

from __future__ import annotations

SCAN_SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb", ".gltf", ".pcd", ".xyz", ".npy", ".npz", ".asc", ".pts")
SUFFIXES = (*SCAN_SUFFIXES, ".txt", ".csv", ".bin")
"""Suffixes that are read; in a folder only `SCAN_SUFFIXES`, since the others may be anything."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres per unit."""
UP_AXES = ("z", "y", "-y", "-z", "x", "-x")
"""Axes that may point up, the likelier first; -y in optical frames (REP-103)."""
