# SPDX-License-Identifier: Apache-2.0
"""Compressed images that are packets of a video stream (H.264, H.265, VP9, AV1), decoded in their order.

Needs the package av (PyAV), which is imported only here: pip install 'flowing_puppet_ros[video]'. Without it the
packets stay as they are, and whoever decodes one says what is missing.
"""

from __future__ import annotations

import re
from typing import Any

import cv2
from rosbags.typesys.store import Typestore

from flowing_puppet_ros.stream.messages.images import find_video_codec
from flowing_puppet_ros.stream.messages.message_types import COMPRESSED_IMAGE, MessageFactory, message_bytes

_MAY_BE_VIDEO = re.compile(rb"26[45]|hevc|avc|vp[89]|av1|mpeg", re.IGNORECASE).search
_HEAD_BYTES = 512
"""Bytes of a message that contain the format of any image: behind the stamp and the name of the frame."""


class _Stream:
    """The decoder of one topic, and the headers of the packets whose images have not come yet."""

    def __init__(self, codec: str) -> None:
        import av

        self._context: Any = av.CodecContext.create(codec, "r")
        # Decoding several frames at a time delays them.
        self._context.thread_count = 1
        self._make_packet: Any = av.Packet
        self._error = av.error.FFmpegError
        self._headers: dict[int, Any] = {}
        self._count = 0

    def decode(self, header: Any, data: Any) -> list[tuple[Any, Any]] | None:
        """Return the (header, BGR image) that are now complete; None if the packet cannot be decoded."""
        packet = self._make_packet(data.tobytes())
        packet.pts = packet.dts = self._count
        self._headers[self._count] = header
        self._count += 1
        try:
            return self._collect(self._context.decode(packet))
        except self._error:
            del self._headers[packet.pts]
            return None

    def flush(self) -> list[tuple[Any, Any]]:
        """Return the images that have waited for later ones."""
        try:
            return self._collect(self._context.decode(None))
        except self._error:
            return []

    def _collect(self, frames: Any) -> list[tuple[Any, Any]]:
        found = [(self._headers.pop(frame.pts, None), frame.to_ndarray(format="bgr24")) for frame in frames]
        return [(header, image) for header, image in found if header is not None]


class VideoImages:
    """Turns packets of video into CompressedImage messages that stand alone: lossless, with the packets' headers."""

    def __init__(self, store: Typestore, factory: MessageFactory) -> None:
        """Read and write messages with these."""
        self._store = store
        self._factory = factory
        self._streams: dict[str, _Stream] = {}

    def decode(self, topic: str, raw: bytes) -> list[bytes]:
        """Return the images that follow from the next CompressedImage of a topic: itself if it is no video.

        A packet that cannot be decoded is returned as it is.
        """
        if not _MAY_BE_VIDEO(raw, 0, _HEAD_BYTES):  # cheaper than to read the message
            return [raw]
        try:
            message: Any = self._store.deserialize_cdr(raw, COMPRESSED_IMAGE)
            codec = find_video_codec(message.format)
            if not codec:
                return [raw]
            stream = self._streams.get(topic) or self._streams.setdefault(topic, _Stream(codec))
        except Exception:  # no such message, no decoder, or no PyAV: said where the image is used
            return [raw]
        found = stream.decode(message.header, message_bytes(message.data))
        return [raw] if found is None else [self._write(*one) for one in found]

    def flush(self) -> list[tuple[str, bytes]]:
        """Return (topic, image) of what has waited for later packets."""
        return [(topic, self._write(*one)) for topic, stream in self._streams.items() for one in stream.flush()]

    def _write(self, header: Any, image: Any) -> bytes:
        _, data = cv2.imencode(".bmp", image)
        message = self._factory.make(COMPRESSED_IMAGE, header=header, format="bmp", data=data.reshape(-1))
        return bytes(self._store.serialize_cdr(message, COMPRESSED_IMAGE))
