# SPDX-License-Identifier: Apache-2.0
"""Open one file of a recording by what is in it, not by its name."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

from flowing_puppet_ros.bag.storage import mcap_file, rosbag1_file
from flowing_puppet_ros.bag.storage.compression import find_compression, unpack_file
from flowing_puppet_ros.bag.storage.mcap_file import McapFile, is_truncated
from flowing_puppet_ros.bag.storage.rosbag1_file import Rosbag1File, ScannedRosbag1File
from flowing_puppet_ros.bag.storage.rosbag2_file import NoIndexError, Rosbag2File, find_leftovers, merge_leftovers
from flowing_puppet_ros.bag.storage.stored_file import StoredFile
from flowing_puppet_ros.errors import InputError

_DATABASE_MAGIC = b"SQLite format 3\0"
_ARCHIVES = {b"PK\x03\x04": "zip", b"7z\xbc\xaf": "7z", b"Rar!": "rar"}
_HEAD_BYTES = 512


def open_file(path: Path, salvage: bool) -> StoredFile:
    """Open an MCAP file, a database of rosbag2 or a ROS 1 bag, also if it is compressed or has another name.

    InputError if it is none of them, or if it is cut off or damaged and `salvage` does not read what is whole.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head.startswith(mcap_file.MAGIC):
        return _open_mcap(path, salvage)
    if head.startswith(_DATABASE_MAGIC):
        return _RecoveredFile(path, salvage) if find_leftovers(path) else Rosbag2File(path, ".db3")
    if head.startswith(rosbag1_file.MAGIC):
        return ScannedRosbag1File(path) if salvage else Rosbag1File(path)
    if compression := find_compression(head):
        return _UnpackedFile(path, compression, salvage)
    raise InputError(_describe_unreadable(path, head))


def is_packed_archive(head: bytes) -> str:
    """Return the kind of archive of several files that starts with these bytes; empty if it is none."""
    if head[257:262] == b"ustar":
        return "tar"
    return next((kind for magic, kind in _ARCHIVES.items() if head.startswith(magic)), "")


def _open_mcap(path: Path, salvage: bool) -> StoredFile:
    if is_truncated(path) and not salvage:
        raise InputError(f"{path} is cut off before its end: add --salvage to read what is whole")
    if salvage:
        scanned = McapFile(path, salvage)
        if not sum(topic.count for topic in scanned.topics) and is_truncated(path):
            raise InputError(f"{path} is cut off so early that it has no whole message")
        return scanned
    try:
        return Rosbag2File(path, ".mcap")
    except (InputError, NoIndexError):  # of another profile, with other schemas, without an index
        return McapFile(path)


class _CopiedFile:
    """A file that is read from a copy of its content in a temporary folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = tempfile.TemporaryDirectory(prefix="flowing_puppet_")
        self._copy = Path(self._folder.name) / path.name
        self._file: StoredFile | None = None

    def _open_copy(self, salvage: bool) -> None:
        try:
            self._file = open_file(self._copy, salvage)
        except InputError as error:
            self._folder.cleanup()
            raise self._with_own_name(error) from error
        except BaseException:
            self._folder.cleanup()
            raise
        self.topics = self._file.topics
        self.notes = [note.replace(str(self._copy), str(self._path)) for note in self._file.notes]

    def _with_own_name(self, error: InputError) -> InputError:
        return InputError(str(error).replace(str(self._copy), str(self._path)))

    def messages(self, chosen: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index in `topics`, log time, bytes) of some topics' messages in log order."""
        assert self._file is not None
        try:
            yield from self._file.messages(chosen)
        except InputError as error:
            raise self._with_own_name(error) from error

    def close(self) -> None:
        """Close and delete the copy."""
        if self._file is not None:
            self._file.close()
        self._folder.cleanup()


class _UnpackedFile(_CopiedFile):
    """A compressed file."""

    def __init__(self, path: Path, compression: str, salvage: bool) -> None:
        super().__init__(path)
        try:
            whole = unpack_file(path, compression, self._copy)
        except OSError:
            self._folder.cleanup()
            raise
        if not whole and not salvage:
            self._folder.cleanup()
            raise InputError(
                f"{path} is cut off or damaged, its {compression} data ends too early: add --salvage to read what is "
                "whole"
            )
        self._open_copy(salvage)


class _RecoveredFile(_CopiedFile):
    """A database that its recorder did not close."""

    def __init__(self, path: Path, salvage: bool) -> None:
        super().__init__(path)
        try:
            merge_leftovers(path, self._copy)
        except BaseException:
            self._folder.cleanup()
            raise
        self._open_copy(salvage)
        names = " and ".join(file.name for file in find_leftovers(path))
        self.notes.append(f"{path} was not closed by its recorder: it is read together with {names}")


def _describe_unreadable(path: Path, head: bytes) -> str:
    if archive := is_packed_archive(head):
        return f"{path} is a {archive} archive, which is not a readable ROS 2 bag: unpack it and give what is in it"
    if head.startswith(b"#ROSBAG V1"):
        return f"{path} is a bag of the old format 1: `rosbag fix` of ROS 1 writes it anew"
    why = "a bag is an .mcap, .db3 or .bag file, or a folder with metadata.yaml" if head else "the file is empty"
    return f"{path} is not a readable ROS 2 bag, nor one of ROS 1: {why}"
