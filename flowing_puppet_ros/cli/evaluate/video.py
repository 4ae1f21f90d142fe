# SPDX-License-Identifier: Apache-2.0
"""Track annotated clips by several methods and measure each: `flowing-puppet evaluate video FOLDER --truth FILE`.

The tracks are kept in --out and read from there the next time, unless --again is given.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from flowing_puppet_ros.draw.plots import Series, draw_line_plot
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.identity import IDENTITY_FIGURES, IdentityCounts
from flowing_puppet_ros.evaluate.people import Unmatched, add_unmatched_argument
from flowing_puppet_ros.evaluate.tables import format_table, write_csv, write_json
from flowing_puppet_ros.evaluate.video.errors import (
    CALIBRATION_DISTANCE_PX,
    MEASURED_JOINTS,
    THRESHOLDS_PX,
    ClipErrors,
    TrackedPerson,
    calibration_error,
    measure_calibration,
    measure_clip,
    measure_gain,
    summarise,
)
from flowing_puppet_ros.evaluate.video.identities import measure_identities
from flowing_puppet_ros.evaluate.video.methods import (
    INIT,
    MEDIAN,
    METHODS,
    ClipRun,
    LocatedPerson,
    all_names,
    check_names,
    filter_by_median,
    run_method,
)
from flowing_puppet_ros.evaluate.video.truth import PeopleByFrame, find_clips, read_people
from flowing_puppet_ros.image.formats.tracks_json import write_tracks
from flowing_puppet_ros.image.formats.video_reader import open_frames
from flowing_puppet_ros.image.video.settings import ClipSettings
from flowing_puppet_ros.process.threads import one_blas_thread, one_opencv_thread
from flowing_puppet_ros.report.page import build_page, paragraph, table
from flowing_puppet_ros.settings import make_out_folder

MAX_FRAMES = 2000
BASES = {"": "detector", INIT: f"{INIT}detector"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate video`."""
    names = ", ".join(METHODS)
    parser.add_argument("input", type=Path, help="folder of videos or of sub-folders of frames")
    parser.add_argument(
        "--truth",
        type=Path,
        required=True,
        help="JSON of the clips' joints, or a file or folder of keypoints, ours or of COCO, OpenPose, AlphaPose or "
        "MediaPipe",
    )
    parser.add_argument("--init", type=Path, help="keypoints that rows with init- start from, in a form of the truth's")
    parser.add_argument("--out", type=Path, required=True, help="folder for the tracks, video.json, .csv and .html")
    parser.add_argument("--clips", default="", help="names of clips, with commas between [all that the truth has]")
    parser.add_argument(
        "--methods", default="", help=f"{names}; {INIT}NAME starts from --init, NAME{MEDIAN} is median-filtered [all]"
    )
    parser.add_argument("--again", action="store_true", help="track again what was tracked before")
    parser.add_argument("--processes", type=int, default=2, help="clips at a time [%(default)s]")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    add_unmatched_argument(parser)
    ClipSettings.add_arguments(parser, main="tracker")


def run(arguments: argparse.Namespace) -> int:
    """Track, measure, print the table and write the files."""
    if arguments.processes < 1:
        raise InputError(f"--processes is {arguments.processes}; it must be 1 or more")
    clips = find_clips(arguments.input, _listed(arguments.clips))
    truth = read_people(arguments.truth, clips)
    given = {} if arguments.init is None else read_people(arguments.init, clips)
    chosen = _listed(arguments.methods) or all_names(arguments.init is not None)
    methods = check_names(chosen, arguments.init is not None)
    settings = ClipSettings.from_arguments(arguments)
    make_out_folder(arguments.out)
    tasks = [_Task(name, clips[name], given.get(name), methods, settings, arguments) for name in truth]
    for _ in tqdm(_done(tasks, arguments.processes), total=len(tasks), unit="clip", disable=None):
        pass
    errors = {name: {task.name: task.errors(name, truth[task.name]) for task in tasks} for name in methods}
    identities = {
        name: IdentityCounts.sum(task.identities(name, truth[task.name], arguments.unmatched) for task in tasks)
        for name in methods
    }
    _write(arguments, errors, identities, {name: [task.seconds(name) for task in tasks] for name in methods})
    return 0


def _listed(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


@dataclass(frozen=True, slots=True)
class _Task:
    """One clip, tracked by all methods; `given` are the people of --init."""

    name: str
    path: Path
    given: PeopleByFrame | None
    methods: list[str]
    settings: ClipSettings
    arguments: argparse.Namespace

    def file(self, method: str) -> Path:
        """Return the file in which the tracks of a method are kept."""
        return Path(self.arguments.out) / method / f"{self.name}.json"

    def __call__(self) -> None:
        """Track the clip by the methods that have no file yet."""
        plain = dict.fromkeys(name.removesuffix(MEDIAN) for name in self.methods)
        missing = [name for name in plain if self.arguments.again or not self.file(name).is_file()]
        if missing:
            with one_blas_thread(), one_opencv_thread():
                self._track(missing)
        for name in self.methods:
            if name.endswith(MEDIAN):
                self._filter(name)

    def _track(self, missing: Sequence[str]) -> None:
        source = open_frames(self.path)
        frames = list(source)
        if len(frames) > MAX_FRAMES:
            raise InputError(f"{self.path} has {len(frames)} frames; clips of up to {MAX_FRAMES} can be measured")
        made = ClipRun.load(frames, self.given, self.settings)
        size = [int(side) for side in frames[0].image.shape[1::-1]]
        for name in missing:
            began = time.process_time()
            track = run_method(name, made)
            entries = (_entry(frame.index, people) for frame, people in zip(frames, track, strict=True))
            write_tracks(self.file(name), made.joint_names, source.fps, entries)
            about = {"seconds": round((time.process_time() - began) / len(frames), 4), "size": size}
            self._about_file(name).write_text(json.dumps(about))

    def _filter(self, name: str) -> None:
        """Filter the tracks of the plain method."""
        plain = name.removesuffix(MEDIAN)
        data = json.loads(self.file(plain).read_text(encoding="utf-8"))
        track = [[_located(puppet) for puppet in frame["puppets"]] for frame in data["frames"]]
        indices = [frame["index"] for frame in data["frames"]]
        entries = (_entry(index, people) for index, people in zip(indices, filter_by_median(track), strict=True))
        write_tracks(self.file(name), tuple(data["joint_names"]), data["fps"], entries)
        self._about_file(name).write_text(self._about_file(plain).read_text())

    def seconds(self, method: str) -> float:
        """CPU seconds a frame that a method took, without what an earlier one had done for it."""
        return float(self._about(method)["seconds"])

    def errors(self, method: str, truth: PeopleByFrame) -> ClipErrors:
        """Compare the tracks of a method with the truth."""
        data = json.loads(self.file(method).read_text(encoding="utf-8"))
        width, height = self._about(method)["size"]
        found = {
            int(frame["index"]): [_person(data["joint_names"], _located(puppet)) for puppet in frame["puppets"]]
            for frame in data["frames"]
        }
        return measure_clip(found, truth, (width, height))

    def identities(self, method: str, truth: PeopleByFrame, unmatched: Unmatched) -> IdentityCounts:
        """Compare the ids of a method's tracks with the truth."""
        data = json.loads(self.file(method).read_text(encoding="utf-8"))
        width, height = self._about(method)["size"]
        names = data["joint_names"]
        found = {
            int(frame["index"]): {
                who: _person(names, person).joints for person in map(_located, frame["puppets"]) for who in [person.id]
            }
            for frame in data["frames"]
        }
        return measure_identities(found, truth, (width, height), unmatched)

    def _about(self, method: str) -> dict[str, Any]:
        return dict(json.loads(self._about_file(method).read_text()))

    def _about_file(self, method: str) -> Path:
        return self.file(method).with_suffix(".about")


def _entry(index: int, people: Sequence[LocatedPerson]) -> dict[str, Any]:
    puppets = []
    for person in people:
        rows = np.column_stack([np.round(person.joints, 2), np.round(person.confidence, 4)])
        puppets.append({"id": person.id, "joints": [[float(v) if np.isfinite(v) else None for v in r] for r in rows]})
    return {"index": index, "puppets": puppets}


def _located(puppet: Mapping[str, Any]) -> LocatedPerson:
    rows = np.array(puppet["joints"], np.float64)
    return LocatedPerson(puppet["id"], rows[:, :2], rows[:, 2])


def _person(names: Sequence[str], person: LocatedPerson) -> TrackedPerson:
    return TrackedPerson.of(names, person.joints, person.confidence)


def _call(task: _Task) -> None:
    task()


def _done(tasks: Sequence[_Task], processes: int) -> Iterator[None]:
    """Run the tasks, some at a time; a fresh process each would import everything again, so workers are kept."""
    if processes == 1 or len(tasks) == 1:
        for task in tasks:
            task()
            yield
        return
    with ProcessPoolExecutor(min(processes, len(tasks)), mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(_call, task) for task in tasks]):
            future.result()
            yield


def _write(
    arguments: argparse.Namespace,
    errors: Mapping[str, Mapping[str, ClipErrors]],
    identities: Mapping[str, IdentityCounts],
    seconds: Mapping[str, Sequence[float]],
) -> None:
    rows: list[dict[str, Any]] = []
    curves = {}
    for name, clips in errors.items():
        curves[name] = measure_calibration(clips)
        row = {"method": name} | summarise(clips)
        row |= {"calibration_error": calibration_error(curves[name])}
        row |= {"seconds_a_frame": round(float(np.mean(seconds[name])), 3)}
        rows.append(row | identities[name].summarise())
    gains = {name: _gains(name, errors) for name in errors}
    by_clip = {name: {clip: summarise({clip: one}) for clip, one in clips.items()} for name, clips in errors.items()}
    figures = {"methods": {row["method"]: row for row in rows}, "gains": gains, "calibration": curves, "clips": by_clip}
    write_csv(arguments.out / "video.csv", rows)
    write_json(arguments.out / "video.json", figures)
    (arguments.out / "video.html").write_text(_page(rows, gains, curves), encoding="utf-8")
    if arguments.json:
        print(json.dumps({row["method"]: row for row in rows}))
        return
    print(
        format_table([{key.replace("_px", ""): row[key] for key in row if key not in IDENTITY_FIGURES} for row in rows])
    )
    print(format_table([{key: row[key] for key in ("method", *IDENTITY_FIGURES)} for row in rows]))
    for name, text in gains.items():
        if text:
            print(f"{name} over {BASES[INIT if name.startswith(INIT) else '']}: {text}")


def _gains(name: str, errors: Mapping[str, Mapping[str, ClipErrors]]) -> str:
    base = BASES[INIT if name.startswith(INIT) else ""]
    if name == base or base not in errors:
        return ""
    found = []
    for kind in MEASURED_JOINTS:
        for threshold in THRESHOLDS_PX:
            points, low, high = measure_gain(errors[name], errors[base], kind, threshold)
            found.append(f"{kind}s within {threshold:g} px {points:+.1f} [{low:+.1f}, {high:+.1f}]")
    return ", ".join(found)


def _page(
    rows: Sequence[Mapping[str, Any]],
    gains: Mapping[str, str],
    curves: Mapping[str, Sequence[Mapping[str, float]]],
) -> str:
    heads = list(rows[0])
    cells = [[f"{row[head]:g}" if isinstance(row[head], float) else str(row[head]) for head in heads] for row in rows]
    title = "Joints within some pixels, medians, shake; identities at the similarity OKS"
    figures = table(heads, cells, range(1, len(heads)), title)
    figures += "".join(paragraph(f"{name}: {text}") for name, text in gains.items() if text)
    diagonal = Series("perfect", np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    lines = [diagonal] + [
        Series(name, np.array([r["confidence"] for r in curve]), np.array([r["right"] for r in curve]))
        for name, curve in curves.items()
        if curve
    ]
    plot = draw_line_plot(
        lines, "confidence against truth", "confidence", f"share within {CALIBRATION_DISTANCE_PX:g} px"
    )
    lead = paragraph("True joints inside the image; who is not found counts as wrong. Intervals: bootstrap over clips.")
    return build_page("Tracks against the truth", lead, [("Figures", figures), ("Calibration", plot)])
