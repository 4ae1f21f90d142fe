# SPDX-License-Identifier: Apache-2.0
"""Whatever a message says of itself, a decoder gives an array of sane values or one sentence, and never crashes."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.stream.messages import images
from flowing_puppet_ros.stream.messages.clouds import decode_cloud

ENCODINGS = [*sorted(images._RAW), "16UC1", "32FC1", "32FC2", "64FC1", "nv12", "", "rgb8 ", "\u00e9"]
sizes = st.one_of(st.integers(0, 9), st.sampled_from([2**16, 2**31, 2**32 - 1]))
data = st.binary(max_size=300)


def outcome(decode: Any, message: Any) -> Any:
    """Return what a decoder gives; None when it refuses in one sentence."""
    try:
        return decode(message)
    except InputError as error:
        assert str(error) and "\n" not in str(error)
        return None


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(ENCODINGS), sizes, sizes, sizes, st.integers(0, 255), data)
def test_raw_images(encoding: str, height: int, width: int, step: int, big: int, content: bytes) -> None:
    message = SimpleNamespace(
        encoding=encoding,
        height=height,
        width=width,
        step=step,
        is_bigendian=big,
        data=np.frombuffer(content, np.uint8),
    )
    rgb = outcome(images.decode_image, message)
    assert rgb is None or (rgb.shape == (height, width, 3) and rgb.dtype == np.uint8)
    flow = outcome(images.decode_flow, message)
    assert flow is None or (flow.shape == (height, width, 2) and flow.dtype == np.float32)
    labels = outcome(images.decode_labels, message)
    assert labels is None or labels.shape == (height, width)
    depth = outcome(images.decode_depth, message)
    assert depth is None or (depth.shape == (height, width) and not (depth <= 0).any() and not np.isinf(depth).any())


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(["jpeg", "png", "rgb8; jpeg compressed bgr8", "16UC1; compressedDepth", "", "tiff"]), data,
       st.sampled_from(["", ".jpg", ".png", ".bmp", ".webp"]), st.integers(0, 60), st.integers(0, 255))  # fmt: skip
def test_compressed_images(form: str, content: bytes, kind: str, place: int, value: int) -> None:
    if kind:
        picture = np.random.default_rng(len(content)).integers(0, 255, (5, 7, 3)).astype(np.uint8)
        spoilt = cv2.imencode(kind, picture)[1].reshape(-1).copy()
        spoilt[min(place, len(spoilt) - 1)] = value
        content = spoilt.tobytes()[: len(spoilt) - len(content) // 10]
    rgb = outcome(images.decode_image, SimpleNamespace(format=form, data=np.frombuffer(content, np.uint8)))
    assert rgb is None or (rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype == np.uint8)


fields = st.lists(
    st.builds(
        SimpleNamespace,
        name=st.sampled_from(["x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb", ""]),
        offset=st.one_of(st.integers(0, 20), st.just(2**32 - 1)),
        datatype=st.integers(0, 10),
        count=st.integers(0, 3),
    ),
    max_size=8,
)


@pytest.mark.slow
@settings(max_examples=400, deadline=None)
@given(fields, sizes, sizes, st.integers(0, 40), sizes, st.booleans(), data, st.booleans())
def test_point_clouds(
    named: list[Any], height: int, width: int, step: int, row: int, big: bool, content: bytes, dense: bool
) -> None:
    message = SimpleNamespace(
        fields=named, height=height, width=width, point_step=step, row_step=row, is_bigendian=big, is_dense=dense,
        data=np.frombuffer(content, np.uint8),
    )  # fmt: skip
    found = outcome(decode_cloud, message)
    if found is not None:
        points, normals = found
        assert points.ndim == 2 and points.shape[1] == 3 and np.isfinite(points).all()
        assert normals is None or (normals.shape == points.shape and np.isfinite(normals).all())


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, -np.inf])
def test_depth_of_no_number_is_unknown(spoilt: float) -> None:
    pixels = np.array([[spoilt, 1.0]], "<f4")
    message = SimpleNamespace(
        encoding="32FC1", height=1, width=2, step=8, is_bigendian=0, data=pixels.view(np.uint8).reshape(-1)
    )
    np.testing.assert_array_equal(images.decode_depth(message), [[np.nan, 1.0]])
