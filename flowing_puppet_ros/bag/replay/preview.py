# SPDX-License-Identifier: Apache-2.0
"""What a recording holds, as a replay has to know it before the first message: names, calibrations and frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

from flowing_puppet_ros.bag.foreign.static_frames import find_static_transforms
from flowing_puppet_ros.bag.reader import Record, RecordingLike, rename_topics
from flowing_puppet_ros.bag.replay.cameras import MIN_CAMERAS, find_info_topics
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.geometry import FrameTree
from flowing_puppet_ros.stream.messages.message_types import POINT_CLOUD, TRANSFORMS, MessageFactory

STATIC_TRANSFORMS = "/tf_static"
MAX_FIRST_TRANSFORMS = 2000
"""Messages of a recording from whose transforms it is decided which sensors belong together."""


class RecordingPreview:
    """A look through a recording whose topics are renamed.

    Attributes:
        new_name: topic of the recording -> its name in the replay.
        topics: name in the replay -> type.
        infos: camera_info topic -> its first readable message.
        static: the messages of static transforms, all of them: in a split or cut recording they may come late.
        warnings: what was assumed.
    """

    def __init__(self, bag: RecordingLike, topic_map: Mapping[str, str], factory: MessageFactory) -> None:
        """Look through `bag`, whose topics get the names of `topic_map` (old -> new).

        Raises:
            InputError: when a topic to be renamed is not there, or two get the same name.
        """
        self._bag, self._factory = bag, factory
        self.warnings: list[str] = []
        self.new_name = rename_topics(bag.topics, topic_map)
        self.topics = {self.new_name[name]: kind for name, kind in bag.topics.items()}
        unknown = sorted(set(topic_map) - set(bag.topics))
        if unknown:
            raise InputError(f"--topic-map names {unknown[0]}, but the topics are {', '.join(sorted(bag.topics))}")
        if len(self.topics) < len(bag.topics):
            new = next(name for name in self.topics if list(self.new_name.values()).count(name) > 1)
            raise InputError(f"--topic-map gives two topics the name {new}: choose another name")
        self.static = list(self._read(lambda name: name == STATIC_TRANSFORMS and self.topics[name] == TRANSFORMS))
        self.infos = self._read_first_infos()
        self.static += self._find_fixed_frames()

    def build_frame_tree(self) -> FrameTree:
        """Return the frames of the static transforms; the replay itself warns of unusable ones."""
        frames = FrameTree()
        for record in self.static:
            with suppress(InputError):
                frames.add(record.message)
        return frames

    def connect_frames(self) -> FrameTree:
        """Return the frames of the static transforms, and those of the first ones that move."""
        frames = self.build_frame_tree()
        first = islice(_take_usable(self._read(lambda name: self.topics[name] == TRANSFORMS)), MAX_FIRST_TRANSFORMS)
        for message in first:
            with suppress(InputError):
                frames.add(message, moving=True)
        return frames

    def read_cloud_frames(self) -> dict[str, str]:
        """Return cloud topic -> the frame of its first readable cloud."""
        found: dict[str, str] = {}
        for name in self._find_topics(lambda name: self.topics[name] == POINT_CLOUD):
            for record in self._bag.messages([name]):
                with suppress(InputError):
                    found[self.new_name[name]] = record.message.header.frame_id
                break
        return found

    def _find_topics(self, wanted: Callable[[str], bool]) -> list[str]:
        """Return the recording's names of the topics whose new names are `wanted`."""
        return [old for old, new in self.new_name.items() if new in self.topics and wanted(new)]

    def _read(self, wanted: Callable[[str], bool]) -> Iterator[Record]:
        names = self._find_topics(wanted)
        return iter(self._bag.messages(names) if names else ())

    def _read_first_infos(self) -> dict[str, Any]:
        wanted = set(find_info_topics(self.topics))
        found: dict[str, Any] = {}
        for record in self._read(wanted.__contains__):
            if self.new_name[record.topic] not in found:
                with suppress(InputError):
                    found[self.new_name[record.topic]] = record.message
            if len(found) == len(wanted):
                break
        return found

    def _find_fixed_frames(self) -> list[Record]:
        """Return the transforms that never change of cameras whose frames /tf_static does not connect, as its message.

        Only several cameras need them, so the other recordings are not searched.
        """
        frames = self.build_frame_tree()
        cameras = {info.header.frame_id.lstrip("/") for info in self.infos.values()}
        with suppress(InputError):
            if len(cameras) < MIN_CAMERAS or all(frames.find_root(frame) != frame for frame in cameras):
                return []

        def is_moving(name: str) -> bool:
            return name != STATIC_TRANSFORMS and self.topics[name] == TRANSFORMS

        fixed = [
            item
            for item in find_static_transforms(_take_usable(self._read(is_moving)))
            if frames.find_root(child := item.child_frame_id.lstrip("/")) == child
        ]
        if not fixed:
            return []
        children = ", ".join(item.child_frame_id for item in fixed)
        names = ", ".join(self._find_topics(is_moving))
        self.warnings.append(f"the frames {children} on {names} never move: they are used as static")
        raw = typestore().serialize_cdr(self._factory.make(TRANSFORMS, transforms=fixed), TRANSFORMS)
        self.new_name[STATIC_TRANSFORMS] = STATIC_TRANSFORMS
        time_of_first = self.static[0].log_time if self.static else next(iter(self._bag.messages())).log_time
        return [Record(STATIC_TRANSFORMS, TRANSFORMS, time_of_first, bytes(raw))]


def _take_usable(records: Iterator[Record]) -> Iterator[Any]:
    """Yield the messages that can be read."""
    for record in records:
        with suppress(InputError):
            yield record.message
