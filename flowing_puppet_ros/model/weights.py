# SPDX-License-Identifier: Apache-2.0
"""The learned models that ship with the package: weights/<kind>_<name>.npz, each with a model card beside it."""

from __future__ import annotations

from importlib import resources
from typing import Any, Literal

import numpy as np

from flowing_puppet_ros.errors import InputError

Kind = Literal["sp", "ds", "likelihood", "detector", "hands", "people"]
FOLDER = "weights"


def available(kind: Kind) -> tuple[str, ...]:
    """List the names of the shipped models of one kind, sorted, for example ("female", "male", "neutral")."""
    folder = resources.files("flowing_puppet_ros") / FOLDER
    if not folder.is_dir():
        return ()
    names = (entry.name for entry in folder.iterdir())
    prefix, suffix = f"{kind}_", ".npz"
    return tuple(sorted(n[len(prefix) : -len(suffix)] for n in names if n.startswith(prefix) and n.endswith(suffix)))


def load(kind: Kind, name: str) -> dict[str, np.ndarray[Any, Any]]:
    """Load the arrays of the shipped model `name` of `kind`; InputError, with the known names, if there is none."""
    known = available(kind)
    if name not in known:
        have = ", ".join(known) or "none (learn one with `flowing-puppet learn`)"
        raise InputError(f"there is no {kind} model called {name!r}; installed are {have}")
    path = resources.files("flowing_puppet_ros") / FOLDER / f"{kind}_{name}.npz"
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}
