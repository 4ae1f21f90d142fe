# SPDX-License-Identifier: Apache-2.0
"""Images in, dense optical flow out."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np

from flowing_puppet_ros.arrays import F32, U8
from flowing_puppet_ros.draw.flow_colour import flow_scale, flow_to_rgb
from flowing_puppet_ros.flow.estimate import OpticalFlow
from flowing_puppet_ros.flow.settings import FlowSettings
from flowing_puppet_ros.stream.component import COMPRESSED, Component, Output, Port
from flowing_puppet_ros.stream.components import warm_up
from flowing_puppet_ros.stream.messages.geometry import stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image, make_image
from flowing_puppet_ros.stream.messages.message_types import IMAGE, MessageFactory

MAX_PREVIEW_SIDE_PX = 640


class OpticalFlowComponent(Component[FlowSettings]):
    """Flow between each image and the next.

    `flow/forward` has the header of the earlier image, `flow/backward` that of the later one: always that of the image
    whose pixels move. A stamp that goes back or an image of another size restarts the flow.
    """

    settings_type = FlowSettings
    inputs = (Port("image", IMAGE, "sensor", transport=COMPRESSED),)
    outputs = (
        Port("flow/forward", IMAGE, recorded=False),
        Port("flow/backward", IMAGE, recorded=False),
        Port("flow/preview", IMAGE, lazy=True, transport=COMPRESSED),
    )

    def __init__(self, settings: FlowSettings, factory: MessageFactory) -> None:
        """Make the flow estimator."""
        super().__init__(settings, factory)
        self._flow = OpticalFlow(settings)
        self._previous: tuple[Any, int, U8] | None = None

    def warm_up(self) -> None:
        """Compute and colour the flow of synthetic images with another component."""
        other = type(self)(self.settings, self.factory)
        other.set_subscribed("flow/preview", True)
        for image in warm_up.make_images(self.factory):
            other.handle("image", image)

    def reset(self) -> None:
        """Drop the previous image."""
        self._previous = None

    def _process(self, port: str, message: Any) -> Output:
        image, stamp = decode_image(message), stamp_ns(message)
        previous, self._previous = self._previous, (message.header, stamp, image)
        if previous is None:
            return []
        header, earlier_stamp, earlier = previous
        if stamp <= earlier_stamp or earlier.shape != image.shape:
            self.report.warn("the stamps went back or the image size changed: the flow restarts")
            self.counters["restarts"] += 1
            return []
        forward, backward = self._flow(earlier, image)
        self.counters["flows"] += 1
        outputs = [
            ("flow/forward", make_image(self.factory, header, forward, "32FC2")),
            ("flow/backward", make_image(self.factory, message.header, backward, "32FC2")),
        ]
        if "flow/preview" in self._subscribed:
            outputs.append(("flow/preview", make_image(self.factory, header, FlowPicture(forward).rgb, "rgb8")))
        return outputs


class FlowPicture:
    """The picture of a flow, for several previews, and of others in the same colours.

    Each flow is scaled down to at most `MAX_PREVIEW_SIDE_PX` on its longer side.
    """

    def __init__(self, flow: F32) -> None:
        """Take the range of colours from `flow` (H, W, 2)."""
        self._flow, self._scale = flow, flow_scale(flow)

    @cached_property
    def rgb(self) -> U8:
        """The picture (h, w, 3) of the flow itself."""
        return self.colour(self._flow)

    def colour(self, flow: F32) -> U8:
        """Return the picture (h, w, 3) of another flow (H, W, 2)."""
        picture = flow_to_rgb(flow, self._scale)
        factor = min(1.0, MAX_PREVIEW_SIDE_PX / max(flow.shape[:2]))
        if factor < 1:
            picture = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        return np.asarray(picture, np.uint8)
