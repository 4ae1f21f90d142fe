# SPDX-License-Identifier: Apache-2.0
"""Read bags in log order as ROS 2 messages: folders, single files, of other writers, and the rest of broken ones."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from mcap.reader import make_reader

from flowing_puppet_ros.bag.foreign.convert import Converter
from flowing_puppet_ros.bag.foreign.ros_types import normalise_type
from flowing_puppet_ros.bag.foreign.video import VideoImages
from flowing_puppet_ros.bag.storage.folder import METADATA, RecordingFiles, find_recording
from flowing_puppet_ros.bag.storage.open_file import open_file
from flowing_puppet_ros.bag.storage.paths import is_bag as is_bag  # for those who open what it recognises
from flowing_puppet_ros.bag.storage.stored_file import StoredFile
from flowing_puppet_ros.bag.typestore import BagMessageFactory, typestore, typestore_with
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.detections import find_body_id, skeleton_topic
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, IDS_LIST


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One recorded message: topic, type, time of recording (ns), CDR bytes, and the type's definition in the bag."""

    topic: str
    type: str
    log_time: int
    raw: bytes
    definition: str = ""

    @property
    def message(self) -> Any:
        """The message object; InputError if the type is unknown or the bytes are not a message of it."""
        try:
            store = typestore_with(self.type, self.definition)
        except InputError as error:
            raise InputError(f"the messages on {self.topic} cannot be read: {error}") from error
        try:
            return store.deserialize_cdr(self.raw, self.type)
        except Exception as error:  # wrong bytes make the library raise anything
            raise InputError(f"a message on {self.topic} is not the {self.type} that it claims to be") from error


@dataclass(frozen=True, slots=True)
class Topic:
    """Type, number of messages and QoS profiles of one topic in a bag."""

    type: str
    count: int
    qos: tuple[dict[str, Any], ...]


class RecordingLike(Protocol):
    """Messages by topic: those of a bag, or those that were heard live."""

    @property
    def path(self) -> Path:
        """Where it comes from."""
        ...

    @property
    def topics(self) -> Mapping[str, str]:
        """The types of the topics by name."""
        ...

    @property
    def details(self) -> Mapping[str, Topic]:
        """The topics by name."""
        ...

    @property
    def notes(self) -> list[str]:
        """What is to be said about how it was read."""
        ...

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Yield the messages of `topics` (all by default) in the order of their log times."""
        ...


class Bag:
    """An open bag, used as a context manager; messages are streamed, not kept.

    `details` are the topics by name. `notes` say what was salvaged, and where files and metadata.yaml disagree.
    """

    def __init__(self, path: Path, recording: RecordingFiles, salvage: bool = False) -> None:
        """Open the files of the `recording`, which are those of the bag `path`."""
        self.path = path
        self.notes: list[str] = list(recording.notes)
        self._files: list[StoredFile] = []
        self._converters: list[list[Converter]] = []
        self.details: dict[str, Topic] = {}
        try:
            for part in recording.files:
                self._files.append(open_file(part, salvage))
        except BaseException:
            self.close()
            raise
        store, factory = typestore(), BagMessageFactory()
        for file in self._files:
            self.notes += file.notes
            self._converters.append([Converter(topic, store, factory) for topic in file.topics])
            for topic, converter in zip(file.topics, self._converters[-1], strict=True):
                known = self.details.get(topic.topic)
                count = topic.count + (known.count if known else 0)
                self.details[topic.topic] = Topic(converter.type, count, topic.qos)
        for topic in recording.listed_topics:
            self.details.setdefault(topic.topic, Topic(normalise_type(topic.type), 0, topic.qos))

    @property
    def topics(self) -> dict[str, str]:
        """Type of every topic by name; `details` has counts and QoS too."""
        return {name: topic.type for name, topic in self.details.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Yield the messages of `topics` (all by default) in the order of their log times.

        An image of a video whose decoder waits for later ones comes with the time of the packet that completes it.
        """
        chosen = set(self.details if topics is None else topics)
        files = zip(self._files, self._converters, strict=True)
        merged = heapq.merge(*(_read(*one, chosen) for one in files), key=lambda record: record.log_time)
        video, last = VideoImages(typestore(), BagMessageFactory()), 0
        for record in merged:
            if record.type != COMPRESSED_IMAGE:
                yield record
                continue
            last = record.log_time
            for raw in video.decode(record.topic, record.raw):
                yield record if raw is record.raw else replace(record, raw=raw)
        for topic, raw in video.flush():
            yield Record(topic, COMPRESSED_IMAGE, last, raw)

    def read_metadata(self, name: str) -> dict[str, str]:
        """Return the texts that `BagWriter.add_metadata` stored under this name; empty if there are none."""
        path = next(iter(sorted(self.path.glob("*.mcap"))), self.path) if self.path.is_dir() else self.path
        if path.suffix != ".mcap":
            return {}
        try:
            with path.open("rb") as stream:
                return next((m.metadata for m in make_reader(stream).iter_metadata() if m.name == name), {})
        except Exception:  # a damaged file makes the library raise anything; its messages may be whole
            return {}

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.details.values())

    def close(self) -> None:
        """Close the files."""
        while self._files:
            self._files.pop().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read(file: StoredFile, converters: Sequence[Converter], topics: Collection[str]) -> Iterator[Record]:
    """Yield the messages of some topics of a file in log order, as ROS 2 messages."""
    chosen = [index for index, topic in enumerate(file.topics) if topic.topic in topics]
    for index, log_time, raw in file.messages(chosen) if chosen else ():
        converter = converters[index]
        yield Record(file.topics[index].topic, converter.type, log_time, converter.convert(raw), converter.definition)


def open_bag(path: Path | str, salvage: bool = False) -> Bag:
    """Open a bag for reading; InputError if it is missing, not a bag, cut off or damaged.

    A bag is a file (MCAP, database of rosbag2, ROS 1 bag, any of them compressed) or the folder of one recording. With
    `salvage`, a broken one is read as far as possible.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no bag {path}")
    if path.name == METADATA:
        path = path.parent
    return Bag(path, find_recording(path) if path.is_dir() else RecordingFiles([path]), salvage)


def rename_topics(topics: Mapping[str, str], topic_map: Mapping[str, str]) -> dict[str, str]:
    """Return old topic -> new topic; with a list of bodies, their skeletons move beside its new name."""
    found = {name: topic_map.get(name, name) for name in topics}
    for listing, new in topic_map.items():
        if topics.get(listing) == IDS_LIST:
            bodies = {name: find_body_id(listing, name) for name in topics if name not in topic_map}
            found |= {name: skeleton_topic(new, identity) for name, identity in bodies.items() if identity}
    return found
