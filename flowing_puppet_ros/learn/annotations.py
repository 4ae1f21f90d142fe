# SPDX-License-Identifier: Apache-2.0
"""Flags of the commands that learn from annotated images or videos, and the annotations that they name."""

from __future__ import annotations

import argparse
from pathlib import Path

from flowing_puppet_ros.image.formats.annotations import Annotations


def add_annotation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `load_annotations`."""
    parser.add_argument("annotations", type=Path, help="JSON of the annotation tool, or of joints per clip")
    parser.add_argument("--media", type=Path, help="folder of the images or videos [where the JSON is, or its clips/]")
    parser.add_argument("--leave-out", type=Path, help="annotations whose files and source videos are not learned from")


def load_annotations(arguments: argparse.Namespace) -> Annotations:
    """Read the annotations, without those of the sources to be left out; InputError when a file is not one."""
    annotations = Annotations.load(arguments.annotations, arguments.media)
    if arguments.leave_out is None:
        return annotations
    return annotations.exclude_sources_of(Annotations.load(arguments.leave_out))
