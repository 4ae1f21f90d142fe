# SPDX-License-Identifier: Apache-2.0
"""The formats that people are written in."""

FORMATS = ("glb", "bvh", "obj", "trc", "json")
