# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 of any layout."""

import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages.clouds import decode_cloud, make_cloud

FACTORY = BagMessageFactory()
DATATYPES = {"<f4": 7, "<f8": 8, ">f4": 7, ">f8": 8}


def cloud_message(points: Any, order: Any, names: Any, form: Any, gap: Any, height: Any, padding: Any) -> Any:
    """Build a cloud by hand: `names` in this order, `gap` bytes before each field, `padding` after each row."""
    step = sum(gap + np.dtype(form).itemsize for _ in names)
    width = len(points) // height
    data = bytearray()
    for row in range(height):
        for point in points[row * width : (row + 1) * width]:
            for name in names:
                data += b"\xab" * gap + np.array(point["xyz".find(name)], form).tobytes()
        data += b"\xcd" * padding
    offsets = [gap + k * (gap + np.dtype(form).itemsize) for k in range(len(names))]
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=DATATYPES[form], count=1)
        for name, offset in zip(names, offsets, strict=True)
    ]
    return SimpleNamespace(
        height=height,
        width=width,
        fields=fields,
        is_bigendian=order == ">",
        point_step=step,
        row_step=step * width + padding,
        data=array.array("B", bytes(data)),
        is_dense=False,
    )


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 12),
    st.sampled_from("<>"),
    st.permutations(["x", "y", "z", "intensity"]),
    st.sampled_from(["f4", "f8"]),
    st.integers(0, 5),
    st.integers(1, 3),
    st.integers(0, 9),
)
def test_every_layout_is_read(
    count: Any, order: Any, names: Any, size: Any, gap: Any, height: Any, padding: Any
) -> None:
    points = np.random.default_rng(count).normal(size=(count * height, 3)).astype(np.float32)
    points[::4, 1] = np.nan
    message = cloud_message(points, order, names, order + size, gap, height, padding)
    read, normals = decode_cloud(message)
    np.testing.assert_array_equal(read, points[np.isfinite(points).all(axis=1)])
    assert normals is None


def test_points_and_normals_come_back() -> None:
    rng = np.random.default_rng(1)
    points, normals = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    normals[3] = np.nan
    message = make_cloud(FACTORY, FACTORY.make("std_msgs/msg/Header"), points, normals)
    assert [field.name for field in message.fields] == ["x", "y", "z", "normal_x", "normal_y", "normal_z"]
    read, turned = decode_cloud(message)
    np.testing.assert_allclose(read, points, atol=1e-6)
    assert turned is not None
    np.testing.assert_allclose(turned, np.nan_to_num(normals), atol=1e-6)


def test_a_cloud_without_points_is_empty() -> None:
    read, _ = decode_cloud(make_cloud(FACTORY, FACTORY.make("std_msgs/msg/Header"), np.zeros((0, 3))))
    assert read.shape == (0, 3)


def test_what_is_no_cloud_is_refused() -> None:
    message = make_cloud(FACTORY, FACTORY.make("std_msgs/msg/Header"), np.ones((4, 3)))
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="4x1 points has point_step 12, row_step 48 and 47 bytes"):
        decode_cloud(message)
    message.fields = message.fields[:2]
    with pytest.raises(InputError, match="fields x, y has no z"):
        decode_cloud(message)


def test_points_that_no_sensor_reaches_are_left_out_wherever_the_frame_is() -> None:
    person = np.random.default_rng(0).normal((2000, 5000, 3), 0.5, (200, 3))
    far = np.array([[1e30, 0, 0], [2000, -1e9, 3], [1e10, 1e10, 1e10]])
    message = make_cloud(FACTORY, FACTORY.make("std_msgs/msg/Header"), np.vstack([far, person]), np.ones((203, 3)))
    points, normals = decode_cloud(message)
    np.testing.assert_allclose(points, person, atol=1e-3)
    assert normals is not None and normals.shape == (200, 3)


def test_points_in_millimetres_are_refused_in_a_sentence() -> None:
    half = np.random.default_rng(0).uniform(3000, 8000, (50, 3))
    points = np.concatenate([half, -half])  # around the sensor, whose median is none of them
    with pytest.raises(InputError, match="should be in metres"):
        decode_cloud(make_cloud(FACTORY, FACTORY.make("std_msgs/msg/Header"), points))
