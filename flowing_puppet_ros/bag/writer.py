# SPDX-License-Identifier: Apache-2.0
"""Write MCAP bags as rosbag2 of ROS 2 Jazzy does: a single `.mcap` file or a folder with `metadata.yaml`."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.writer import CompressionType, Writer
from ruamel.yaml import YAML

from flowing_puppet_ros.bag.typestore import typestore
from flowing_puppet_ros.errors import InputError

_METADATA_VERSION = 9  # of the rosbag2 metadata that Jazzy writes
_CHUNK_BYTES = 1024 * 1024  # of messages per compressed chunk
_INFINITE_DURATION = {"sec": 9223372036, "nsec": 854775807}  # of rmw
_QUEUE_DEPTH = {"latched": 1, "sensor": 5, "reliable": 10}


def qos_profile(kind: str) -> dict[str, Any]:
    """Return one entry of `offered_qos_profiles` for "sensor", "reliable" or "latched" (transient local)."""
    return {
        "history": "keep_last",
        "depth": _QUEUE_DEPTH[kind],
        "reliability": "best_effort" if kind == "sensor" else "reliable",
        "durability": "transient_local" if kind == "latched" else "volatile",
        "deadline": dict(_INFINITE_DURATION),
        "lifespan": dict(_INFINITE_DURATION),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_INFINITE_DURATION),
        "avoid_ros_namespace_conventions": False,
    }


class BagWriter:
    """A bag being written: profile ros2, zstd chunks, CDR messages, ros2msg schemas, statistics and index.

    The bytes depend only on the messages: writing the same messages again gives the same file. The file has a
    temporary name until it is complete.
    """

    def __init__(self, path: Path) -> None:
        """Open `path`: one file if it ends in .mcap, otherwise a folder, which must be empty."""
        self.path = path
        self._folder: Path | None = None if path.suffix == ".mcap" else path
        target = path
        try:
            if self._folder is not None:
                self._folder.mkdir(parents=True, exist_ok=True)
                if any(self._folder.iterdir()):
                    raise InputError(f"the folder {path} is not empty: name a new one for the bag")
                target = self._folder / f"{path.name}_0.mcap"
            else:
                path.parent.mkdir(parents=True, exist_ok=True)
            if target.is_dir():
                raise InputError(f"cannot write the bag {target}: it is a folder")
            self._partial = target.with_name(target.name + ".partial")
            self._stream: BinaryIO = self._partial.open("wb")
        except OSError as error:
            raise InputError(f"cannot write the bag {path}: {error.strerror}") from error
        self._target = target
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="flowing_puppet_ros")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._topics: dict[str, dict[str, Any]] = {}
        self._counts: dict[str, int] = {}
        self._first: int | None = None
        self._last = 0

    def add_topic(self, topic: str, type_name: str, qos: str | Sequence[dict[str, Any]] = "reliable") -> None:
        """Add a topic: its type and its QoS, as a kind or as the profiles that were offered."""
        profiles = [qos_profile(qos)] if isinstance(qos, str) else list(qos)
        store = typestore()
        if type_name not in self._schemas:
            text, _ = store.generate_msgdef(type_name, ros_version=2)
            self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
        digest = store.hash_rihs01(type_name)
        self._channels[topic] = self._writer.register_channel(
            topic,
            "cdr",
            self._schemas[type_name],
            {
                "offered_qos_profiles": _profiles_to_yaml(json.dumps(profiles)) if profiles else "",
                "topic_type_hash": digest,
            },
        )
        self._topics[topic] = {
            "name": topic,
            "type": type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": profiles,
            "type_description_hash": digest,
        }
        self._counts[topic] = 0

    def has_topic(self, topic: str) -> bool:
        """Return whether `topic` was added."""
        return topic in self._topics

    def write(self, topic: str, log_time: int, message: Any) -> None:
        """Append one message of an added topic, recorded at `log_time` nanoseconds."""
        self.write_raw(topic, log_time, bytes(typestore().serialize_cdr(message, self._topics[topic]["type"])))

    def write_raw(self, topic: str, log_time: int, data: bytes) -> None:
        """Append one serialised message."""
        count = self._counts[topic]
        self._writer.add_message(self._channels[topic], log_time, data, log_time, count)
        self._counts[topic] = count + 1
        self._first = log_time if self._first is None else min(self._first, log_time)
        self._last = max(self._last, log_time)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Store texts by name in the file's metadata, which says how the bag was made."""
        self._writer.add_metadata(name, dict(values))

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages written per topic."""
        return dict(self._counts)

    def close(self) -> None:
        """Write what rosbag2 reads first: the metadata record, the index, and `metadata.yaml` of a folder."""
        metadata = self._metadata()
        self._writer.add_metadata("rosbag2", {"serialized_metadata": _to_yaml(metadata)})
        self._writer.finish()
        self._stream.close()
        self._partial.replace(self._target)
        if self._folder is not None:
            text = _to_yaml({"rosbag2_bagfile_information": metadata})
            (self._folder / "metadata.yaml").write_text(text, "utf8")

    def _metadata(self) -> dict[str, Any]:
        start = self._first or 0
        span = {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": self._last - start if self._first is not None else 0},
            "message_count": sum(self._counts.values()),
        }
        return {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._target.name],
            **span,
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": self._counts[name]} for name, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._target.name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._stream.close()
            self._partial.unlink()


@cache
def _profiles_to_yaml(profiles: str) -> str:
    """Return QoS profiles, given as JSON, as YAML: most topics have the same."""
    return _to_yaml(json.loads(profiles))


def _to_yaml(value: Any) -> str:
    yaml = YAML()
    yaml.default_flow_style = False
    yaml.representer.ignore_aliases = lambda *_: True
    yaml.width = 1 << 16
    stream = io.StringIO()
    yaml.dump(value, stream)
    return stream.getvalue()
