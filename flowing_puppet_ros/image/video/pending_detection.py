# SPDX-License-Identifier: Apache-2.0
"""A detector run beside the tracking: when its result is due, and the flow that leads from its image to later ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F64, Flow, Image
from flowing_puppet_ros.flow.estimate import FlowPair
from flowing_puppet_ros.units import NANOSECONDS

FRAME_NS = NANOSECONDS // 30
"""Assumed time between images whose stamps do not increase (drivers that stamp nothing)."""
MAX_GAP_NS = 10 * NANOSECONDS
"""Maximum time that is counted between two images."""

FLOW_REDUCTION = 2
"""Flow is kept at this fraction of its resolution: a keypoint moves with its surroundings, and it takes less memory."""


@dataclass(slots=True, eq=False)
class PendingDetection[Found]:
    """A detector run, the image it is on, when its result is due, and the flow since then (None: interrupted)."""

    image: Image
    stamp_ns: int
    due_ns: int
    people: Future[list[Found]]
    flows: list[Flow] | None = field(default_factory=list)

    def record(self, flow: FlowPair | None) -> None:
        """Append the flow to the next image."""
        if flow is None:
            self.flows = None
        elif self.flows is not None:
            self.flows.append(reduce_flow(flow[0]))


@dataclass(slots=True)
class StreamClock:
    """Time in a stream of images by their stamps: `now_ns` since the first, `passed_ns` since the last (None: none)."""

    now_ns: int = 0
    passed_ns: int | None = None
    _previous: tuple[int, tuple[int, ...]] | None = None

    def advance(self, image: Image, stamp_ns: int) -> bool:
        """Go on to the next image; False if the stream starts anew with it: an earlier stamp, or another size."""
        previous, self._previous = self._previous, (stamp_ns, image.shape)
        if previous is None:
            return True
        if stamp_ns < previous[0] or image.shape != previous[1]:
            self.now_ns, self.passed_ns = 0, None
            return False
        passed = stamp_ns - previous[0]
        self.passed_ns = min(passed, MAX_GAP_NS) if passed > 0 else FRAME_NS
        self.now_ns += self.passed_ns
        return True


def to_ns(seconds: float) -> int:
    """Convert seconds to nanoseconds."""
    return round(seconds * NANOSECONDS)


def submit[Found](run: Callable[[], list[Found]], executor: Executor | None) -> Future[list[Found]]:
    """Run a detection in an `executor`, or at once where there is none."""
    if executor is not None:
        return executor.submit(run)
    done: Future[list[Found]] = Future()
    done.set_result(run())
    return done


def propagate_points(points: F64, flows: Sequence[Flow], size: tuple[int, int], keep: bool = False) -> F64:
    """Return points (..., 2) px moved along forward flows, one image after the other.

    `flows` are (h, w, 2), displacements as fractions of the image's width and height; `size` is (width, height) of the
    image that the points are in. Where the flow is unknown the point is NaN, or with `keep` stays where it was.
    """
    if not points.size:
        return points
    fractions = (points.reshape(-1, 2) + 0.5) / size
    for flow in flows:
        at = (fractions * (flow.shape[1], flow.shape[0]) - 0.5).astype(np.float32)
        moved = cv2.remap(flow, at[:, None, :], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        step = np.where(np.isfinite(at), moved[:, 0], np.nan)
        fractions = fractions + (np.nan_to_num(step) if keep else step)
    return np.asarray(fractions * size - 0.5).reshape(points.shape)


def reduce_flow(flow: Flow) -> Flow:
    """Return a flow field (h, w, 2) px at a fraction of its resolution, as fractions of its width and height."""
    height, width = flow.shape[:2]
    small = max(1, width // FLOW_REDUCTION), max(1, height // FLOW_REDUCTION)
    fractions = np.array([1 / width, 1 / height], np.float32)
    return np.asarray(cv2.resize(flow, small, interpolation=cv2.INTER_AREA) * fractions, np.float32)
