# SPDX-License-Identifier: Apache-2.0
"""The command line `flowing-puppet <verb>`: one module per verb, imported only when that verb is used.

Arguments come in; files, tables and an exit status go out. Read `fit` first: its neighbours are built alike.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from flowing_puppet_ros import __version__
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.extras import needing_extra

VERBS = {
    "fit": "fit the 3D Stitched Puppet to meshes and clouds",
    "correspond": "map scan to scan through two fits",
    "pose": "find people's pose in single images",
    "track": "track people in a video, a frame folder or a bag with flowing puppets",
    "replay": "run the nodes' algorithms over a bag, losslessly and reproducibly",
    "report": "make the HTML report of a replayed bag",
    "doctor": "say what can be computed from an input or on this machine, and what to run",
    "import": "write the videos and the calibration of several cameras into a bag",
    "calibrate": "refine the calibration and the clocks of several cameras by the people in a bag",
    "export": "write fitted bodies as GLB, BVH, TRC, OBJ or JSON",
    "networks": "list, check and install the keypoint networks",
    "annotate": "pose puppets on images in the browser",
    "learn": "learn the body models, the likelihood and the detector",
    "sample": "draw samples of the learned body models",
    "evaluate": "measure poses and bodies against the truth",
    "bench": "measure speed as ratios taken in one run",
}


EXAMPLES = {
    "fit": ("fit scan.ply --out fits --measure", "fit room.pcd --scene --view single --out fits"),
    "correspond": ("correspond fits/a.npz fits/b.npz --scan-a a.ply --scan-b b.ply --out pairs.npz",),
    "pose": ("pose photos --out poses.json",),
    "track": (
        "track video.mp4 --out tracks.json --overlay film.mp4",
        "track frames --init openpose_folder --out t.json",
    ),
    "replay": (
        "replay walk.mcap --out out.mcap --report out.html",
        "replay walk --out out.mcap --topic-map /camera/color/image_raw:=/camera/image",
    ),
    "report": ("report out.mcap --input walk.mcap --out out.html",),
    "doctor": ("doctor walk.mcap", "doctor live", "doctor"),
    "import": ("import session --calibration session/Calib.toml --out session.mcap",),
    "calibrate": ("calibrate session.mcap --out refined.toml --person-height 1.80",),
    "export": ("export fits/scan.npz --to glb --out exchange", "export out.mcap --to bvh --out exchange"),
    "networks": ("networks", "networks --install"),
    "annotate": ("annotate photos",),
    "learn": ("learn likelihood --help",),
    "sample": ("sample sp --count 4 --seed 1 --out samples",),
    "evaluate": ("evaluate joints tracks.json --truth keypoints.json",),
    "bench": ("bench fits",),
}
"""Commands that the help of each verb ends with."""


_INPUT_ARGUMENTS = ("inputs", "input", "images")
"""Names of the arguments of verbs that are inputs."""
VERB_PACKAGES = ("doctor", "evaluate", "sample")
"""Verbs in folders of their own."""
_MODULES = {"import": "cameras.import_folder", "calibrate": "cameras.calibrate_bag"}
"""Verbs whose module is elsewhere."""


class _HelpFormatter(argparse.HelpFormatter):
    """Keep the lines of the examples as they are; all else is filled."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("examples:") else super()._fill_text(text, width, indent)


def import_verb(verb: str) -> ModuleType:
    """Import the module of a verb; InputError if it is not installed."""
    if verb == "bench":
        return _import_benchmarks()
    module = f"{verb}.verb" if verb in VERB_PACKAGES else _MODULES.get(verb, verb)
    return import_module(f"{__name__}.{module}")


def _import_benchmarks() -> ModuleType:
    """Import the benchmarks, which are beside the package in its source tree and not installed."""
    source_tree = Path(__file__).resolve().parents[2]
    if not (source_tree / "benchmarks" / "verb.py").is_file():
        raise InputError(
            "bench compares with programs that are not installed with the package; run it in a source tree"
        )
    if str(source_tree) not in sys.path:
        sys.path.append(str(source_tree))
    return import_module("benchmarks.verb")


def make_verb_parser(verb: str, arguments: list[str]) -> tuple[ModuleType, argparse.ArgumentParser, list[str]]:
    """Return the module of a verb, its parser, and the arguments left to parse.

    A module may name modules of sub-verbs in `SUBVERBS`; if the first argument is one of these, its module is returned.
    `EXTRA` names what must be installed for these. A module without `add_arguments` only chooses between them.
    """
    module, name = import_verb(verb), verb
    subverbs = getattr(module, "SUBVERBS", {})
    if arguments and arguments[0] in subverbs:
        name, arguments = f"{verb} {arguments[0]}", arguments[1:]
        extra = getattr(module, "EXTRA", "")
        with needing_extra(extra, verb) if extra else nullcontext():
            module = import_module(subverbs[name.split()[1]])
    lines = ["examples:", *(f"  flowing-puppet {example}" for example in EXAMPLES[verb])] if name == verb else []
    parser = argparse.ArgumentParser(
        prog=f"flowing-puppet {name}",
        description=module.__doc__,
        epilog="\n".join(lines),
        formatter_class=_HelpFormatter,
    )
    if hasattr(module, "add_arguments"):
        module.add_arguments(parser)
    else:
        _add_subverbs(parser, subverbs)
    return module, parser, arguments


def _add_subverbs(parser: argparse.ArgumentParser, subverbs: Mapping[str, str]) -> None:
    """Add the names of sub-verbs (name -> module) with their modules' summaries, without loading these modules."""
    kinds = parser.add_subparsers(required=True, metavar="|".join(subverbs))
    for name, module in subverbs.items():
        spec = find_spec(module)
        assert spec is not None and spec.origin is not None
        said = ast.get_docstring(ast.parse(Path(spec.origin).read_text("utf8"))) or ""
        kinds.add_parser(name, help=said.partition("\n")[0].rstrip(".").replace("%", "%%"))


def _suggest(verb: str, parsed: argparse.Namespace, error: str) -> str:
    """Return the end of the sentence in which a verb refused its input: the command that helps, empty if none does."""
    from flowing_puppet_ros.doctor.recognise import suggest

    given: Any = next((value for name, value in vars(parsed).items() if name in _INPUT_ARGUMENTS and value), [])
    paths = given if isinstance(given, list) else [given]
    return suggest(verb, Path(paths[0]), error) if len(paths) == 1 else ""


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
    parsed = argparse.Namespace()
    try:
        module, verb_parser, arguments = make_verb_parser(chosen.verb, chosen.arguments)
        verb_parser.parse_args(arguments, parsed)
        return module.run(parsed)
    except PuppetError as error:
        print(f"flowing-puppet {chosen.verb}: {error}{_suggest(chosen.verb, parsed, str(error))}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print(f"flowing-puppet {chosen.verb}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 1
    except OSError as error:
        # A full or missing disk may fail any read or write.
        print(f"flowing-puppet {chosen.verb}: {error.filename or 'the work'} failed: {error.strerror}", file=sys.stderr)
        return 1
