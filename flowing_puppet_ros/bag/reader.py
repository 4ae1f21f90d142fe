# SPDX-License-Identifier: Apache-2.0
"""Read rosbag2 bags in log order: folders, single files, files of other writers, and the rest of broken ones."""

from __future__ import annotations

import heapq
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from mcap.reader import make_reader
from rosbags.interfaces import MessageDefinitionFormat, Qos
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.bag.mcap_file import McapFile, is_mcap, is_truncated
from flowing_puppet_ros.bag.typestore import typestore_with
from flowing_puppet_ros.errors import InputError


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


class _Part(Protocol):
    """One file of a bag, or a folder with metadata."""

    details: dict[str, Topic]

    def messages(self, topics: set[str]) -> Iterator[Record]:
        """Yield the messages of some topics in log order."""

    def close(self) -> None:
        """Close the files."""


class _NoIndex(Exception):
    """Raised when the index does not cover every message."""


class _IndexedPart:
    """A file, or a folder with metadata, that is read by its index."""

    def __init__(self, path: Path) -> None:
        """Open it; InputError if it is not a bag, _NoIndex if only a scan finds every message in order."""
        self.path = path
        try:
            self._reader = Reader(path)
            self._reader.open()
        except Exception as error:  # a damaged file makes the libraries raise anything
            raise InputError(_describe_unreadable(path)) from error
        storages = getattr(self._reader.storage, "storages", [self._reader.storage])
        # Only this reader can read files or messages that are compressed by rosbag2.
        self.compressed = bool(self._reader.compression_mode)
        if not self.compressed and not all(map(_is_indexed, storages)):
            self._reader.close()
            raise _NoIndex
        self.details = {
            c.topic: Topic(
                c.msgtype, c.msgcount, tuple(_qos_values(q) for q in getattr(c.ext, "offered_qos_profiles", ()))
            )
            for c in self._reader.connections
        }

    def messages(self, topics: set[str]) -> Iterator[Record]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        try:
            for connection, log_time, raw in self._reader.messages(connections):
                text = connection.msgdef.data if connection.msgdef.format == MessageDefinitionFormat.MSG else ""
                yield Record(connection.topic, connection.msgtype, log_time, bytes(raw), text)
        except Exception as error:  # as above; errors of the caller between two messages do not arrive here
            reason = str(error).rstrip(".") or type(error).__name__
            raise InputError(f"{self.path} is damaged: {reason}; add --salvage to read the rest") from error

    def close(self) -> None:
        self._reader.close()


class _ScannedPart:
    """An MCAP file that is read without an index."""

    def __init__(self, path: Path, salvage: bool) -> None:
        self._file = McapFile(path, salvage)
        self.details: dict[str, Topic] = {}
        for number, channel in self._file.channels.items():
            known = self.details.get(channel.topic)
            count = self._file.counts[number] + (known.count if known else 0)
            qos = _parse_qos(channel.metadata.get("offered_qos_profiles", ""))
            self.details[channel.topic] = Topic(self._file.types[number], count, qos)
        self.note = ""
        if salvage:
            skipped = (
                f", {self._file.damaged} damaged places ({self._file.skipped_bytes} bytes) passed over"
                if self._file.damaged
                else ""
            )
            count = sum(topic.count for topic in self.details.values())
            self.note = f"{path}: {count} messages salvaged{skipped}"

    def messages(self, topics: set[str]) -> Iterator[Record]:
        numbers = [number for number, channel in self._file.channels.items() if channel.topic in topics]
        for number, log_time, raw in self._file.messages(numbers):
            file = self._file
            yield Record(
                file.channels[number].topic, file.types[number], log_time, raw, file.definitions.get(number, "")
            )

    def close(self) -> None:
        pass


class Bag:
    """An open bag, used as a context manager; messages are streamed, not kept.

    `notes` says what was salvaged; `compressed` is True if rosbag2 compressed the files or the messages.
    """

    def __init__(self, path: Path, files: Collection[Path], salvage: bool = False) -> None:
        """Open the `files` (or the folder with metadata) of the bag `path`."""
        self.path = path
        self.notes: list[str] = []
        self._parts: list[_Part] = []
        try:
            for file in files:
                self._parts.append(self._open_part(file, salvage))
        except BaseException:
            self.close()
            raise
        self.compressed = any(getattr(part, "compressed", False) for part in self._parts)
        self.details: dict[str, Topic] = {}
        for part in self._parts:
            for name, topic in part.details.items():
                known = self.details.get(name)
                self.details[name] = Topic(topic.type, topic.count + (known.count if known else 0), topic.qos)

    def _open_part(self, path: Path, salvage: bool) -> _Part:
        lone = path.is_file() and path.suffix != ".db3" and is_mcap(path)
        if lone and is_truncated(path) and not salvage:
            raise InputError(f"{path} is cut off before its end: add --salvage to read what is whole")
        if lone and salvage:
            scanned = _ScannedPart(path, salvage)
            if not sum(topic.count for topic in scanned.details.values()) and is_truncated(path):
                raise InputError(f"{path} is cut off so early that it has no whole message")
            self.notes.append(scanned.note)
            return scanned
        try:
            return _IndexedPart(path)
        except (InputError, _NoIndex):
            if not lone:
                raise
            return _ScannedPart(path, salvage=False)

    @property
    def topics(self) -> dict[str, str]:
        """Type of every topic by name; `details` has counts and QoS too."""
        return {name: topic.type for name, topic in self.details.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Yield the messages of `topics` (all by default) in the order of their log times."""
        chosen = set(self.details if topics is None else topics)
        yield from heapq.merge(*(part.messages(chosen) for part in self._parts), key=lambda record: record.log_time)

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
        while self._parts:
            self._parts.pop().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_bag(path: Path | str, salvage: bool = False) -> Bag:
    """Open a bag for reading; InputError if it is missing, not a bag, cut off or damaged.

    With `salvage`, the MCAP files of a broken bag are read as far as possible.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no bag {path}")
    if not path.is_dir():
        return Bag(path, [path], salvage)
    files = sorted(path.glob("*.mcap"), key=_natural_order) or sorted(path.glob("*.db3"), key=_natural_order)
    complete = (path / "metadata.yaml").exists()
    if not complete and not files:
        raise InputError(f"the folder {path} is not a bag: it has no metadata.yaml and 0 bag files")
    # A recorder that was killed leaves no metadata, or metadata of a file that is cut off.
    if files and (not complete or any(is_truncated(file) for file in files)):
        return Bag(path, files, salvage)
    try:
        bag = Bag(path, [path])
    except _NoIndex:
        return Bag(path, files, salvage)
    if salvage and files and not bag.compressed:
        bag.close()
        return Bag(path, files, salvage)
    return bag


def _natural_order(path: Path) -> list[Any]:
    """Return the key that sorts the second file of a split bag before the tenth."""
    return [int(word) if word.isdigit() else word for word in re.split(r"(\d+)", path.name)]


def _is_indexed(storage: Any) -> bool:
    """Return whether a file is a database, or an MCAP file whose chunks are all indexed."""
    chunks = getattr(storage, "chunks", None)
    return chunks is None or (bool(chunks) and all(chunk.channel_count for chunk in chunks))


def _describe_unreadable(path: Path) -> str:
    return f"{path} is not a readable ROS 2 bag (.mcap, .db3, or a folder with metadata.yaml)"


def _qos_values(profile: Qos) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in profile._asdict().items():
        if hasattr(value, "sec"):
            values[name] = {"sec": value.sec, "nsec": value.nsec}
        else:
            values[name] = value.name.lower() if hasattr(value, "name") else value
    return values


def _parse_qos(text: str) -> tuple[dict[str, Any], ...]:
    try:
        return tuple(dict(item) for item in YAML(typ="safe").load(text) or ())
    except (YAMLError, TypeError, ValueError):
        return ()
