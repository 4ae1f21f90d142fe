# SPDX-License-Identifier: Apache-2.0
"""Packages that only some verbs need: each comes with an extra, and is imported when it is used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from flowing_puppet_ros.errors import InputError

EXTRAS = {
    "annotate": "the page of `annotate`",
    "cluster": "batches on a Dask cluster",
    "learn": "`learn`, and bodies to measure with",
    "neural": "the keypoint networks",
    "report": "the plots of `evaluate`",
    "rerun": "recordings for Rerun",
    "scans": "scans and depth images of synthetic people",
    "video": "H.264, H.265 and other video in bags",
}
"""The extras, each with what needs it; `requirements/<extra>.txt` lists its packages."""


def import_extra(module: str, extra: str, user: str) -> Any:
    """Import a module that an extra brings.

    Args:
        module: dotted name of the module.
        extra: one of EXTRAS.
        user: what needs it, as the sentence begins: a verb, a flag, a kind of file.

    Raises:
        InputError: when it is not installed; the sentence has the command that installs it.
    """
    with needing_extra(extra, user):
        return import_module(module)


@contextmanager
def needing_extra(extra: str, user: str) -> Iterator[None]:
    """Tell an import that fails inside the context as an InputError with the command that installs the extra."""
    try:
        yield
    except ImportError as error:
        package = (error.name or str(error)).partition(".")[0]
        raise InputError(f"{user} needs {package}: pip install 'flowing_puppet_ros[{extra}]'") from error
