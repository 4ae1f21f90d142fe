# SPDX-License-Identifier: Apache-2.0
"""Pose puppets on the images and video frames of a folder, in the browser; the page works without a network.

Every change is saved in FOLDER/annotations.json. "Find people" gives a first guess.
"""

from __future__ import annotations

import argparse
import socket
import sys
from pathlib import Path

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.extras import needing_extra
from flowing_puppet_ros.image.networks.sources import IMAGE_SIDE_PX, SOURCE_HELP, SOURCES

WILDCARDS = ("", "0.0.0.0", "::")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this verb."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="images and videos, also in folders below it")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; any but 127.0.0.1 admits the network [127.0.0.1]"
    )
    parser.add_argument("--port", type=int, default=8008, help="port to listen on, 0 for a free one [8008]")
    parser.add_argument("--source", default="auto", choices=SOURCES, help=SOURCE_HELP)
    parser.add_argument("--parts", type=int, default=10, choices=(10, 14), help="14 adds hands and feet [10]")


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until interrupted; InputError where the extra `annotate` is not installed."""
    with needing_extra("annotate", "annotate"):
        import waitress

        from flowing_puppet_ros.annotate.folder import ImageFolder
        from flowing_puppet_ros.annotate.server import MAX_REQUEST_BYTES, make_app
        from flowing_puppet_ros.annotate.store import AnnotationStore
        from flowing_puppet_ros.image.networks.choice import load_networks
        from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
    if arguments.host in WILDCARDS:
        raise InputError(f"--host {arguments.host} does not name a machine; give the address that the browser will use")
    folder = ImageFolder(arguments.folder)
    store = AnnotationStore(folder.root, JOINT_NAMES[arguments.parts])
    listening = _listen(arguments.host, arguments.port)
    port = listening.getsockname()[1]
    host = f"[{arguments.host}]" if ":" in arguments.host else arguments.host
    names = {host, "localhost"} if host in ("127.0.0.1", "[::1]") else {host}
    networks = load_networks(arguments.source, IMAGE_SIDE_PX, thorough=True)
    app = make_app(folder, store, arguments.parts, tuple(f"{name}:{port}" for name in sorted(names)), networks)
    print(f"{len(folder.items)} images; open http://{host}:{port}/ and stop with Ctrl+C", flush=True)
    try:
        waitress.serve(app, sockets=[listening], threads=4, max_request_body_size=MAX_REQUEST_BYTES, _quiet=True)
    finally:
        store.close()
    print("every change is saved in", store.path, file=sys.stderr)
    return 0


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listening = socket.socket(family, socket.SOCK_STREAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen()  # before the address is shown: a browser may be faster than the server's start
    except (OSError, OverflowError) as error:
        raise InputError(f"{host}:{port} cannot be listened on ({error}); choose another --port or --host") from error
    return listening
