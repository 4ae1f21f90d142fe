# SPDX-License-Identifier: Apache-2.0
"""Correspondence between scans through fits of one model, measured where the true correspondence is known.

The protocol of FAUST (Bogo et al. 2014): every vertex of scan A is mapped to scan B, and the error is its distance from
its true position there; intra pairs show one person twice, inter pairs two people.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.scans.names import SCAN_SUFFIXES
from flowing_puppet_ros.body.scans.scan import Scan, read_scan
from flowing_puppet_ros.body.scans.scan_correspondence import correspond
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet

# tr_reg_012 is of subject tr_reg_01, michael10 of subject michael.
SUBJECT_PATTERN = r"(.+_\d\d)\d$|(\D+)\d*$"


@dataclass(frozen=True, slots=True, eq=False)
class FittedScan:
    """A scan, its fit, and the vertices of the body points that all scans have in common.

    Attributes:
        name: the file's stem.
        subject: name of the person in the scan.
        scan: in its own frame and unit.
        vertices: (V, 3) fitted, in the scan's frame and unit.
        truth: (K,) vertices of the scan, the same body points in the same order in every scan.
        metres: length of the scan's unit in metres, according to the fit.
        stature: metres, of the fitted person standing.
    """

    name: str
    subject: str
    scan: Scan
    vertices: np.ndarray
    truth: np.ndarray
    metres: float
    stature: float


@dataclass(frozen=True, slots=True, eq=False)
class PairError:
    """Errors `error` (K,) m of one pair, and the `stature` of the target in metres."""

    first: str
    second: str
    intra: bool
    error: np.ndarray
    stature: float


def read_fitted_scans(
    folder: Path, fits: Path, vts: Path | None, subject: str = SUBJECT_PATTERN
) -> tuple[list[FittedScan], np.ndarray]:
    """Read every mesh of a folder with its fit and its correspondence.

    Args:
        folder: meshes; without `vts`, all have the same vertices in the same order, like FAUST's registrations.
        fits: folder written by `fit`, with STEM.npz for every mesh.
        vts: folder of files STEM.vts with one 1-based vertex number per line, like TOSCA's.
        subject: regular expression; its first group that matches in a stem names the person.

    Returns:
        The scans in the order of their names, and the faces (F, 3) of the model.

    Raises:
        InputError: if something is missing or the meshes do not correspond.
    """
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SCAN_SUFFIXES) if folder.is_dir() else []
    if len(paths) < 2:
        raise InputError(f"{folder} holds {len(paths)} meshes and a pair needs two; give the folder of the scans")
    model = StitchedPuppet.load(_read_fit(fits / f"{paths[0].stem}.npz")[2])
    scans = []
    for path in paths:
        scan = read_scan(path)
        vertices, shape, name = _read_fit(fits / f"{path.stem}.npz")
        if name != model.name:
            raise InputError(
                f"the fit of {path.name} is of the {name} model, others of the {model.name}; fit all with one"
            )
        truth = np.arange(len(scan.points)) if vts is None else _read_vts(vts / f"{path.stem}.vts", len(scan.points))
        metres, stature = _measure_unit_and_stature(model, vertices, shape)
        scans.append(FittedScan(path.stem, _parse_subject(subject, path.stem), scan, vertices, truth, metres, stature))
    return scans, model.faces


def pair_scans(scans: Sequence[FittedScan], every: bool, inter: bool) -> Iterator[tuple[FittedScan, FittedScan]]:
    """Yield pairs of each scan and its subject's first, or `every` ordered pair; `inter` pairs different subjects.

    Two subjects make a pair only when their scans have the same number of body points.
    """
    first: dict[str, FittedScan] = {}
    for scan in scans:
        first.setdefault(scan.subject, scan)
    for a in scans:
        for b in scans:
            if a is b or (a.subject == b.subject) == inter or len(a.truth) != len(b.truth):
                continue
            if every or b is first[b.subject]:
                yield a, b


def measure_pair(a: FittedScan, b: FittedScan, faces: np.ndarray) -> PairError:
    """Map scan A to scan B through their fits and compare with the true positions."""
    found = correspond(a.vertices, b.vertices, faces, a.scan, b.scan)[0]
    error = np.linalg.norm(found[a.truth] - b.scan.points[b.truth], axis=1) * b.metres
    return PairError(a.name, b.name, a.subject == b.subject, error, b.stature)


def summarise(pairs: Sequence[PairError]) -> dict[str, float]:
    """Summarise pairs: centimetres, percent of the stature, and the share of points within thresholds."""
    means = 100 * np.array([pair.error.mean() for pair in pairs])
    percent = 100 * np.array([pair.error.mean() / pair.stature for pair in pairs])
    points = 100 * np.concatenate([pair.error for pair in pairs])
    return {
        "pairs": len(pairs),
        "mean_cm": float(means.mean()),
        "median_pair_cm": float(np.median(means)),
        "worst_pair_cm": float(means.max()),
        "mean_percent_of_stature": float(percent.mean()),
        "worst_percent_of_stature": float(percent.max()),
        **{f"share_within_{limit}_cm": float(np.mean(points <= limit)) for limit in (1, 2, 5, 10)},
    }


def cumulative_percent(pairs: Sequence[PairError], limits: np.ndarray) -> np.ndarray:
    """Return the percentage (L,) of all points whose error is at most `limits` (L,) m."""
    points = np.sort(np.concatenate([pair.error for pair in pairs]))
    return 100 * np.searchsorted(points, limits, side="right") / len(points)


def _measure_unit_and_stature(model: StitchedPuppet, vertices: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Return the length of the unit of `vertices` (V, 3) in metres, and the person's stature in metres.

    Edges keep their length in every pose, so their mean length gives the unit.
    """
    standing = model.vertices(model.rest_state(shape))
    edges = model.faces[:, :2]
    lengths = [np.linalg.norm(mesh[edges[:, 0]] - mesh[edges[:, 1]], axis=1).mean() for mesh in (standing, vertices)]
    return float(lengths[0] / lengths[1]), float(np.ptp(standing[:, 2]))


def _parse_subject(pattern: str, stem: str) -> str:
    try:
        match = re.match(pattern, stem)
    except re.error as error:
        raise InputError(f"--subject {pattern!r} is not a regular expression: {error}") from error
    name = next((group for group in match.groups() if group), None) if match else None
    if name is None:
        raise InputError(f"--subject {pattern!r} finds no subject in {stem!r}; its first group should name it")
    return name


def _read_fit(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            vertices = arrays["vertices"].astype(np.float64)
            return vertices, arrays["all_shape_coefficients"].astype(np.float64), str(arrays["model"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a fit; make one with `flowing-puppet fit`") from error


def _read_vts(path: Path, points: int) -> np.ndarray:
    try:
        rows = np.atleast_1d(np.loadtxt(path, dtype=np.int64)) - 1
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as vertex numbers, one per line: {error}") from error
    if rows.ndim != 1 or not len(rows) or rows.min() < 0 or rows.max() >= points:
        raise InputError(f"{path} does not hold numbers from 1 to {points}, the vertices of its mesh")
    return np.asarray(rows)
