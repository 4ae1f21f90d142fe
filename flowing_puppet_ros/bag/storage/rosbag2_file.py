# SPDX-License-Identifier: Apache-2.0
"""One file of a rosbag2 bag read by its index: an MCAP file or an SQLite database."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.interfaces import MessageDefinitionFormat, Qos
from rosbags.rosbag2 import Reader

from flowing_puppet_ros.bag.storage.stored_file import StoredTopic
from flowing_puppet_ros.errors import InputError

_SCHEMA_ENCODINGS = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}


class NoIndexError(Exception):
    """Raised when the index does not cover every message."""


class Rosbag2File:
    """An MCAP file (`suffix` .mcap) or a database (.db3) that is read by its index, whatever its name."""

    def __init__(self, path: Path, suffix: str) -> None:
        """Open it; InputError if it cannot be read, NoIndexError if only a scan finds every message in order."""
        self.path = path
        self.notes: list[str] = []
        self._is_database = suffix == ".db3"
        # The database is opened by its URI, in which some characters have a meaning.
        self._storage = Reader.STORAGE_PLUGINS[suffix](Path(quote(str(path))) if self._is_database else path)
        try:
            self._storage.open()
        except Exception as error:  # a damaged file makes the libraries raise anything
            raise self._describe(error) from error
        if not (self._is_database or _is_indexed(self._storage)):
            self._storage.close()
            raise NoIndexError
        self._connections = list(self._storage.connections)
        self.topics = [_describe_topic(connection) for connection in self._connections]

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time, bytes) of some topics' messages in log order."""
        indices = {self._connections[index].id: index for index in chosen}
        if not indices:
            return
        try:
            connections = [self._connections[index] for index in chosen]
            for connection, log_time, raw in self._storage.messages(connections, None, None):
                yield indices[connection.id], log_time, raw
        except Exception as error:  # as above; errors of the caller between two messages do not arrive here
            raise self._describe(error) from error

    def close(self) -> None:
        """Close the file."""
        self._storage.close()

    def _describe(self, error: Exception) -> InputError:
        reason = (str(error).rstrip(".").splitlines() or [""])[0] or type(error).__name__
        if "missing tables" in reason:
            return InputError(f"{self.path} is not a readable ROS 2 bag: it is a database without messages and topics")
        if self._is_database:
            rescue = f'sqlite3 "{self.path}" .recover | sqlite3 rescued.db3'
            return InputError(f"{self.path} is damaged: {reason}; `{rescue}` writes what is whole into another file")
        return InputError(f"{self.path} is damaged: {reason}; add --salvage to read the rest")


def find_leftovers(path: Path) -> list[Path]:
    """Return what SQLite has left beside a database that was not closed: its write-ahead log or its journal."""
    beside = (path.with_name(path.name + ending) for ending in ("-wal", "-journal"))
    return [file for file in beside if file.is_file() and file.stat().st_size]


def merge_leftovers(path: Path, target: Path) -> None:
    """Copy a database to `target` with what is in its write-ahead log, or without what its journal takes back.

    Only a copy can be completed: recordings are never written to. Errors of the disk are raised.
    """
    shutil.copyfile(path, target)
    for file in find_leftovers(path):
        shutil.copyfile(file, target.with_name(target.name + file.name.removeprefix(path.name)))
    try:
        with closing(sqlite3.connect(target)) as database:
            database.execute("pragma wal_checkpoint(truncate)").fetchall()
            database.execute("pragma journal_mode=delete").fetchall()
    except sqlite3.Error as error:
        raise InputError(f"{path} cannot be read together with what is beside it: {error}") from error


def _is_indexed(storage: Any) -> bool:
    """Return whether the chunks of an MCAP file are all indexed."""
    return bool(storage.chunks) and all(chunk.channel_count for chunk in storage.chunks)


def _describe_topic(connection: Any) -> StoredTopic:
    definition = connection.msgdef
    return StoredTopic(
        connection.topic,
        connection.msgtype,
        connection.ext.serialization_format,
        _SCHEMA_ENCODINGS.get(definition.format, ""),
        str(definition.data).encode(),
        connection.msgcount,
        tuple(_qos_values(profile) for profile in connection.ext.offered_qos_profiles),
    )


def _qos_values(profile: Qos) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in profile._asdict().items():
        if hasattr(value, "sec"):
            values[name] = {"sec": value.sec, "nsec": value.nsec}
        else:
            values[name] = value.name.lower() if hasattr(value, "name") else value
    return values
