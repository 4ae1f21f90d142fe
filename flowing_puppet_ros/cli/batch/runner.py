# SPDX-License-Identifier: Apache-2.0
"""Many inputs, one result each: in parallel processes or on a Dask cluster, despite failures, and resumable.

Finished inputs are logged beside the results, so that the same command resumes where it was stopped. The results do not
depend on the number of processes or machines.
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
from flowing_puppet_ros.cli.batch.task import BatchTask, Summary, TaskResult, execute
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.process.threads import usable_threads
from flowing_puppet_ros.settings import make_out_folder


@dataclass(frozen=True, slots=True)
class Verb:
    """What a verb does with one input.

    Attributes:
        name: of the verb.
        work: (input, options) -> JSON-ready summary; a module's function. Options must be picklable, and their `repr`
            must name everything that the result depends on.
        files: (summary) -> the files that were written.
        report: prints a summary on stdout, and remarks on it on stderr.
    """

    name: str
    work: Callable[[Path, Any], Summary]
    files: Callable[[Summary], list[Path]]
    report: Callable[[Summary], None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of verbs that take several inputs."""
    group = parser.add_argument_group("several inputs")
    group.add_argument("--jobs", type=int, metavar="N", help="parallel processes [one per core]")
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on the Dask cluster at tcp://host:8786, whose machines see the same folders, instead of locally",
    )
    group.add_argument("--again", action="store_true", help="redo finished inputs")


def check_jobs(arguments: argparse.Namespace) -> None:
    """Raise an InputError if --jobs is no number of processes or threads."""
    if arguments.jobs is not None and arguments.jobs < 1:
        raise InputError(f"--jobs is {arguments.jobs}; give 1 or more")


def resolve_path(path: Path, arguments: argparse.Namespace) -> Path:
    """Return a path as the machines of a cluster find it, whose processes run in other folders."""
    return path if arguments.scheduler is None else path.absolute()


def run_batch(verb: Verb, sources: Sequence[Path], options: Any, out: Path, arguments: argparse.Namespace) -> int:
    """Process every source that is not finished; return the exit status.

    Results are reported in the order of `sources`. The status is 0 if all are done, 1 if some failed, and the highest
    of their statuses if all failed.
    """
    check_jobs(arguments)
    _refuse_duplicates(sources)
    make_out_folder(out)
    log = ResultLog(out / f"{verb.name}.jsonl", verb.files)
    keys = [_make_key(verb.name, source, options) for source in sources]
    results: dict[int, TaskResult] = {}
    for index, key in enumerate(keys):
        summary = None if arguments.again else log.find_finished(key)
        if summary is not None:
            results[index] = TaskResult(summary)
    todo = [index for index in range(len(sources)) if index not in results]
    if results:
        print(f"flowing-puppet {verb.name}: {len(results)} finished inputs are skipped", file=sys.stderr)
    tasks = [BatchTask(verb.work, sources[index], options) for index in todo]
    reported = 0
    with tqdm(total=len(sources), initial=len(results), desc=verb.name, unit="input", file=sys.stderr) as bar:
        with closing(_run_tasks(tasks, arguments)) as done:
            for place, found in done:
                index = todo[place]
                results[index] = found
                if not found.error:
                    log.add(keys[index], found.summary)
                bar.update()
                reported = _report_in_order(verb, sources, results, reported, bar)
        _report_in_order(verb, sources, results, reported, bar)
    return _exit_status(verb.name, sources, results)


def _run_tasks(tasks: Sequence[BatchTask], arguments: argparse.Namespace) -> Generator[tuple[int, TaskResult]]:
    """Yield (index, result) as tasks finish, in any order."""
    workers = min(len(tasks), arguments.jobs or usable_threads(len(tasks)))
    if tasks and arguments.scheduler is not None:
        from flowing_puppet_ros.cli.batch.cluster import run_on_cluster

        yield from run_on_cluster(tasks, arguments.scheduler)
    elif workers > 1:
        from flowing_puppet_ros.cli.batch.processes import run_in_processes

        yield from run_in_processes(tasks, workers)
    else:
        yield from ((index, execute(task)) for index, task in enumerate(tasks))


def _report_in_order(
    verb: Verb, sources: Sequence[Path], results: dict[int, TaskResult], reported: int, bar: tqdm
) -> int:
    """Report finished sources in order, starting with source `reported`; return the index of the next one."""
    while reported in results:
        found = results[reported]
        with bar.external_write_mode(file=sys.stderr):
            if found.error:
                print(f"flowing-puppet {verb.name}: {found.error}", file=sys.stderr)
            verb.report({"input": str(sources[reported]), "error": found.error} if found.error else found.summary)
        reported += 1
    return reported


def _exit_status(name: str, sources: Sequence[Path], results: dict[int, TaskResult]) -> int:
    failed = [index for index, found in sorted(results.items()) if found.error]
    if not failed:
        return 0
    listed = ", ".join(str(sources[index]) for index in failed)
    print(f"flowing-puppet {name}: {len(failed)} of {len(sources)} inputs failed: {listed}", file=sys.stderr)
    return max(results[index].status for index in failed) if len(failed) == len(sources) else 1


def result_stem(source: Path) -> str:
    """Return the stem of a source's result: the name of a folder, or of a file without its suffix."""
    return source.name if source.is_dir() else source.stem


def _refuse_duplicates(sources: Iterable[Path]) -> None:
    double = next((stem for stem, count in Counter(map(result_stem, sources)).items() if count > 1), None)
    if double is not None:
        raise InputError(
            f"two inputs are called {double!r} and would overwrite each other's result; process them separately"
        )


class ResultLog:
    """The finished inputs of a folder of results, one line of JSON each; the last line that wrote a file counts.

    Only the process that runs the batch writes it; a line that was cut off does not count.
    """

    def __init__(self, path: Path, files: Callable[[Summary], list[Path]]) -> None:
        self._path = path
        self._files = files
        self._summaries: dict[str, Summary] = {}
        self._writers: dict[Path, str] = {}
        try:
            lines = path.read_text("utf8", errors="replace").splitlines() if path.exists() else []
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}; remove it to start over") from error
        for line in lines:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                entry = json.loads(line)
                self._store(str(entry["key"]), dict(entry["summary"]))

    def _store(self, key: str, summary: Summary) -> None:
        self._writers |= dict.fromkeys(self._files(summary), key)
        self._summaries[key] = summary

    def find_finished(self, key: str) -> Summary | None:
        """Return the summary of a finished input whose files still exist and are its own, else None."""
        summary = self._summaries.get(key)
        if summary is None:
            return None
        whole = all(self._writers[path] == key and path.is_file() for path in self._files(summary))
        return summary if whole else None

    def add(self, key: str, summary: Summary) -> None:
        """Log that an input is finished."""
        self._store(key, summary)
        with self._path.open("a", encoding="utf8") as stream:
            # A kill may have cut off the line before.
            stream.write("\n" * bool(stream.tell()) + json.dumps({"key": key, "summary": summary}))


def _make_key(verb: str, source: Path, options: Any) -> str:
    """Return a key of a result: a hash of the input as it is now, and of everything the result depends on."""
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
