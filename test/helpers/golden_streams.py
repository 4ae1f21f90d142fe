# SPDX-License-Identifier: Apache-2.0
"""Messages of the golden bag, as trackers and hulls take them."""

from pathlib import Path
from typing import Any

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.stream.component import Component
from flowing_puppet_ros.stream.components.puppet_tracker import PuppetTrackerComponent, PuppetTrackerSettings
from flowing_puppet_ros.stream.messages.geometry import stamp_ns

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden" / "golden.mcap"
FACTORY = BagMessageFactory()
Stream = list[tuple[str, Any]]


def read_golden() -> dict[str, list[Any]]:
    """Messages of the golden bag by topic."""
    found: dict[str, list[Any]] = {}
    with open_bag(GOLDEN) as bag:
        for record in bag.messages():
            found.setdefault(record.topic, []).append(record.message)
    return found


def tracker(**settings: Any) -> PuppetTrackerComponent:
    return PuppetTrackerComponent(PuppetTrackerSettings.from_mapping(settings), FACTORY)


def drive(component: Component[Any], stream: Stream) -> Stream:
    """Return everything that comes out, to the end."""
    found = [made for port, message in stream for made in component.handle(port, message)]
    return found + component.flush()


def interleaved(images: list[Any], detections: dict[int, Any], first: str) -> Stream:
    stream: Stream = []
    for image in images:
        pair: Stream = [("image", image)]
        if stamp_ns(image) in detections:
            pair.insert(0 if first == "detections" else 1, ("detections", detections[stamp_ns(image)]))
        stream += pair
    return stream


def hull_stream(recorded: dict[str, list[Any]], skip: tuple[str, ...] = ()) -> Stream:
    """What two cameras' trackers and drivers send to the hull."""
    stream: Stream = [("/tf_static", message) for message in recorded["/tf_static"]]
    for name in ("cam1", "cam2"):
        component = tracker()
        component.set_subscribed("part_labels", True)
        stream += [(f"{name}/camera_info", message) for message in recorded[f"/{name}/camera_info"][:1]]
        by_stamp = {stamp_ns(message): message for message in recorded[f"/{name}/detections"]}
        seen = recorded[f"/{name}/image/compressed"][:2]
        stream += [(f"{name}/image", message) for message in seen]
        made = drive(component, interleaved(seen, by_stamp, "detections"))
        stream += [(f"{name}/{port}", message) for port, message in made]
    return [item for item in stream if not item[0].endswith(skip)] if skip else stream
