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
POINT_KEYS = ("vertices", "points", "xyz", "verts", "pts", "positions", "pos", "cloud", "pc", "v")
"""Names of the points in .npz, by precedence; upper and lower case are the same."""
FACE_KEYS, NORMAL_KEYS = ("faces", "triangles", "tris", "f"), ("normals", "normal")
OTHER_KEYS = re.compile(r"colou?r|rgb|normal|face|triangle|joint|uv", re.IGNORECASE)
"""Names in .npz that are no points, whatever their shape."""
MAX_COLUMNS = 16  # a table with more columns than rows is transposed
MAX_LENGTH_ERROR, MIN_UNIT_SHARE = 0.05, 0.9
"""Departure from length 1 up to which a row is a unit vector, and the share of such rows from which three columns are
normals; colours have other lengths, or no negative numbers."""
BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
MAX_COORDINATE_M, MAX_RING = 2000.0, 255  # of a LiDAR's scan
LIDAR_WIDTHS = (5, 4, 6, 3)  # numbers of a point, the first of equals counts
MAX_HEADING_LINES = 30
BRACKETS = str.maketrans("", "", "()[]{}\"'")
OTHER_AXES = {"easting": "x", "northing": "y", "height": "z", "elevation": "z", "altitude": "z"}
AXIS_WORD = re.compile(
    r"(?:(?:points?|pos|position|coords?|coordinates?|location|p|vertex)[\W_]*)?([xyz012])(?:_?m{1,2})?"
)
"""A name of a column of coordinates, without what is in brackets: x, point.x, pos_y, "Points:0", z [mm]."""
NAN_WORDS = {"nan", "inf", "infinity", "null", "none", "n/a", "na"}

Arrays = tuple[np.ndarray, np.ndarray | None]


def read_text_file(path: Path) -> str:
    """Read text with or without a byte order mark; bytes that are no text are replaced."""
    data = path.read_bytes()
    encoding = next((name for bom, name in BOMS.items() if data.startswith(bom)), "utf-8")
    return data.decode(encoding, errors="replace")


def read_text_table(path: Path) -> Arrays:
    """Read points (N, 3) and normals (N, 3) or None from lines of numbers.

    Spaces, commas, semicolons and tabs separate; brackets and quotes are passed over. Lines of titles, comments, column
    names and a count of the points before the first point are skipped; the names say which columns are x, y and z.

    Raises:
        InputError: when a line of the table cannot be read, or the columns have names but none is x, y and z.
    """
    heading, lines = _split_heading(read_text_file(path).splitlines())
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
    return split_columns(_order_columns(table, heading, path), path)


def _split_heading(lines: list[str]) -> tuple[list[str], list[str]]:
    """Return the lines before the first that holds nothing but numbers, and those from there on without comments."""
    first = next((k for k, line in enumerate(lines[:MAX_HEADING_LINES]) if _is_row(line)), 0)
    rows = [line for text in lines[first:] if (line := re.split("[#%]", text)[0].strip())]
    return [line.strip() for line in lines[:first] if line.strip()], rows


def _is_row(line: str) -> bool:
    """Return whether a line holds nothing but numbers."""
    words = re.split(r"[\s,;]+", re.split("[#%]", line)[0].translate(BRACKETS).strip(" \t,;"))
    return all(word.lower().lstrip("+-") in NAN_WORDS or _is_number(word) for word in words)


def _is_number(word: str) -> bool:
    try:
        float(re.sub("[dD]", "e", word))
    except ValueError:
        return False
    return True


def _order_columns(table: np.ndarray, heading: list[str], path: Path) -> np.ndarray:
    """Return the table with x, y and z first, as the last line of names in the heading says.

    InputError when that line names all columns of a wider table, none of them x, y and z.
    """
    for line in reversed(heading):
        text = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", line).lower().strip("#%/;! \t")
        separator = next((sign for sign in ("\t", ";", ",") if sign in text), None)
        names = [name.strip(" \"'") for name in text.split(separator)]
        axes = [_name_axis(name) for name in names]
        if len(names) != table.shape[1]:
            continue
        if all(axis in axes for axis in "xyz"):
            first = [axes.index(axis) for axis in "xyz"]
            return table[:, first + [column for column in range(len(names)) if column not in first]]
        if table.shape[1] > 3 and not all(_is_number(name) for name in names):
            raise InputError(f"{path} has the columns {', '.join(names)}; call those of the coordinates x, y and z")
    return table


def _name_axis(name: str) -> str:
    """Return x, y or z for the name of a column of coordinates, "" for any other."""
    if name in OTHER_AXES:
        return OTHER_AXES[name]
    match = AXIS_WORD.fullmatch(name.strip())
    return match[1].translate(str.maketrans("012", "xyz")) if match and name not in ("0", "1", "2") else ""


def _separate(lines: list[str]) -> list[str]:
    """Return lines whose numbers are separated by spaces, and whose decimal sign is a point."""
    text = "\n".join(lines[:50])
    if any(sign in text for sign in "()[]{}\"'"):
        lines = [line.translate(BRACKETS) for line in lines]
        text = "\n".join(lines[:50])
    if re.search(r"\d[dD][+-]?\d", text):
        lines = [re.sub(r"(?<=[\d.])[dD](?=[+-]?\d)", "e", line) for line in lines]
    if "." not in text and re.search(r"^\s*[+-]?\d+,\d+,\s+[+-]?\d+,\d", text, re.MULTILINE):
        return [re.sub(r",(?=\s|$)", " ", line).replace(",", ".") for line in lines]
    if ";" in text or (re.search(r"\d,\d+\s+-?\d+,\d", text) and "." not in text):
        return [line.replace(";", " ").replace(",", "." if "." not in text else " ") for line in lines]
    return [line.replace(",", " ") for line in lines]


def read_numpy(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Read points (N, 3), normals (N, 3) or None and faces (F, 3) or None; arrays of objects are passed over.

    Raises:
        InputError: when the file cannot be read or does not say which array has the points.
    """
    arrays, skipped = _load_arrays(path)
    key = next((name for key in POINT_KEYS for name in arrays if name.lower() == key), None)
    columns = [arrays[name] for name in "xyz" if name in arrays and arrays[name].ndim == 1]
    if key is None and len(columns) == 3 and len({len(column) for column in columns}) == 1:
        key, arrays["points"] = "points", np.stack(columns, axis=1)
    if key is None:
        tables = [name for name, array in arrays.items() if _may_be_points(array) and not OTHER_KEYS.search(name)]
        if len(tables) != 1:
            listed = ", ".join([*arrays, *(f"{name} (pickled)" for name in skipped)])
            raise InputError(f"{path} has the arrays {listed}; call the (N, 3) one points")
        key = tables[0]
    points, normals = split_columns(arrays[key], path)
    known = {name.lower(): array for name, array in arrays.items()}
    faces = next((known[name] for name in FACE_KEYS if name in known), np.empty(0))
    if faces.ndim == 2 and faces.shape[1] == 3 and len(faces):
        return points, None, faces.astype(np.int64)
    given = next((known[name] for name in NORMAL_KEYS if name in known), np.empty(0))
    if given.ndim == 2 and given.shape != points.shape and given.T.shape == points.shape:
        given = given.T
    return points, given if given.shape == points.shape else normals, None


def _load_arrays(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the arrays by name, and the names of those that hold pickled objects."""
    arrays, skipped = dict[str, np.ndarray](), list[str]()
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            if not isinstance(loaded, np.lib.npyio.NpzFile):  # whatever the file is called
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
    if array.dtype.names is not None or (array.ndim == 3 and array.shape[2] in (3, 4, 6)):
        return True
    return array.ndim == 2 and (array.shape[1] in (3, 4, 6) or array.shape[0] == 3)


def read_lidar_scan(path: Path) -> Arrays:
    """Read points (N, 3) from raw little-endian float32: x y z and up to three more numbers a point.

    KITTI has a reflectance, nuScenes an intensity and a ring, others a time too. Of the widths that give coordinates of
    a scan the one counts in which every column resembles itself most from point to point.

    Raises:
        InputError: when no layout gives coordinates of a LiDAR's scan.
    """
    data = path.read_bytes()
    fitting = [width for width in LIDAR_WIDTHS if _is_lidar_scan(data, width)]
    if not fitting:
        raise InputError(
            f"{path} is not a LiDAR scan of float32 x y z reflectance (KITTI) or x y z intensity ring (nuScenes);"
            " convert it to .pcd or .ply"
        )
    values = np.frombuffer(data, dtype="<f4")
    width = min(fitting, key=lambda width: _measure_unlikeness(values, width))
    return values.reshape(-1, width)[:, :3].astype(np.float64), None


def _is_lidar_scan(data: bytes, width: int) -> bool:
    """Return whether so many numbers a point give coordinates, an intensity and a ring."""
    if not data or len(data) % (4 * width):
        return False
    table = np.frombuffer(data, dtype="<f4").reshape(-1, width)
    finite = table[np.isfinite(table).all(axis=1)]
    if len(finite) < len(table) / 2 or np.abs(finite[:, :3]).max() > MAX_COORDINATE_M:
        return False
    if width == 5 and np.any((finite[:, 4] != np.round(finite[:, 4])) | (np.abs(finite[:, 4]) > MAX_RING)):
        return False
    return width == 3 or bool(finite[:, 3].min() >= 0)


def _measure_unlikeness(values: np.ndarray, width: int) -> float:
    """Return the mean difference between the numbers of neighbouring points.

    In a wrong layout it is that between coordinates, reflectances and rings.
    """
    table = values.reshape(-1, width).astype(np.float64)
    table = table[np.isfinite(table).all(axis=1)]
    return float(np.abs(np.diff(table, axis=0)).mean(axis=0).sum() / width)


def split_columns(table: np.ndarray, path: Path) -> Arrays:
    """Return the points (N, 3) in the first columns of a table, and the normals (N, 3) in the others or None.

    Normals are three columns of unit vectors with both signs; other columns are colours, intensities and the like.
    (3, N) tables, (H, W, 3) and (3, H, W) grids and structured arrays with the fields x, y and z are read alike.

    Raises:
        InputError: when it is no table of numbers with three columns.
    """
    if table.dtype.names:
        table = _join_fields(table)
    if not table.size:
        return np.empty((0, 3)), None
    shape = table.shape
    if table.ndim == 3 and 3 <= shape[2] <= MAX_COLUMNS:
        table = table.reshape(-1, shape[2])
    elif table.ndim == 3 and 3 <= shape[0] <= MAX_COLUMNS:
        table = table.reshape(shape[0], -1).T
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


def _join_fields(table: np.ndarray) -> np.ndarray:
    """Return the columns of a structured array, x, y and z first; the array itself where it has none of that name."""
    names = {name.lower(): name for name in table.dtype.names or ()}
    whole = next((names[key] for key in POINT_KEYS if key in names and table.dtype[names[key]].shape == (3,)), None)
    if whole is not None:
        return np.asarray(table[whole].reshape(-1, 3), dtype=np.float64)
    if not {"x", "y", "z"} <= set(names):
        return table
    rest = [name for name in names if name not in "xyz" and table.dtype[names[name]].kind in "fiu"]
    columns = [np.ravel(table[names[name]]) for name in [*"xyz", *rest] if table.dtype[names[name]].shape == ()]
    return np.stack([column.astype(np.float64) for column in columns], axis=1)


def _are_normals(columns: np.ndarray) -> bool:
    length = np.linalg.norm(columns, axis=1)
    unit = np.abs(length - 1) < MAX_LENGTH_ERROR
    return bool(unit.mean() >= MIN_UNIT_SHARE and columns[unit].min() < 0)
