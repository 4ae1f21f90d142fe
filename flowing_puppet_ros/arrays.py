# SPDX-License-Identifier: Apache-2.0
"""Array types by element, one meaning each; shapes stand in the docstrings of what takes and returns them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

type Array = np.ndarray[Any, Any]
"""Numbers of any type."""
type F32 = NDArray[np.float32]
type F64 = NDArray[np.float64]
type I8 = NDArray[np.int8]
type I32 = NDArray[np.int32]
type I64 = NDArray[np.int64]
type U8 = NDArray[np.uint8]
type U16 = NDArray[np.uint16]
type Bools = NDArray[np.bool_]
type Image = NDArray[np.uint8]
"""Pixels (H, W, 3) RGB or (H, W) grey, 0 to 255."""
type Flow = NDArray[np.float32]
"""Motion (H, W, 2) of each pixel to another image, x then y, pixels; NaN where unknown."""
