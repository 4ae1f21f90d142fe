# SPDX-License-Identifier: Apache-2.0
"""When the detector looks at an image of a live stream, and what its answer says of a later image.

A look takes longer than an image may wait, so it runs beside the tracking and its answer is used at a fixed age,
carried there along the flow. When it is used follows from the stamps alone: a replay, where each look is finished at
once, gives the same puppets as the live node.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from flowing_puppet_ros.flow.estimate import Flow, FlowPair, OpticalFlow
from flowing_puppet_ros.image.detector import DetectorSettings, PartDetector
from flowing_puppet_ros.image.keypoints import Keypoints
from flowing_puppet_ros.settings import Settings, setting
from flowing_puppet_ros.stream.messages import NANOSECONDS

type Image = NDArray[np.uint8]

FRAME_NS = NANOSECONDS // 30
"""What is taken to have passed when a stamp does not go on (drivers that stamp nothing)."""
LONGEST_NS = 10 * NANOSECONDS
"""What is counted at most between two images."""
COARSE = 4
"""Flow is kept at this share of its resolution: a keypoint moves with its surroundings, and little memory is taken."""


@dataclass(frozen=True)
class LookoutSettings(Settings):
    """When the detector looks for people."""

    detect: bool = setting(True, "find people by itself when nobody publishes detections")
    detect_interval: float = setting(
        2.0, "time from one look of the detector to the next while somebody is tracked", unit="s", low=0.05, high=3600.0
    )
    search_interval: float = setting(0.7, "the same while nobody is tracked", unit="s", low=0.05, high=3600.0)
    detect_delay: float = setting(
        0.6, "age at which the answer of a look is used, carried by the flow; time for the look", unit="s", low=0.0,
        high=10.0,
    )  # fmt: skip
    least_person: float = setting(0.3, "probability from which a detected person is tracked", low=0.0, high=1.0)


@dataclass(slots=True, eq=False)
class _Look:
    """An image that is being looked at, when its answer is due, and the flow since then (None: broken off)."""

    image: Image
    stamp_ns: int
    due_ns: int
    found: Future[list[Keypoints]]
    flows: list[Flow] | None = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The people of a look.

    Either carried to the present image, with the `flow` that leads to it, or, when nobody was tracked meanwhile, as
    they stand in the image `seen_in` (image, stamp) that was looked at.
    """

    people: list[Keypoints]
    flow: FlowPair | None = None
    seen_in: tuple[Image, int] | None = None


class Lookout:
    """Has the detector look at some of the images and tells whom it saw."""

    def __init__(self, settings: LookoutSettings, most_people: int, optical_flow: OpticalFlow) -> None:
        """Load nothing yet: whoever publishes detections needs no detector."""
        self._detector: PartDetector | None = None
        self.adopt(settings, most_people, optical_flow)
        self.reset()

    def adopt(self, settings: LookoutSettings, most_people: int, optical_flow: OpticalFlow) -> None:
        """Go on with these settings."""
        self._settings, self._most_people, self._optical_flow = settings, most_people, optical_flow

    def warm_up(self, image: Image) -> None:
        """Load the detector and have it look at an image of no interest, if it will ever look at any."""
        if self._settings.detect:
            self._detect(image, least_person=0.0)

    def reset(self) -> None:
        """Forget the images; the next one is looked at."""
        self._now_ns = self._next_ns = 0
        self._previous: tuple[int, Image] | None = None
        self._look: _Look | None = None

    def ask(
        self, image: Image, stamp_ns: int, tracked: bool, flow: FlowPair | None, beside: Executor | None
    ) -> Answer | None:
        """Take the next `image` (H, W, 3) RGB before it is tracked; return the answer of the look that is due with it.

        `tracked` is whether anybody is, `flow` the pair that leads to the image when it is known; a look runs on the
        executor `beside`, or at once.
        """
        previous = self._previous
        if previous is not None and (stamp_ns < previous[0] or image.shape != previous[1].shape):
            self.reset()
            previous = None
        if previous is not None:
            passed = stamp_ns - previous[0]
            self._now_ns += min(passed, LONGEST_NS) if passed > 0 else FRAME_NS
        answer = None
        if self._look is not None and self._now_ns >= self._look.due_ns and previous is not None:
            answer = self._answer(self._look, previous[1], image, tracked, flow)
            self._look = None
        if self._look is None and self._now_ns >= self._next_ns:
            self._look = self._start(image, stamp_ns, beside)
            interval = self._settings.detect_interval if tracked else self._settings.search_interval
            self._next_ns = self._now_ns + round(interval * NANOSECONDS)
        self._previous = stamp_ns, image
        return answer

    def tracked(self, stamp_ns: int, flow: FlowPair | None) -> None:
        """Note that the image of this stamp was tracked with this flow from the image before, None: with none."""
        look = self._look
        if look is None or look.stamp_ns == stamp_ns or look.flows is None:
            return
        if flow is None:
            look.flows = None
        else:
            look.flows.append(_coarse(flow[0]))

    def _start(self, image: Image, stamp_ns: int, beside: Executor | None) -> _Look:
        found: Future[list[Keypoints]] = Future()
        if beside is None:
            found.set_result(self._detect(image))
        else:
            found = beside.submit(self._detect, image)
        return _Look(image, stamp_ns, self._now_ns + round(self._settings.detect_delay * NANOSECONDS), found)

    def _detect(self, image: Image, least_person: float | None = None) -> list[Keypoints]:
        # Results may depend on the number of threads otherwise.
        cv2.setNumThreads(1)
        if self._detector is None:
            self._detector = PartDetector.load()
        least = self._settings.least_person if least_person is None else least_person
        settings = DetectorSettings(least_confidence=least, most_people=min(self._most_people, 80))
        return [person.keypoints for person in self._detector.detect(image, settings)]

    def _answer(
        self, look: _Look, previous: Image, image: Image, tracked: bool, flow: FlowPair | None
    ) -> Answer | None:
        people = look.found.result()
        if not tracked:
            return Answer(people, seen_in=(look.image, look.stamp_ns)) if people else None
        if look.flows is None:
            return None
        flow = flow or self._optical_flow.at_working_scale(previous, image)
        size = image.shape[1], image.shape[0]
        return Answer([carried(person, [*look.flows, _coarse(flow[0])], size) for person in people], flow)


def carried(person: Keypoints, flows: Sequence[Flow], size: tuple[int, int]) -> Keypoints:
    """Return keypoints that moved along forward flows, one image after the other.

    `flows` are (h, w, 2), displacements as shares of the image's width and height; `size` is (width, height) of the
    image that the keypoints are in. Where the flow is unknown so is the keypoint.
    """
    places = (person.xy + 0.5) / size
    for flow in flows:
        at = (places * (flow.shape[1], flow.shape[0]) - 0.5).astype(np.float32)
        moved = cv2.remap(flow, at[:, None, :], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        places = places + np.where(np.isfinite(at), moved[:, 0], np.nan)
    return Keypoints(person.names, places * size - 0.5, person.confidence)


def _coarse(flow: Flow) -> Flow:
    """A flow field (h, w, 2) in pixels at a quarter of its resolution, as shares of its width and height."""
    height, width = flow.shape[:2]
    small = max(1, width // COARSE), max(1, height // COARSE)
    shares = np.array([1 / width, 1 / height], np.float32)
    return np.asarray(cv2.resize(flow, small, interpolation=cv2.INTER_AREA) * shares, np.float32)
