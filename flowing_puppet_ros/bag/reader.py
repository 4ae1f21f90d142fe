# SPDX-License-Identifier: Apache-2.0
"""Read rosbag2 bags in log order: a lone `.mcap` or `.db3`, a folder with `metadata.yaml`, or a truncated `.mcap`."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from rosbags.interfaces import Qos
from rosbags.rosbag2 import Reader
from rosbags.serde import SerdeError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.bag.salvage import is_truncated, salvaged_records
from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One recorded message: its topic, type, time of recording (nanoseconds) and CDR bytes."""

    topic: str
    type: str
    log_time: int
    raw: bytes

    @property
    def message(self) -> Any:
        """The message object; InputError when the bytes are not a message of the type."""
        try:
            return typestore().deserialize_cdr(self.raw, self.type)
        except (SerdeError, KeyError, IndexError) as error:
            raise InputError(f"a message on {self.topic} is not the {self.type} that it claims to be") from error


@dataclass(frozen=True, slots=True)
class Topic:
    """What a bag says about one topic."""

    type: str
    count: int
    qos: tuple[dict[str, Any], ...]


class Bag:
    """An open bag. Use as a context manager; messages are streamed, not held."""

    def __init__(self, path: Path, salvage: bool = False) -> None:
        """Open `path`; with `salvage` also an MCAP file whose end is missing."""
        self.path = path
        self._salvage = path.is_file() and path.suffix != ".db3" and is_truncated(path)
        if self._salvage and not salvage:
            raise InputError(f"{path} is cut off before its end: add --salvage to read what is whole")
        self._reader: Reader | None = None
        if self._salvage:
            self.details = self._scan()
            if not self.details:
                raise InputError(f"{path} is cut off so early that it has no whole message")
            return
        try:
            self._reader = Reader(path)
            self._reader.open()
        except Exception as error:  # a damaged file fails in the libraries in any way
            raise InputError(_no_bag(path)) from error
        self.details = {
            c.topic: Topic(c.msgtype, c.msgcount, tuple(_qos(q) for q in getattr(c.ext, "offered_qos_profiles", ())))
            for c in self._reader.connections
        }

    @property
    def topics(self) -> dict[str, str]:
        """Type of every topic by its name; `details` tells counts and QoS too."""
        return {name: topic.type for name, topic in self.details.items()}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Yield the messages of `topics` (all by default) in the order of their log times.

        A truncated file is read in the order of its bytes, which is the order of writing.
        """
        chosen = set(self.details if topics is None else topics)
        if self._reader is None:
            yield from self._salvaged(chosen)
            return
        connections = [c for c in self._reader.connections if c.topic in chosen]
        if not connections:
            return
        try:
            for connection, log_time, raw in self._reader.messages(connections):
                yield Record(connection.topic, connection.msgtype, log_time, bytes(raw))
        except Exception as error:  # as above; what the caller does between two messages never lands here
            raise InputError(f"{self.path} is damaged: {str(error).rstrip('.') or type(error).__name__}") from error

    def note(self, name: str) -> dict[str, str]:
        """The texts that `BagWriter.note` put into the file's metadata under this name; empty without any."""
        path = next(iter(sorted(self.path.glob("*.mcap"))), self.path) if self.path.is_dir() else self.path
        if path.suffix != ".mcap":
            return {}
        try:
            with path.open("rb") as stream:
                return next((m.metadata for m in make_reader(stream).iter_metadata() if m.name == name), {})
        except Exception:  # a damaged file fails in the library in any way; its messages may be whole
            return {}

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(topic.count for topic in self.details.values())

    def close(self) -> None:
        """Close the files."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _scan(self) -> dict[str, Topic]:
        counts: dict[str, int] = {}
        types: dict[str, tuple[str, tuple[dict[str, Any], ...]]] = {}
        for channel, name, _ in self._salvaged_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            types[channel.topic] = (name, _parse_qos(channel.metadata.get("offered_qos_profiles", "")))
        return {topic: Topic(name, counts[topic], qos) for topic, (name, qos) in types.items()}

    def _salvaged(self, chosen: set[str]) -> Iterator[Record]:
        for channel, name, message in self._salvaged_messages():
            if channel.topic in chosen:
                yield Record(channel.topic, name, message.log_time, message.data)

    def _salvaged_messages(self) -> Iterator[tuple[Channel, str, Message]]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self.path.open("rb") as stream:
            for record in salvaged_records(stream):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif record.channel_id in channels and channels[record.channel_id].schema_id in schemas:
                    channel = channels[record.channel_id]
                    yield channel, schemas[channel.schema_id].name, record

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_bag(path: Path | str, salvage: bool = False) -> Bag:
    """Open a bag for reading; InputError in one sentence when it is missing, no bag, or cut off."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no bag {path}")
    if path.is_dir():
        files = sorted(path.glob("*.mcap")) + sorted(path.glob("*.db3"))
        complete = (path / "metadata.yaml").exists()
        if not complete and len(files) != 1:
            raise InputError(f"the folder {path} is no bag: it has no metadata.yaml and {len(files)} bag files")
        # A recorder that was stopped by force leaves no metadata, or metadata of a file that is cut off.
        if len(files) == 1 and (not complete or is_truncated(files[0])):
            path = files[0]
    return Bag(path, salvage)


def is_bag(path: Path) -> bool:
    """Whether a file or folder looks like one bag: by its ending, its metadata, or the only bag file in it."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or len([*path.glob("*.mcap"), *path.glob("*.db3")]) == 1
    return path.suffix in (".mcap", ".db3")


def _no_bag(path: Path) -> str:
    return f"{path} is no ROS 2 bag that can be read (.mcap, .db3, or a folder with metadata.yaml)"


def _qos(profile: Qos) -> dict[str, Any]:
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
