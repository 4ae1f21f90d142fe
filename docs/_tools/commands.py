# SPDX-License-Identifier: Apache-2.0
"""The command-line reference, from the parsers of the verbs."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

from flowing_puppet_ros.cli import VERBS, import_verb, make_verb_parser


def pages() -> Iterator[tuple[str, str]]:
    """Yield the page of all verbs."""
    parts = [
        "# Command line\n",
        "`flowing-puppet VERB --help` prints the same. Exit status: 0 done, 1 the work failed, 2 unusable arguments or "
        "input, with one sentence on standard error. `--json` prints one JSON object per input on standard output; "
        "progress goes to standard error.\n",
    ]
    for verb, summary in VERBS.items():
        parts.append(f"## `{verb}`: {summary}\n")
        for words, parser in parsers(verb):
            parts.append(verb_section(words, parser))
    yield "cli.md", "\n".join(parts)


def parsers(verb: str) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield the parser of a verb and of its sub-verbs, with the words that lead there."""
    module = import_verb(verb)
    own = [[]] if hasattr(module, "add_arguments") else []
    for given in (*own, *([name] for name in getattr(module, "SUBVERBS", {}))):
        _, parser, _ = make_verb_parser(verb, list(given))
        yield " ".join([verb, *given]), parser


def verb_section(words: str, parser: argparse.ArgumentParser) -> str:
    """Return heading, description and table of arguments of one parser."""
    lines = [f"### `flowing-puppet {words}`\n", escaped(parser.description or "").strip() + "\n"]
    rows = [argument_row(parser, action) for action in parser._actions if "-h" not in action.option_strings]
    if rows:
        lines += ["| argument | meaning |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def argument_row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """Return one argument with its help, defaults filled in."""
    formatter = parser._get_formatter()
    if action.option_strings:
        names = ", ".join(f"`{name}`" for name in action.option_strings)
        value = "" if action.nargs == 0 else f" `{formatter._format_args(action, formatter_metavar(action))}`"
    else:
        names, value = f"`{formatter._format_args(action, formatter_metavar(action))}`", ""
    text = formatter._expand_help(action) if action.help else ""
    return f"| {names}{value} | {escaped(text)} |"


def formatter_metavar(action: argparse.Action) -> str:
    """Return the placeholder that stands for an argument's value."""
    if isinstance(action.metavar, str):
        return action.metavar
    if action.choices is not None:
        return "{" + ",".join(map(str, action.choices)) + "}"
    return action.dest.upper()


def escaped(text: str) -> str:
    """Return plain text as Markdown in which nothing but code between backticks is special."""
    pieces = text.replace("|", "\\|").split("`")
    return "`".join(
        piece if index % 2 else re.sub(r"([*_<>$\[\]])", r"\\\1", piece) for index, piece in enumerate(pieces)
    )
