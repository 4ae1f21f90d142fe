# SPDX-License-Identifier: Apache-2.0
"""Images and detections in, flowing puppets out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import U8
from flowing_puppet_ros.draw.overlay import DrawnPuppet, draw_puppets
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.flow.estimate import FlowPair, OpticalFlow
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.networks.sources import NOT_INSTALLED
from flowing_puppet_ros.image.tracking.settings import TrackerSettings
from flowing_puppet_ros.image.tracking.tracker import FlowingPuppetTracker, TrackResult
from flowing_puppet_ros.image.video.live_tracker import LiveTracker, make_live_tracker
from flowing_puppet_ros.image.video.settings import LiveDetectionSettings
from flowing_puppet_ros.images import reduce_image
from flowing_puppet_ros.model.ds.multiview import MultiViewStructures
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.settings import Settings, nested, setting
from flowing_puppet_ros.stream.component import COMPRESSED, Component, Output, Port
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.components.optical_flow import FlowPicture
from flowing_puppet_ros.stream.components.ros4hri import Ros4HriPublisher, Ros4HriSettings, make_image_messages
from flowing_puppet_ros.stream.messages.detections import (
    OTHER_DETECTIONS,
    collect_detections,
    decode_detections,
    is_complete,
)
from flowing_puppet_ros.stream.messages.geometry import header_ns, stamp_ns
from flowing_puppet_ros.stream.messages.image_annotations import make_annotations, make_detections_2d
from flowing_puppet_ros.stream.messages.images import decode_flow, decode_image, make_image
from flowing_puppet_ros.stream.messages.message_types import ANNOTATIONS, DETECTIONS_2D, IMAGE, PUPPETS, MessageFactory
from flowing_puppet_ros.stream.messages.puppets import make_puppets
from flowing_puppet_ros.stream.pairing.stamp_buffer import PendingQueue, StampBuffer
from flowing_puppet_ros.stream.pairing.time_synchronizer import BACKWARD_JUMP_NS

_OF_A_NEW_TRACKER = {"model", "parts", "flow.max_side", "tracker.seed", "ros4hri.publish", "ros4hri.namespace"}


BLACK_STRIDE, MIN_BRIGHTEST = 8, 12
"""Rows and columns between the pixels of which the brightest tells whether an image is black, of 255."""


@dataclass(frozen=True)
class PuppetTrackerSettings(Settings):
    """Settings of the tracker, its flow and its detector, and of what it waits for, draws and publishes."""

    model: str = setting("neutral", "body model", choices=("neutral", "female", "male"))
    parts: int = setting(14, "parts of the puppet: 10, or 14 with hands and feet", low=10, high=14)
    wait: int = setting(
        1, "images to wait for a late detection before processing without it", low=0, high=50, advanced=True
    )
    flow: FlowSettings = nested(FlowSettings, max_side=400)
    tracker: TrackerSettings = nested(TrackerSettings)
    detection: LiveDetectionSettings = nested(LiveDetectionSettings)
    ros4hri: Ros4HriSettings = nested(Ros4HriSettings)
    overlay_max_side: int = setting(960, "longest side of the overlay", unit="px", low=64, high=8192)


class PuppetTrackerComponent(Component[PuppetTrackerSettings]):
    """Tracks the people of one camera.

    An image waits for the detection and the flow of its stamp when somebody publishes them, but not longer than
    `wait` newer images. Flow that is not published is computed here, and then shown on `flow/preview`. While nobody
    publishes detections, keypoint networks look for people, or the package's own detector where there are none.
    """

    settings_type = PuppetTrackerSettings
    hot_settings = frozenset(info.name for info in PuppetTrackerSettings.describe()) - _OF_A_NEW_TRACKER
    inputs = (
        Port("image", IMAGE, "sensor", transport=COMPRESSED),
        Port("flow/forward", IMAGE, optional=True),
        Port("flow/backward", IMAGE, optional=True),
        Port("detections", PUPPETS, "sensor", optional=True, alternatives=OTHER_DETECTIONS),
    )
    outputs: tuple[Port, ...] = (
        Port("puppets", PUPPETS),
        Port("part_labels", IMAGE, lazy=True),
        Port("person_masks", IMAGE, lazy=True),
        Port("overlay", IMAGE, lazy=True, transport=COMPRESSED),
        Port("flow/preview", IMAGE, lazy=True, transport=COMPRESSED),
        Port("puppet_flow/preview", IMAGE, lazy=True, transport=COMPRESSED),
        Port("detections_2d", DETECTIONS_2D, lazy=True, optional=True),
        Port("annotations", ANNOTATIONS, lazy=True, optional=True),
    )

    def __init__(self, settings: PuppetTrackerSettings, factory: MessageFactory) -> None:
        """Load the body model."""
        super().__init__(settings, factory)
        self._model = DeformableStructures.load(settings.model, settings.parts)
        self._tracker = FlowingPuppetTracker(
            self._model,
            settings.tracker,
            settings.flow,
            MultiViewStructures.load(settings.model, settings.parts),
        )
        self._live = make_live_tracker(self._tracker, settings.detection, self.counters)
        self._line = PendingQueue()
        self._shelves = {port.name: StampBuffer() for port in self.inputs if port.optional}
        self._header: Any = None
        self._humans = Ros4HriPublisher(settings.ros4hri, factory, "skeleton2d", "roi", "cropped")
        self.outputs = (*type(self).outputs, *self._humans.ports)

    def warm_up(self) -> None:
        """Track somebody made up with a component of its own, and load the detector."""
        other = type(self)(self.settings, self.factory)
        for port in other.outputs:
            if port.lazy and not port.optional:
                other.set_subscribed(port.name, True)
        messages = warm_up.make_tracker_input(self.factory, self._model)
        warm_up.run(other, messages)
        self._live.warm_up(decode_image(messages[-1][1]), warm_up.make_puppet(self._model))

    def reset(self) -> None:
        """Forget the people and everything that waits."""
        self._tracker.reset()
        self._live.reset()
        self._line.clear()
        for shelf in self._shelves.values():
            shelf.clear()
        self._header = None

    def reconfigure(self, settings: PuppetTrackerSettings) -> None:
        """Go on tracking the same people with other settings."""
        before = self.settings.detection
        # First, since it may be impossible; then nothing has changed.
        if (settings.detection.source, settings.detection.network) != (before.source, before.network):
            self._live = make_live_tracker(self._tracker, settings.detection, self.counters)
        if settings.flow.preset != self.settings.flow.preset:
            self._tracker.optical_flow = OpticalFlow(settings.flow)
        self.settings, self._tracker.settings = settings, settings.tracker
        self._live.reconfigure(settings.detection)

    def flush(self) -> Output:
        """Process the images that still wait."""
        return self._release(final=True)

    def _process(self, port: str, message: Any) -> Output:
        stamp = stamp_ns(message)
        if port == "image":
            self._take(stamp, message)
        elif port != "flow/forward" and self._line.is_late(stamp):
            self.counters[f"late {port}"] += 1
        elif port == "detections":
            shelf = self._shelves[port]
            shelf.put(stamp, collect_detections(shelf.get(stamp), message))
        else:
            self._shelves[port].put(stamp, message)
        return self._release(final=False)

    def _take(self, stamp: int, message: Any) -> None:
        """Put an image in line; one that comes a little too late is left out, one from long before is a restart."""
        last = self._line.waiting[-1][0] if self._line.waiting else self._line.last_popped
        if last is not None and 0 < last - stamp < BACKWARD_JUMP_NS:
            self.counters["disordered images"] += 1
            self.report.warn(f"an image is {(last - stamp) * 1e-6:.0f} ms older than the one before: it is left out")
        else:
            self._line.waiting.append((stamp, message))

    def _release(self, final: bool) -> Output:
        outputs: Output = []
        while self._line.waiting:
            stamp, message = self._line.waiting[0]
            crowded = len(self._line.waiting) > self.settings.wait
            if not (final or crowded or self._is_ready(stamp)):
                break
            self._line.pop()
            try:
                outputs += self._step(stamp, message)
            except InputError as error:
                self.report.count_unusable(error)
        return outputs

    def _is_ready(self, stamp: int) -> bool:
        """Return whether everything that is expected for the image of `stamp` is there."""
        if "detections" in self._expected and not is_complete(self._shelves["detections"].get(stamp)):
            return False
        needs = []
        if self._header is not None:
            needs = [("flow/backward", stamp), ("flow/forward", header_ns(self._header))]
        return all(self._shelves[port].get(at) is not None for port, at in needs if port in self._expected)

    def _step(self, stamp: int, message: Any) -> Output:
        image, flow = decode_image(message), self._flow(stamp)
        if image[::BLACK_STRIDE, ::BLACK_STRIDE].max() < MIN_BRIGHTEST:
            self.counters["black images"] += 1
            self.report.warn("an image is black, and nobody can be found in it: see to the exposure and the lens cover")
        people = self._decode_detections(stamp, (image.shape[1], image.shape[0]))
        if people is None and "detections" not in self._expected and self.settings.detection.source != "none":
            if self.settings.detection.source == "auto" and isinstance(self._live, LiveTracker):
                self.report.warn(NOT_INSTALLED)
            result = self._live.step(image, stamp, flow, self.background)
        else:
            self._live.reset()
            result = self._tracker.step(image, stamp, people, flow)
        for warning in result.warnings:
            self.report.warn(warning)
        earlier, self._header = self._header, message.header
        self._forget(stamp)
        self.counters["images"] += 1
        self.counters["puppets"] += len(result.puppets)
        return self._publish(message.header, earlier, image, result)

    def _decode_detections(self, stamp: int, size: tuple[int, int]) -> list[Keypoints] | None:
        """Return the people whom a published detection found in the image of this stamp and size, None without one."""
        detections = self._shelves["detections"].get(stamp)
        if detections is None:
            if "detections" in self._expected:
                self.counters["images without detection"] += 1
            return None
        self.counters["paired detections"] += 1
        try:
            return decode_detections(detections, size, self.report)
        except InputError as error:  # the image is good
            self.report.count_unusable(error)
            return None

    def _forget(self, stamp: int) -> None:
        """Drop what was for images up to this one; what no image has used is counted."""
        unpaired = self._shelves["detections"].drop_until(stamp - 1)
        self.counters["unpaired detections"] += unpaired
        self._shelves["detections"].drop_until(stamp)
        self._shelves["flow/backward"].drop_until(stamp)
        self._shelves["flow/forward"].drop_until(stamp - 1)

    def _flow(self, stamp: int) -> FlowPair | None:
        if self._header is None or not {"flow/forward", "flow/backward"} <= self._expected:
            return None
        forward = self._shelves["flow/forward"].get(header_ns(self._header))
        backward = self._shelves["flow/backward"].get(stamp)
        if forward is None or backward is None:
            self.counters["images without flow"] += 1
            self.report.warn("an image came without the flow that others had: it is computed here")
            return None
        self.counters["paired flows"] += 1
        try:
            return decode_flow(forward), decode_flow(backward)
        except InputError as error:  # the image is good: its flow is computed here
            self.report.count_unusable(error)
            return None

    def _publish(self, header: Any, earlier: Any, image: U8, result: TrackResult) -> Output:
        named = [replace(puppet, id=self.publish_id(puppet.id)) for puppet in result.puppets]
        puppets = make_puppets(self.factory, header, self._model, named)
        outputs: Output = []
        # Before the puppets, since whoever uses both waits for these.
        if "person_masks" in self._subscribed:
            outputs.append(("person_masks", make_image(self.factory, header, result.render_person_masks(), "mono8")))
        outputs.append(("puppets", puppets))
        if self._humans.enabled:
            made = make_image_messages(self.factory, header, image, puppets.puppets)
            outputs += self._humans.make(header, list(made), made)
        for name, make in (("detections_2d", make_detections_2d), ("annotations", make_annotations)):
            if name in self._subscribed:
                outputs.append((name, make(self.factory, header, puppets.puppets, image.shape[1::-1])))
        if "part_labels" in self._subscribed:
            labels = result.render_part_labels(image.shape[:2])
            outputs.append(("part_labels", make_image(self.factory, header, labels, "mono8")))
        if "overlay" in self._subscribed:
            outputs.append(("overlay", self._overlay(header, image, puppets)))
        if result.flow is not None and earlier is not None:
            forward = FlowPicture(result.flow[0])
            if "flow/preview" in self._subscribed and "flow/forward" not in self._expected:
                outputs.append(("flow/preview", make_image(self.factory, earlier, forward.rgb, "rgb8")))
            moved = result.puppet_flow() if "puppet_flow/preview" in self._subscribed else None
            if moved is not None:
                both = np.hstack([forward.rgb, forward.colour(moved.field)])
                outputs.append(("puppet_flow/preview", make_image(self.factory, earlier, both, "rgb8")))
        return outputs

    def _overlay(self, header: Any, image: U8, puppets: Any) -> Any:
        factor = min(1.0, self.settings.overlay_max_side / max(image.shape[:2]))
        drawn = [DrawnPuppet.from_message(puppet).transform(factor) for puppet in puppets.puppets]
        if factor < 1:
            image = reduce_image(image, (round(factor * image.shape[1]), round(factor * image.shape[0])))
        return make_image(self.factory, header, draw_puppets(image, drawn), "rgb8")
