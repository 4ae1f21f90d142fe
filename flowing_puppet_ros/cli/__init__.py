# SPDX-License-Identifier: Apache-2.0
"""The command line `flowing-puppet <verb>`: one module a verb, imported only when that verb is used.

Arguments come in; files, tables and an exit status go out. Read `fit` first: its neighbours are built alike.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

from flowing_puppet_ros import __version__
from flowing_puppet_ros.errors import InputError, PuppetError

VERBS = {
    "fit": "fit the 3D Stitched Puppet to meshes and clouds",
    "correspond": "map scan to scan through two fits",
    "pose": "find people's pose in single images",
    "track": "track people in a video, a frame folder or a bag with flowing puppets",
    "replay": "run the nodes' algorithms over a bag, losslessly and reproducibly",
    "report": "make the HTML report of a replayed bag",
    "annotate": "pose puppets on images in the browser",
    "learn": "learn the body models, the likelihood and the detector",
    "sample": "draw samples of the learned body models",
    "evaluate": "measure poses and bodies against the truth",
    "bench": "measure speed as ratios taken in one run",
}


ROOMS = ("evaluate", "sample")
"""Verbs of several kinds: each kind is a module of its own, in a folder."""


def verb_module(verb: str) -> ModuleType:
    """Import the module of a verb; InputError when it is not in what was installed."""
    if verb == "bench":
        return _benchmarks()
    return import_module(f"{__name__}.{verb}.verb" if verb in ROOMS else f"{__name__}.{verb}")


def _benchmarks() -> ModuleType:
    """Import the benchmarks, which stand beside the package in its source tree and are not installed."""
    source_tree = Path(__file__).resolve().parents[2]
    if not (source_tree / "benchmarks" / "verb.py").is_file():
        raise InputError(
            "bench compares with plain and foreign programs that are not installed; run it in a source tree"
        )
    if str(source_tree) not in sys.path:
        sys.path.append(str(source_tree))
    return import_module("benchmarks.verb")


def verb_with_parser(verb: str, arguments: list[str]) -> tuple[ModuleType, argparse.ArgumentParser, list[str]]:
    """Return the module of a verb, its parser, and what of its arguments is left to parse.

    A module may name in `SUBVERBS` the modules of optional sub-verbs: a first argument that is one leads there.
    """
    module, name = verb_module(verb), verb
    subverbs = getattr(module, "SUBVERBS", {})
    if arguments and arguments[0] in subverbs:
        name, arguments = f"{verb} {arguments[0]}", arguments[1:]
        module = import_module(subverbs[name.split()[1]])
    parser = argparse.ArgumentParser(prog=f"flowing-puppet {name}", description=module.__doc__)
    module.add_arguments(parser)
    return module, parser, arguments


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit status: 0 done, 1 the work failed, 2 unusable arguments or input."""
    parser = argparse.ArgumentParser(
        prog="flowing-puppet",
        description="People's pose and body shape from images, clouds and bags.",
        epilog="verbs:\n" + "\n".join(f"  {verb:<11} {text}" for verb, text in VERBS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("verb", choices=VERBS, metavar="VERB", help="what to do; VERB --help says more")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    chosen = parser.parse_args(argv)
    try:
        module, verb_parser, arguments = verb_with_parser(chosen.verb, chosen.arguments)
        return module.run(verb_parser.parse_args(arguments))
    except PuppetError as error:
        print(f"flowing-puppet {chosen.verb}: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print(f"flowing-puppet {chosen.verb}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 1
    except OSError as error:
        # A disk that is full or gone, which may happen wherever something is read or written.
        print(f"flowing-puppet {chosen.verb}: {error.filename or 'the work'} failed: {error.strerror}", file=sys.stderr)
        return 1
