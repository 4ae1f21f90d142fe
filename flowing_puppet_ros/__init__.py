# SPDX-License-Identifier: Apache-2.0
"""Generative, part-based human body models for robot perception: flowing puppets in 2D, stitched puppets in 3D."""

import os
from pathlib import Path

from flowing_puppet_ros.process.kernel_cache import set_cache_folder

__version__ = "0.1.0"

set_cache_folder(Path(__file__).parent, os.environ)
