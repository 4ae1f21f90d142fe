# SPDX-License-Identifier: Apache-2.0
"""Who finds people: the keypoint networks where they are installed, or the package's own detector."""

from __future__ import annotations

import importlib.util
from functools import cache

from flowing_puppet_ros.image.networks.files import FILES, REMEDY, find_file
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointNetworks, KeypointSource

SOURCES = ("auto", "neural", "own")
SOURCE_HELP = (
    "who finds people: neural, keypoint networks; own, the package's detector; auto, the networks if installed [auto]"
)
NOT_INSTALLED = (
    "keypoint networks are not installed, people are found by the package's own detector, which knows upper bodies"
    f" from the front only: {REMEDY}"
)


def are_installed() -> bool:
    """Return whether the networks and what runs them are installed."""
    return importlib.util.find_spec("ai_edge_litert") is not None and all(find_file(file) for file in FILES)


def load_networks(source: str = "auto", side: int = 256, thorough: bool = False) -> KeypointSource | None:
    """Load the networks that a source names; None where the own detector is to be used.

    Raises:
        InputError: when the source is `neural` and they are not installed.
    """
    if source == "own" or (source == "auto" and not are_installed()):
        return None
    return _load(side, thorough)


@cache
def _load(side: int, thorough: bool) -> KeypointSource:
    """Load the networks once for all trackers of a process."""
    return KeypointNetworks.load(side, thorough)
