# SPDX-License-Identifier: Apache-2.0
"""Correspondence between scans through fits of one model, measured where the true correspondence is known.

The protocol of FAUST (Bogo et al. 2014): every vertex of scan A is mapped to scan B and its distance to the true place
is the error; intra pairs show one person twice, inter pairs two people.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.scans.scan import SUFFIXES, Scan, read_scan
from flowing_puppet_ros.body.scans.scan_correspondence import correspond
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.model.sp import StitchedPuppet

# tr_reg_012 is of subject tr_reg_01, michael10 of subject michael.
SUBJECT = r"(.+_\d\d)\d$|(\D+)\d*$"


@dataclass(frozen=True, slots=True, eq=False)
class FittedScan:
    """A scan, the fit to it, and which of its vertices show the body points that all scans have in common.

    Attributes:
        name: the file's stem.
        subject: whom the scan shows.
        scan: in its own frame and unit.
        vertices: (V, 3) fitted, in the scan's frame and unit.
        truth: (K,) vertices of the scan, the same body points in the same order in every scan.
        metres: length of the scan's unit as the fit has it.
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
    """Errors (K,) of one pair in metres, and the stature of the target in metres."""

    first: str
    second: str
    intra: bool
    error: np.ndarray
    stature: float


def read_fitted(
    folder: Path, fits: Path, vts: Path | None, subject: str = SUBJECT
) -> tuple[list[FittedScan], np.ndarray]:
    """Read every mesh of a folder with its fit and its correspondence.

    Args:
        folder: meshes; without `vts` all have the same vertices in the same order, as FAUST's registrations.
        fits: what `fit` wrote: for every mesh a .npz with its stem.
        vts: files STEM.vts with one 1-based vertex number a line, as TOSCA has them.
        subject: regular expression; the first of its groups that matches a stem names whom the mesh shows.

    Returns:
        The scans in the order of their names, and the faces (F, 3) of the model.

    Raises:
        InputError: when something is missing or the meshes do not correspond.
    """
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES) if folder.is_dir() else []
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
        metres, stature = _measures(model, vertices, shape)
        scans.append(FittedScan(path.stem, _subject(subject, path.stem), scan, vertices, truth, metres, stature))
    return scans, model.faces


def scan_pairs(scans: Sequence[FittedScan], every: bool, inter: bool) -> Iterator[tuple[FittedScan, FittedScan]]:
    """Pairs of each scan with the first of its subject, or `every` ordered pair of a subject; `inter`: of two subjects.

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


def pair_error(a: FittedScan, b: FittedScan, faces: np.ndarray) -> PairError:
    """Map scan A to scan B through their fits and compare with the true places."""
    found = correspond(a.vertices, b.vertices, faces, a.scan, b.scan)[0]
    error = np.linalg.norm(found[a.truth] - b.scan.points[b.truth], axis=1) * b.metres
    return PairError(a.name, b.name, a.subject == b.subject, error, b.stature)


def summary(pairs: Sequence[PairError]) -> dict[str, float]:
    """Figures over pairs: centimetres, percent of the stature, and the share of points within distances."""
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


def cumulative(pairs: Sequence[PairError], limits: np.ndarray) -> np.ndarray:
    """Percent (L,) of all points whose error is at most `limits` (L,) metres."""
    points = np.sort(np.concatenate([pair.error for pair in pairs]))
    return 100 * np.searchsorted(points, limits, side="right") / len(points)


def _measures(model: StitchedPuppet, vertices: np.ndarray, shape: np.ndarray) -> tuple[float, float]:
    """Length of the unit of fitted `vertices` (V, 3) in metres, and the person's stature in metres.

    Edges keep their length from pose to pose, so their mean tells the unit.
    """
    rest = model.rest_state()
    rest.shape[:] = shape
    standing = model.vertices(rest)
    edges = model.faces[:, :2]
    lengths = [np.linalg.norm(mesh[edges[:, 0]] - mesh[edges[:, 1]], axis=1).mean() for mesh in (standing, vertices)]
    return float(lengths[0] / lengths[1]), float(np.ptp(standing[:, 2]))


def _subject(pattern: str, stem: str) -> str:
    try:
        match = re.match(pattern, stem)
    except re.error as error:
        raise InputError(f"--subject {pattern!r} is no regular expression: {error}") from error
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
        raise InputError(f"{path} is no fit; make it with `flowing-puppet fit`") from error


def _read_vts(path: Path, points: int) -> np.ndarray:
    try:
        rows = np.atleast_1d(np.loadtxt(path, dtype=np.int64)) - 1
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as vertex numbers, one a line: {error}") from error
    if rows.ndim != 1 or not len(rows) or rows.min() < 0 or rows.max() >= points:
        raise InputError(f"{path} does not hold numbers from 1 to {points}, the vertices of its mesh")
    return np.asarray(rows)
