# SPDX-License-Identifier: Apache-2.0
"""What the verb `replay` does."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay
from flowing_puppet_ros.bag.storage.paths import is_bag
from flowing_puppet_ros.cli.batch import runner
from flowing_puppet_ros.errors import InputError, PuppetError

_OF_NODES_ONLY = ("queue", "image_transport", "autostart", "use_sim_time")


@dataclass(frozen=True, slots=True)
class ReplayJob:
    """What each replay of several is told; the bags, and the reports if there are any, go into folders."""

    out: Path = field(repr=False)
    reports: Path | None
    recordings: Path | None
    options: ReplayOptions


def run(arguments: argparse.Namespace) -> int:
    """Replay, report, and say where the results are."""
    if not arguments.rate >= 0:
        raise InputError(f"--rate is {arguments.rate:g}: give 0 for full speed or a positive factor")
    if not 0 <= arguments.start_offset < math.inf:
        raise InputError(f"--start-offset is {arguments.start_offset:g}: give seconds from the start, 0 or more")
    if not arguments.playback_duration > 0:
        raise InputError(f"--playback-duration is {arguments.playback_duration:g}: give seconds, more than 0")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}: give 0 or a positive number")
    settings = read_params(arguments.params) if arguments.params else {}
    if arguments.fixed_frame:
        settings["body_fitter"] = {**settings.get("body_fitter", {}), "fixed_frame": arguments.fixed_frame}
    options = ReplayOptions(
        rate=arguments.rate,
        topic_map=parse_topic_map(arguments.topic_map),
        settings=settings,
        seed=arguments.seed,
        start_offset=arguments.start_offset,
        playback_duration=arguments.playback_duration,
        salvage=arguments.salvage,
        jobs=arguments.jobs,
    )
    if arguments.rerun is not None:
        from flowing_puppet_ros.report.rerun_file import import_rerun

        import_rerun()
    runner.check_jobs(arguments)
    sources = [runner.resolve_path(source, arguments) for given in arguments.inputs for source in find_bags(given)]
    if sources == arguments.inputs and len(sources) == 1 and arguments.scheduler is None:
        return _one(sources[0], arguments, options)
    if arguments.out.suffix == ".mcap":
        raise InputError(f"--out is {arguments.out}: the results of several bags need a folder")
    told = ReplayJob(
        out=runner.resolve_path(arguments.out, arguments),
        reports=arguments.report and runner.resolve_path(arguments.report, arguments),
        recordings=arguments.rerun and runner.resolve_path(arguments.rerun, arguments),
        options=replace(options, progress=False, jobs=None),
    )
    verb = runner.Verb("replay", replay_one, list_files, lambda summary: _tell(summary, arguments.json))
    return runner.run_batch(verb, sources, told, arguments.out, arguments)


def _one(source: Path, arguments: argparse.Namespace, options: ReplayOptions) -> int:
    summary = replay(source, arguments.out, options)
    try:
        if arguments.report:
            _report(source, arguments.out, arguments.report, summary)
        if arguments.rerun:
            _record(source, arguments.out, arguments.rerun, summary)
    finally:
        # The output bag is there, whatever becomes of the report.
        _tell(summary, arguments.json)
    _check_used(summary)
    return 0


def replay_one(source: Path, told: ReplayJob) -> dict[str, Any]:
    """Replay one bag of several into a file of its own, with its report if that is wanted, and return the summary."""
    name = runner.result_stem(source)
    target = told.out / f"{name}.mcap"
    summary = replay(source, target, told.options)
    if told.reports is not None:
        _report(source, target, told.reports / f"{name}.html", summary)
    if told.recordings is not None:
        _record(source, target, told.recordings / f"{name}.rrd", summary)
    _check_used(summary)
    return summary


def _check_used(summary: dict[str, Any]) -> None:
    """Check that something of the bag was used; PuppetError with the reason of each topic otherwise."""
    if "unused" in summary:
        reasons = "; ".join(f"{topic}: {reason}" for topic, reason in summary["unused"].items())
        raise PuppetError(f"nothing in {summary['input']} could be used: {reasons or 'it has no topics'}")


def list_files(summary: dict[str, Any]) -> list[Path]:
    """Return the files that a summary of `replay_one` names."""
    return [Path(summary[name]) for name in ("output", "report", "rerun") if name in summary]


def _report(source: Path, target: Path, report: Path, summary: dict[str, Any]) -> None:
    from flowing_puppet_ros.report.report import write_report

    write_report(source, target, report, summary)
    summary["report"] = str(report)


def _record(source: Path, target: Path, recording: Path, summary: dict[str, Any]) -> None:
    from flowing_puppet_ros.report.rerun_file import write_replay

    write_replay(source, target, recording)
    summary["rerun"] = str(recording)


def _tell(summary: dict[str, Any], as_json: bool) -> None:
    for warning in summary.get("warnings", ()):
        print(f"flowing-puppet replay: {warning}", file=sys.stderr)
    if as_json or "error" not in summary:
        print(json.dumps(summary) if as_json else _text(summary), flush=True)


def find_bags(given: Path) -> list[Path]:
    """Return an input as it is, or the bags in a folder that is not a bag itself, by name."""
    if not given.is_dir() or is_bag(given):
        return [given]
    return sorted(path for path in given.iterdir() if is_bag(path)) or [given]


def parse_topic_map(rules: list[str]) -> dict[str, str]:
    """Return old name -> new name of rules like /camera/rgb:=/cam/image; InputError for anything else."""
    found = {}
    for rule in rules:
        old, separator, new = rule.partition(":=")
        if not separator or not old.startswith("/") or not new.startswith("/"):
            raise InputError(f"--topic-map is {rule!r}: give /old:=/new")
        found[old] = new
    return found


def read_params(path: Path) -> dict[str, dict[str, Any]]:
    """Return component -> settings of a ROS parameter file (`name: ros__parameters: ...`)."""
    try:
        content = YAML(typ="safe").load(path.read_text("utf8")) or {}
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise InputError(f"the parameter file {path} cannot be read as YAML") from error
    found = {}
    for name, entry in content.items() if isinstance(content, dict) else [("", None)]:
        values = entry.get("ros__parameters") if isinstance(entry, dict) else None
        if not isinstance(values, dict):
            raise InputError(f"the parameter file {path} has no ros__parameters under {str(name)!r}")
        settings = {str(key): value for key, value in values.items() if key not in _OF_NODES_ONLY}
        found[str(name).rpartition("/")[2]] = settings
    return found


def _text(summary: dict[str, Any]) -> str:
    lines = [
        f"{summary['frames']} images and {summary['bodies']} bodies in {summary['seconds']:.1f} s "
        f"({summary['frames_per_second']:.1f} images a second)",
        f"results: {summary['output']}",
    ]
    lines += [f"{name}: {summary[name]}" for name in ("report", "rerun") if name in summary]
    return "\n".join(lines)
