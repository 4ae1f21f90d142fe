# SPDX-License-Identifier: Apache-2.0
"""A person who moves, as files that `fit` and `replay` write."""

from pathlib import Path

import numpy as np

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.body.fit.fitter import BodyFit
from flowing_puppet_ros.body.fit.up_axis_search import FrameFit
from flowing_puppet_ros.body.fit.visibility import BodyVisibility, Visibility
from flowing_puppet_ros.body.scans.scan_frame import ScanFrame, rotation_to_z_up
from flowing_puppet_ros.body.scans.unit import ScanUnit
from flowing_puppet_ros.body.track.tracked_body import TrackedBody
from flowing_puppet_ros.cli.scans.fit_file import _write_fit
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.message_types import BODIES
from flowing_puppet_ros.stream.messages.puppets import make_bodies, make_body

FRAMES = 12
STEP_NS = 40_000_000


def fit_of(model: StitchedPuppet, state: BodyState) -> BodyFit:
    vertices = model.vertices(state)
    seen = BodyVisibility.of_vertices(model, np.full(len(vertices), Visibility.SEEN, np.int8))
    return BodyFit(state, vertices, model.joints(vertices), 1.0, np.ones(16), 0.75, True, 0.01, seen)


def write_fit(path: Path, model: StitchedPuppet, state: BodyState, up: np.ndarray, unit: str) -> Path:
    """Write a body as `fit` does for a scan in some unit in which some direction is up."""
    frame = ScanFrame(ScanUnit.named(unit).metres, rotation_to_z_up(up))
    _write_fit(path, model, FrameFit(frame, ScanUnit.named(unit), fit_of(model, state), True, True, 1.7), 0.0, {})
    return path


def write_bag(path: Path, model: StitchedPuppet, states: list[BodyState], frame: str = "map") -> Path:
    """Write the bodies of one person as a replay does."""
    factory = BagMessageFactory()
    with BagWriter(path) as writer:
        writer.add_topic("/bodies", BODIES)
        for k, state in enumerate(states):
            header = make_header(factory, 10**9 + k * STEP_NS, frame)
            body = make_body(factory, model, TrackedBody("b1", fit_of(model, state)))
            writer.write("/bodies", 10**9 + k * STEP_NS, make_bodies(factory, header, [body]))
    return path
