# SPDX-License-Identifier: Apache-2.0
"""Many inputs, one result each: in parallel processes or on a Dask cluster, whatever fails, and resumable.

A finished input is written down in a ledger beside the results, so that the same command goes on where it was stopped.
The results do not depend on how many processes or machines made them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from flowing_puppet_ros import __version__
from flowing_puppet_ros.cli.batch.task import Answer, Summary, Task, answer
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.parallel import usable_threads
from flowing_puppet_ros.settings import make_out_folder


@dataclass(frozen=True, slots=True)
class Verb:
    """What a verb does with one input.

    Attributes:
        name: of the verb.
        work: (input, options) -> summary that JSON can hold; a function of a module, options that can be pickled and
            whose `repr` names all that the result depends on.
        files: (summary) -> the files that were written.
        tell: (summary) -> nothing; prints it on stdout, and what is to be said of it on stderr.
    """

    name: str
    work: Callable[[Path, Any], Summary]
    files: Callable[[Summary], list[Path]]
    tell: Callable[[Summary], None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of verbs that take many inputs."""
    group = parser.add_argument_group("several inputs")
    group.add_argument("--jobs", type=int, metavar="N", help="processes at a time [one a core]")
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the Dask cluster there, tcp://host:8786, whose machines see the same folders, instead of here",
    )
    group.add_argument("--again", action="store_true", help="redo inputs that are finished")


def resolve_path(path: Path, arguments: argparse.Namespace) -> Path:
    """A path as the machines of a cluster find it, whose processes run in other folders."""
    return path if arguments.scheduler is None else path.absolute()


def run_batch(verb: Verb, sources: Sequence[Path], options: Any, out: Path, arguments: argparse.Namespace) -> int:
    """Work on every source that is not finished and return the exit status.

    Results are told in the order of `sources`. 0 when all are done, 1 when some failed; when every one failed the
    highest of their statuses.
    """
    if arguments.jobs is not None and arguments.jobs < 1:
        raise InputError(f"--jobs is {arguments.jobs}; give 1 or more")
    _refuse_duplicates(sources)
    make_out_folder(out)
    ledger = ResultLog(out / f"{verb.name}.jsonl", verb.files)
    keys = [_key(verb.name, source, options) for source in sources]
    answers: dict[int, Answer] = {}
    for index, key in enumerate(keys):
        summary = None if arguments.again else ledger.finished(key)
        if summary is not None:
            answers[index] = Answer(summary)
    todo = [index for index in range(len(sources)) if index not in answers]
    if answers:
        print(f"flowing-puppet {verb.name}: {len(answers)} finished inputs are skipped", file=sys.stderr)
    tasks = [Task(verb.work, sources[index], options) for index in todo]
    told = 0
    with tqdm(total=len(sources), initial=len(answers), desc=verb.name, unit="input", file=sys.stderr) as bar:
        with closing(_engine(tasks, arguments)) as done:
            for place, found in done:
                index = todo[place]
                answers[index] = found
                if not found.error:
                    ledger.add(keys[index], found.summary)
                bar.update()
                told = _tell(verb, sources, answers, told, bar)
        _tell(verb, sources, answers, told, bar)
    return _status(verb.name, sources, answers)


def _engine(tasks: Sequence[Task], arguments: argparse.Namespace) -> Generator[tuple[int, Answer]]:
    """Yield (index, answer) as tasks are done, in any order."""
    workers = min(len(tasks), arguments.jobs or usable_threads(len(tasks)))
    if tasks and arguments.scheduler is not None:
        from flowing_puppet_ros.cli.batch.cluster import on_cluster

        yield from on_cluster(tasks, arguments.scheduler)
    elif workers > 1:
        from flowing_puppet_ros.cli.batch.processes import in_processes

        yield from in_processes(tasks, workers)
    else:
        yield from ((index, answer(task)) for index, task in enumerate(tasks))


def _tell(verb: Verb, sources: Sequence[Path], answers: dict[int, Answer], told: int, bar: tqdm) -> int:
    """Tell what can be told in order, from source `told` on; returns the next one's index."""
    while told in answers:
        found = answers[told]
        with bar.external_write_mode(file=sys.stderr):
            if found.error:
                print(f"flowing-puppet {verb.name}: {found.error}", file=sys.stderr)
            verb.tell({"input": str(sources[told]), "error": found.error} if found.error else found.summary)
        told += 1
    return told


def _status(name: str, sources: Sequence[Path], answers: dict[int, Answer]) -> int:
    failed = [index for index, found in sorted(answers.items()) if found.error]
    if not failed:
        return 0
    listed = ", ".join(str(sources[index]) for index in failed)
    print(f"flowing-puppet {name}: {len(failed)} of {len(sources)} inputs failed: {listed}", file=sys.stderr)
    return max(answers[index].status for index in failed) if len(failed) == len(sources) else 1


def stem_of(source: Path) -> str:
    """The name of a source's result: that of a folder, or of a file without its ending."""
    return source.name if source.is_dir() else source.stem


def _refuse_duplicates(sources: Iterable[Path]) -> None:
    double = next((stem for stem, count in Counter(map(stem_of, sources)).items() if count > 1), None)
    if double is not None:
        raise InputError(f"two inputs are called {double!r} and would overwrite each other's result; do them apart")


class ResultLog:
    """What is finished in a folder of results: a line of JSON for each, the last one that wrote a file counts.

    Only the process that runs the batch writes it; a line that was cut off in the middle does not count.
    """

    def __init__(self, path: Path, files: Callable[[Summary], list[Path]]) -> None:
        self._path = path
        self._files = files
        self._summaries: dict[str, Summary] = {}
        self._writers: dict[Path, str] = {}
        try:
            lines = path.read_text("utf8", errors="replace").splitlines() if path.exists() else []
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}; remove it to start anew") from error
        for line in lines:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                entry = json.loads(line)
                self._take(str(entry["key"]), dict(entry["summary"]))

    def _take(self, key: str, summary: Summary) -> None:
        self._writers |= dict.fromkeys(self._files(summary), key)
        self._summaries[key] = summary

    def finished(self, key: str) -> Summary | None:
        """The summary of a finished input whose files are still there and its own, else None."""
        summary = self._summaries.get(key)
        if summary is None:
            return None
        whole = all(self._writers[path] == key and path.is_file() for path in self._files(summary))
        return summary if whole else None

    def add(self, key: str, summary: Summary) -> None:
        """Write down that an input is finished."""
        self._take(key, summary)
        with self._path.open("a", encoding="utf8") as stream:
            # The line before may have been cut off by a kill.
            stream.write("\n" * bool(stream.tell()) + json.dumps({"key": key, "summary": summary}))


def _key(verb: str, source: Path, options: Any) -> str:
    """A name for a result: the input as it is now, and all that it is made with."""
    paths = sorted(path for path in source.rglob("*") if path.is_file()) if source.is_dir() else [source]
    parts = [__version__, verb, repr(options)]
    for path in paths:
        try:
            state = path.stat()
        except OSError:
            parts.append(f"{path} missing")
            continue
        parts.append(f"{path.absolute()} {state.st_size} {state.st_mtime_ns}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
