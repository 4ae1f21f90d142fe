# SPDX-License-Identifier: Apache-2.0
"""Whether what README and docs tell people to type exists: programs, verbs, flags, topics, parameters, files."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import yaml

from flowing_puppet_ros.cli import make_verb_parser
from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings

ROOT = Path(__file__).resolve().parents[2]
FENCE = re.compile(r"^```(bash(?: test)?|python(?: test)?)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ROS2 = {"launch", "topic", "node", "security", "action", "bag", "lifecycle", "param", "service", "run"}
USUAL = {"source", "export", "colcon", "ls", "cd", "rviz2", "git", "ln", "rosdep", "docker"}


class WrongCommand(AssertionError):
    """What is wrong with a command, in one sentence."""


def pages() -> list[Path]:
    """Return every page that people read commands from."""
    written = [page for page in (ROOT / "docs").rglob("*.md") if "generated" not in page.parts]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(written)]


def blocks(text: str) -> list[tuple[str, str]]:
    """Return (info string, code) of the bash and Python blocks of a Markdown text."""
    return [(match[1], match[2]) for match in FENCE.finditer(text)]


def commands(code: str) -> Iterator[list[str]]:
    """Yield the commands of a block, split into words; those joined by pipes one by one."""
    for line in code.replace("\\\n", " ").splitlines():
        for piece in line.split(" | "):
            words = shlex.split(piece, comments=True)
            if words:
                yield words


def check(words: list[str]) -> None:
    """Raise WrongCommand when a command names something that is not there."""
    program, given = Path(words[0]).name, words[1:]
    if program == "xargs":
        start = next(k for k, word in enumerate(words) if word.endswith("flowing-puppet"))
        program, given = "flowing-puppet", [*words[start + 1 :], "input"]
    if program == "flowing-puppet":
        _check_verb(given)
    elif program in COMPONENTS:
        _check_node(program, given)
    elif program == "make":
        _check_targets(given)
    elif program in ("pip", "python", "pre-commit"):
        _check_files([word for word in given if word.endswith((".txt", ".py"))])
    elif program == "ros2":
        _check_ros2(given)
    elif program not in USUAL:
        raise WrongCommand(f"nobody knows the program {program!r}")


def _check_verb(given: list[str]) -> None:
    if given == ["--version"] or not given or given[-1] == "--help":
        return
    try:
        _, parser, left = make_verb_parser(given[0], given[1:])
    except ImportError as error:
        raise WrongCommand(f"there is no verb {given[0]!r}") from error
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        try:
            parser.parse_args(left)
        except (SystemExit, argparse.ArgumentError) as error:
            raise WrongCommand(f"{' '.join(given)}: {said.getvalue().splitlines()[-1]}") from error


def _check_node(name: str, given: list[str]) -> None:
    component = COMPONENTS[name]
    infos = {info.name: info for kind in (component.settings_type, node_settings(name)) for info in kind.describe()}
    ports = {port.name for port in (*getattr(component, "inputs", ()), *component.outputs)}
    if given[:1] not in ([], ["--ros-args"], ["--help"]):
        raise WrongCommand(f"{name} takes no {given[0]!r} before --ros-args")
    for word in given:
        if word.startswith("rig.cameras:="):
            cameras = word.partition(":=")[2].split(",")
            ports |= {f"{camera}/{port}" for camera in cameras for port in ("depth", "camera_info", "points")}
    options = iter(given[1:])
    for option in options:
        value = next(options, "")
        left, _, right = value.partition(":=")
        if option == "-r" and not (left in ports or left.startswith("__") or name == "visual_hull"):
            raise WrongCommand(f"{name} has no topic {left!r}")
        if option == "-p" and left != "use_sim_time":
            if left not in infos:
                raise WrongCommand(f"{name} has no parameter {left!r}")
            text = infos[left].type is str
            infos[left].check(right if text else yaml.safe_load(right))
        if option == "--params-file":
            _check_files([value])
        if option not in ("-r", "-p", "--params-file", "--enclave"):
            raise WrongCommand(f"{name}: {option!r} is not understood here")


def _check_targets(given: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in given:
        if not re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE):
            raise WrongCommand(f"the Makefile has no target {target!r}")


def _check_files(names: list[str]) -> None:
    for name in names:
        if not (ROOT / name).is_file():
            raise WrongCommand(f"there is no {name}")


def _check_ros2(given: list[str]) -> None:
    if given[0] not in ROS2:
        raise WrongCommand(f"ros2 has no {given[0]!r}")
    if given[:2] == ["launch", "flowing_puppet_ros"]:
        path = ROOT / "launch" / given[2]
        _check_files([f"launch/{given[2]}"])
        declared = path.read_text() + (ROOT / "flowing_puppet_ros/node/launching/actions.py").read_text()
        for argument in given[3:]:
            name = argument.partition(":=")[0]
            if f'"{name}": (' not in declared:
                raise WrongCommand(f"{path.name} has no argument {name!r}")
