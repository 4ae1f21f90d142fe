# SPDX-License-Identifier: Apache-2.0
"""Who finds people: the keypoint networks where they are installed, or the package's own detector."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path

from flowing_puppet_ros.image.networks.files import FILES, find_file
from flowing_puppet_ros.image.networks.keypoint_networks import KeypointNetworks, KeypointSource
from flowing_puppet_ros.image.networks.user_network import UserNetwork


def are_installed() -> bool:
    """Return whether the networks and what runs them are installed."""
    return importlib.util.find_spec("ai_edge_litert") is not None and all(find_file(file) for file in FILES)


def load_networks(
    source: str = "auto", side: int = 256, thorough: bool = False, description: str = ""
) -> KeypointSource | None:
    """Load the networks that a source names; None where the own detector is to be used.

    Args:
        source: one of SOURCES.
        side: longer side px to which the whole image is reduced.
        thorough: see `KeypointNetworks`.
        description: path of the description file of the user's own network, which then takes the place of ours.

    Raises:
        InputError: when the source is `neural` and they are not installed, or the user's network cannot be used.
    """
    if description and source != "own":
        finder = _load(side, thorough) if are_installed() else None
        return UserNetwork.load(Path(description), finder)
    if source == "own" or (source == "auto" and not are_installed()):
        return None
    return _load(side, thorough)


@cache
def _load(side: int, thorough: bool) -> KeypointSource:
    """Load the networks once for all trackers of a process."""
    return KeypointNetworks.load(side, thorough)
