# SPDX-License-Identifier: Apache-2.0
"""Readers of tables of points: text (.xyz .txt .csv .asc .pts), NumPy (.npy .npz) and raw LiDAR scans (.bin)."""

from __future__ import annotations

import codecs
import re
import warnings
import zipfile
from pathlib import Path

import numpy as np

from flowing_puppet_ros.errors import InputError

TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")
POINT_KEYS = ("vertices", "points", "xyz", "verts", "pts", "positions", "pos", "cloud", "pc")
"""Names of the points in .npz, by precedence."""
FACE_KEYS, NORMAL_KEYS = ("faces", "triangles"), ("normals", "normal")
OTHER_KEYS = re.compile(r"colou?r|rgb|normal|face|triangle|joint|uv", re.IGNORECASE)
"""Names in .npz that are no points, whatever their shape."""
MAX_COLUMNS = 16  # a table with more columns than rows is transposed
MAX_LENGTH_ERROR, MIN_UNIT_SHARE = 0.05, 0.9
"""Departure from length 1 up to which a row is a unit vector, and the share of such rows from which three columns are
normals; colours have other lengths, or no negative numbers."""
BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
MAX_COORDINATE_M, MAX_RING = 2000.0, 255  # of a LiDAR's scan
NAMED_COLUMN = re.compile(r"[A-Za-z_]\w*")

Arrays = tuple[np.ndarray, np.ndarray | None]


def read_text_file(path: Path) -> str:
    """Read text with or without a byte order mark; bytes that are no text are replaced."""
    data = path.read_bytes()
    encoding = next((name for bom, name in BOMS.items() if data.startswith(bom)), "utf-8")
    return data.decode(encoding, errors="replace")


def read_text_table(path: Path) -> Arrays:
    """Read points (N, 3) and normals (N, 3) or None from lines of numbers.

    Spaces, commas, semicolons and tabs separate. Lines of column names, comments and a count of the points before the
    first point are skipped.

    Raises:
        InputError: when a line of the table cannot be read.
    """
    lines = [line for text in read_text_file(path).splitlines() if (line := text.split("#")[0].strip())]
    names: list[str] = []
    while lines and _is_heading(lines[0]):
        names = NAMED_COLUMN.findall(lines.pop(0).lower())
    lines = _separate(lines)
    if len(lines) > 1 and len(lines[0].split()) == 1 < len(lines[1].split()):
        del lines[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            table = np.loadtxt(lines, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise InputError(f"{path} is not a table of x y z lines: {reason}; export it again as text") from None
    if len(names) == table.shape[1] and {"x", "y", "z"} <= set(names):
        first = [names.index(name) for name in "xyz"]
        table = table[:, first + [column for column in range(len(names)) if column not in first]]
    return split_columns(table, path)


def _is_heading(line: str) -> bool:
    """Return whether a line is a comment or names columns."""
    if line.startswith(("//", ";")):
        return True
    words = [word.strip("\"'") for word in re.split(r"[\s,;]+", line) if word]
    return {"x", "y", "z"} <= {word.lower() for word in words}


def _separate(lines: list[str]) -> list[str]:
    """Return lines whose numbers are separated by spaces, and whose decimal sign is a point."""
    text = "\n".join(lines[:50])
    if ";" in text or (re.search(r"\d,\d+\s+-?\d+,\d", text) and "." not in text):
        return [line.replace(";", " ").replace(",", "." if "." not in text else " ") for line in lines]
    return [line.replace(",", " ") for line in lines]


def read_numpy(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Read points (N, 3), normals (N, 3) or None and faces (F, 3) or None; arrays of objects are passed over.

    Raises:
        InputError: when the file cannot be read or does not say which array has the points.
    """
    arrays, skipped = _load_arrays(path)
    key = next((key for key in POINT_KEYS if key in arrays), None)
    if key is None:
        tables = [name for name, array in arrays.items() if _may_be_points(array) and not OTHER_KEYS.search(name)]
        if len(tables) != 1:
            listed = ", ".join([*arrays, *(f"{name} (pickled)" for name in skipped)])
            raise InputError(f"{path} has the arrays {listed}; call the (N, 3) one points")
        key = tables[0]
    points, normals = split_columns(arrays[key], path)
    faces = next((arrays[name] for name in FACE_KEYS if name in arrays), np.empty(0))
    if faces.ndim == 2 and faces.shape[1] == 3 and len(faces):
        return points, None, faces.astype(np.int64)
    given = next((arrays[name] for name in NORMAL_KEYS if name in arrays), np.empty(0))
    if given.ndim == 2 and given.shape != points.shape and given.T.shape == points.shape:
        given = given.T
    return points, given if given.shape == points.shape else normals, None


def _load_arrays(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the arrays by name, and the names of those that hold pickled objects."""
    arrays, skipped = dict[str, np.ndarray](), list[str]()
    try:
        loaded = np.load(path, allow_pickle=False)
        if path.suffix.lower() != ".npz":
            return {"points": loaded}, skipped
        for key in loaded.files:
            try:
                arrays[key] = loaded[key]
            except ValueError:
                skipped.append(key)
    except (ValueError, OSError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as a NumPy file; save it again without pickled objects") from error
    return arrays, skipped


def _may_be_points(array: np.ndarray) -> bool:
    return array.dtype.names is not None or (array.ndim == 2 and (array.shape[1] in (3, 4, 6) or array.shape[0] == 3))


def read_lidar_scan(path: Path) -> Arrays:
    """Read points (N, 3) from raw little-endian float32: x y z reflectance (KITTI), x y z intensity ring (nuScenes).

    Raises:
        InputError: when neither layout gives coordinates of a LiDAR's scan.
    """
    values = np.frombuffer(data := path.read_bytes(), dtype="<f4", count=path.stat().st_size // 4)
    for width in (5, 4, 3):
        if not len(data) or len(data) % (4 * width):
            continue
        table = values.reshape(-1, width)
        finite = table[np.isfinite(table).all(axis=1)]
        if len(finite) < len(table) / 2 or np.abs(finite[:, :3]).max() > MAX_COORDINATE_M:
            continue
        if width == 5 and np.any((finite[:, 4] != np.round(finite[:, 4])) | (np.abs(finite[:, 4]) > MAX_RING)):
            continue
        if width > 3 and finite[:, 3].min() < 0:
            continue
        return table[:, :3].astype(np.float64), None
    raise InputError(
        f"{path} is not a LiDAR scan of float32 x y z reflectance (KITTI) or x y z intensity ring (nuScenes); convert"
        " it to .pcd or .ply"
    )


def split_columns(table: np.ndarray, path: Path) -> Arrays:
    """Return the points (N, 3) in the first columns of a table, and the normals (N, 3) in the others or None.

    Normals are three columns of unit vectors with both signs; other columns are colours, intensities and the like.
    (3, N) tables, (H, W, 3) grids and structured arrays with the fields x, y and z are read alike.

    Raises:
        InputError: when it is no table of numbers with three columns.
    """
    if table.dtype.names and {"x", "y", "z"} <= set(table.dtype.names):
        rest = [name for name in table.dtype.names if name not in "xyz" and table.dtype[name].kind in "fiu"]
        columns = [np.ravel(table[name]) for name in [*"xyz", *rest] if table.dtype[name].shape == ()]
        table = np.stack([column.astype(np.float64) for column in columns], axis=1)
    if not table.size:
        return np.empty((0, 3)), None
    shape = table.shape
    if table.ndim == 3 and 3 <= shape[2] <= MAX_COLUMNS:
        table = table.reshape(-1, shape[2])
    if table.ndim == 2 and 3 <= shape[0] <= MAX_COLUMNS < shape[1]:
        table = table.T
    if table.dtype.kind not in "fiu" or table.ndim != 2 or table.shape[1] < 3:
        raise InputError(
            f"{path} holds an array of {table.dtype} and shape {shape}, not numbers of shape (N, 3); save x, y and z"
            " as its columns"
        )
    table = table.astype(np.float64)
    triples = (table[:, first : first + 3] for first in range(3, table.shape[1] - 2))
    return table[:, :3].copy(), next((triple for triple in triples if _are_normals(triple)), None)


def _are_normals(columns: np.ndarray) -> bool:
    length = np.linalg.norm(columns, axis=1)
    unit = np.abs(length - 1) < MAX_LENGTH_ERROR
    return bool(unit.mean() >= MIN_UNIT_SHARE and columns[unit].min() < 0)
