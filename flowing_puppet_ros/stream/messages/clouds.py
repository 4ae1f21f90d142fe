# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 of any field layout, byte order and padding to and from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowing_puppet_ros.arrays import F64, I64, Array, Bools
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.message_types import MessageFactory, message_bytes

# sensor_msgs/PointField datatype -> numpy
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FLOAT32 = 7  # of sensor_msgs/PointField
_MAX_DISTANCE_M = 1000.0
"""Maximum distance from the median point; no sensor for people reaches further, and drivers mark unknown points so."""
_NORMALS = ("normal_x", "normal_y", "normal_z")


def decode_cloud(message: Any) -> tuple[F64, F64 | None]:
    """Return points and normals as `decode_pixels` does, without their places in the cloud."""
    return decode_pixels(message)[:2]


def decode_pixels(message: Any) -> tuple[F64, F64 | None, I64]:
    """Return the finite points (N, 3) in metres, their normals (N, 3) if any, and their places (N,) in the cloud.

    An organised cloud is flattened, row after row. Points with a NaN, infinite or absurd coordinate are left out,
    whatever `is_dense` says; a normal that is not finite becomes zero. InputError if there are no x, y, z fields or the
    data does not fit the sizes in the message.
    """
    types = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in types]
    if missing:
        raise InputError(f"a point cloud with the fields {', '.join(types) or 'none'} has no {missing[0]}")
    records = _read_records(message, types)
    points = np.stack([records[name].astype(float) for name in "xyz"], axis=1)
    # Column by column: NumPy takes several times longer for rows of three.
    good = _are_all(np.isfinite(points))
    if good.any():
        known = points if good.all() else points[good]
        # The median takes long, and is needed only where some points may be too far from it.
        if np.abs(known).max() >= _MAX_DISTANCE_M / 2:
            good[good] = _are_all(np.abs(known - np.median(known, axis=0)) < _MAX_DISTANCE_M)
            if not good.any():
                raise InputError(
                    f"the {len(known)} points of the cloud lie {_MAX_DISTANCE_M:g} m and more apart: they should be in"
                    " metres"
                )
    places = np.flatnonzero(good)
    if not all(name in types for name in _NORMALS):
        return points[good], None, places
    normals = np.stack([records[name].astype(float) for name in _NORMALS], axis=1)[good]
    return points[good], np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0), places


def _are_all(flags: Bools) -> Bools:
    """Return whether all three of each row (N, 3) are true."""
    return np.asarray(flags[:, 0] & flags[:, 1] & flags[:, 2])


def _read_records(message: Any, fields: dict[str, Any]) -> Array:
    """View the cloud as a flat structured array of the fields that are read."""
    order = ">" if message.is_bigendian else "<"
    known = {name: field for name, field in fields.items() if name in ("x", "y", "z", *_NORMALS)}
    for name, field in known.items():
        if field.datatype not in _TYPES:
            raise InputError(f"the cloud field {name} has the unknown datatype {field.datatype}")
    width, height, step, row = (int(message.width), int(message.height), int(message.point_step), int(message.row_step))
    formats = [order + _TYPES[field.datatype] for field in known.values()]
    offsets = [int(field.offset) for field in known.values()]
    ends = [offset + np.dtype(form).itemsize for offset, form in zip(offsets, formats, strict=True)]
    data = message_bytes(message.data)
    row = row if height > 1 else width * step
    if step < max(ends) or row < width * step or len(data) < row * (height - 1) + width * step:
        raise InputError(
            f"a cloud of {width}x{height} points has point_step {step}, row_step {row} and {len(data)} bytes"
        )
    record = np.dtype({"names": list(known), "formats": formats, "offsets": offsets, "itemsize": step})
    if width * height == 0:
        return np.empty(0, record)
    rows = np.lib.stride_tricks.as_strided(data, (height, width * step), (row, 1), writeable=False)
    return np.ascontiguousarray(rows).reshape(-1).view(record)


def make_cloud(factory: MessageFactory, header: Any, points: Array, normals: Array | None = None) -> Any:
    """Return a float32 PointCloud2 of `points` (N, 3) in metres and their `normals` (N, 3).

    Points (H, W, 3) make an organised cloud, with NaN where nothing is known.
    """
    height = points.shape[0] if points.ndim == 3 else 1
    columns = [np.asarray(points, np.float32).reshape(-1, 3)]
    names = ["x", "y", "z"]
    if normals is not None:
        columns.append(np.asarray(normals, np.float32).reshape(-1, 3))
        names += _NORMALS
    table = np.ascontiguousarray(np.hstack(columns), "<f4")
    fields = [
        factory.make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=_FLOAT32, count=1)
        for k, name in enumerate(names)
    ]
    return factory.make(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=height,
        width=len(table) // height,
        fields=fields,
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=4 * len(names) * (len(table) // height),
        data=table.reshape(-1).view(np.uint8),
        is_dense=height == 1,
    )
