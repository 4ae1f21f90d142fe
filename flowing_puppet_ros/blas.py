# SPDX-License-Identifier: Apache-2.0
"""One BLAS thread where sums must not depend on how many there are, and where other work needs the cores."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager[Any]:
    """A context in which numpy and scipy multiply matrices with one thread."""
    return _controller().limit(limits=1)


@cache
def _controller() -> ThreadpoolController:
    # To look for the libraries takes milliseconds; those of both packages must be loaded when it is done.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
