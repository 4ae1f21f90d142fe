# SPDX-License-Identifier: Apache-2.0
"""The command line's manners: help for every verb, exit statuses, one sentence for bad input."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from shown_commands import check  # type: ignore[import-not-found]

from flowing_puppet_ros import __version__
from flowing_puppet_ros.cli import EXAMPLES, VERBS, main

MISSING = {
    "fit": ["missing.ply", "--out", "out"],
    "correspond": ["a.npz", "b.npz", "--scan-a", "a.ply", "--scan-b", "b.ply", "--out", "pairs.npz"],
    "track": ["missing.mp4", "--out", "tracks.json"],
    "replay": ["missing.mcap", "--out", "out.mcap"],
    "report": ["missing.mcap", "--input", "missing.mcap"],
}


def test_installed_command_prints_its_version() -> None:
    command = Path(sys.executable).with_name("flowing-puppet")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["flowing-puppet", __version__]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([verb, "--help"])
    assert done.value.code == 0
    said = capsys.readouterr().out
    assert f"usage: flowing-puppet {verb}" in said
    assert all(f"\n  flowing-puppet {example}\n" in said for example in EXAMPLES[verb])
    placeholder = re.search(r"--\S+ [A-Z_]+\.[A-Z_.]+", said)
    assert placeholder is None, f"{placeholder} names an attribute, not a value"


@pytest.mark.parametrize("verb", VERBS)
def test_the_examples_of_every_verb_are_commands(verb: str) -> None:
    for example in EXAMPLES[verb]:
        assert example.split()[0] == verb
        check(["flowing-puppet", *example.split()])


@pytest.mark.parametrize("arguments", [[], ["dance"], ["replay", "--no-such-flag"], ["fit", "--seed", "one"]])
def test_unusable_arguments_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(arguments)
    assert done.value.code == 2
    assert "error:" in capsys.readouterr().err


@pytest.mark.parametrize("verb", MISSING)
def test_missing_input_is_one_sentence(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([verb, *MISSING[verb]]) == 2
    message = capsys.readouterr().err.strip()
    assert MISSING[verb][0] in message
    assert len(message.splitlines()) == 1
    assert "Traceback" not in message
    assert not list(tmp_path.rglob("*.*")), "nothing is left behind"
