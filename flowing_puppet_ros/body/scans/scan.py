# SPDX-License-Identifier: Apache-2.0
"""Reads meshes and clouds from .ply .obj .off .stl .pcd .xyz .npy .npz, and writes .ply."""

from __future__ import annotations

import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.scans.obj_off import read_obj, read_off
from flowing_puppet_ros.body.scans.ply import read_ply
from flowing_puppet_ros.errors import InputError

SUFFIXES = (".ply", ".obj", ".off", ".stl", ".pcd", ".xyz", ".npy", ".npz")
POINT_KEYS = ("vertices", "points", "xyz")  # names of the points in .npz, by precedence


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A mesh or a cloud in the file's own frame and unit.

    Attributes:
        points: (N, 3) float64 vertices in the file's order.
        faces: (F, 3) int64 outward, or None for a cloud.
        normals: (N, 3) unit normals of a cloud or None.
    """

    points: np.ndarray
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None

    @property
    def area(self) -> float | None:
        """Surface area of a mesh in squared units, None for a cloud."""
        return None if self.faces is None else float(self._face_areas().sum())

    def _face_areas(self) -> np.ndarray:
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))  # type: ignore[index]
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def sample_surface(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        """Sample points (`count`, 3) evenly over a mesh, with their faces' normals; return a cloud as it is."""
        if self.faces is None:
            return self.points, self.normals
        share = np.cumsum(self._face_areas())
        chosen = self.faces[np.searchsorted(share / share[-1], rng.random(count), side="right")]
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = (self.points[chosen[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        return a + u * (b - a) + v * (c - a), cross / np.linalg.norm(cross, axis=1, keepdims=True)

    def vertex_normals(self) -> np.ndarray | None:
        """Return the unit normals (N, 3) at the points, None for a cloud without normals."""
        return self.normals if self.faces is None else vertex_normals(self.points, self.faces)


def read_scan(path: Path) -> Scan:
    """Read a mesh or cloud; points of clouds that are not finite are dropped.

    Raises:
        InputError: when the file is missing, of another kind, damaged, or holds no points.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file; give a mesh or cloud ({' '.join(SUFFIXES)})")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path} ends in {suffix or 'nothing'}, which is none of {' '.join(SUFFIXES)}; convert it first"
        )
    if suffix in (".npy", ".npz"):
        scan = _read_numpy(path)
    elif suffix in (".obj", ".off"):
        vertices, faces = (read_obj if suffix == ".obj" else read_off)(path)
        scan = Scan(vertices, faces if len(faces) else None)
    elif suffix == ".ply":
        vertices, normals, faces = read_ply(path)
        scan = (
            Scan(vertices, faces)
            if len(faces)
            else Scan(vertices, None, None if normals is None else _normalise(normals))
        )
    elif suffix == ".xyz":
        scan = _read_text(path)
    else:
        scan = _read_open3d(path)
    return _validate(scan, path)


def _validate(scan: Scan, path: Path) -> Scan:
    if not len(scan.points):
        raise InputError(f"{path} holds no points or is damaged; export it again and check that it is complete")
    finite = np.isfinite(scan.points).all(axis=1)
    if scan.faces is None:
        if not finite.any():
            raise InputError(f"{path} holds {len(scan.points)} points, none of which is finite; export it again")
        return Scan(scan.points[finite], None, None if scan.normals is None else scan.normals[finite])
    if not finite.all():
        raise InputError(f"{path} has a vertex {int(np.argmin(finite))} that is not finite; repair the mesh")
    if scan.faces.min() < 0 or scan.faces.max() >= len(scan.points):
        raise InputError(
            f"{path} has a face that names vertex {scan.faces.max()} of {len(scan.points)}; repair the mesh"
        )
    if not scan.area:
        raise InputError(f"{path} has {len(scan.faces)} faces without any area; repair the mesh")
    return Scan(scan.points, _orient_outward(scan.points, scan.faces))


def _orient_outward(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flip all faces when the volume that they enclose is negative."""
    a, b, c = (points[faces[:, k]] - points.mean(axis=0) for k in range(3))
    return faces if (np.cross(a, b) * c).sum() >= 0 else faces[:, ::-1].copy()


def _read_open3d(path: Path) -> Scan:
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    if path.suffix.lower() != ".pcd":
        mesh = o3d.io.read_triangle_mesh(path)
        if len(mesh.triangles):
            return Scan(np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64))
    cloud = o3d.io.read_point_cloud(path)
    return Scan(
        np.asarray(cloud.points).copy(), None, _normalise(np.asarray(cloud.normals)) if cloud.has_normals() else None
    )


def _read_text(path: Path) -> Scan:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a table of x y z [nx ny nz] lines: {error}") from error
    return _from_table(table, path)


def _read_numpy(path: Path) -> Scan:
    try:
        loaded = np.load(path, allow_pickle=False)
        arrays = {key: loaded[key] for key in loaded.files} if path.suffix.lower() == ".npz" else {"points": loaded}
    except (ValueError, OSError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} cannot be read as a NumPy file; save it again without pickled objects") from error
    key = next((key for key in POINT_KEYS if key in arrays), None)
    if key is None:
        tables = [name for name, array in arrays.items() if array.ndim == 2 and array.shape[1] in (3, 4, 6)]
        if len(tables) != 1:
            raise InputError(f"{path} has the arrays {', '.join(arrays)}; call the (N, 3) one points")
        key = tables[0]
    scan = _from_table(arrays[key], path)
    if "faces" in arrays and arrays["faces"].ndim == 2 and arrays["faces"].shape[1] == 3 and len(arrays["faces"]):
        return Scan(scan.points, arrays["faces"].astype(np.int64))
    normals = arrays.get("normals", np.empty(0))
    return Scan(scan.points, None, _normalise(normals) if normals.shape == scan.points.shape else scan.normals)


def _from_table(table: np.ndarray, path: Path) -> Scan:
    """Take points from columns 0 to 2 and, where there are six columns, normals from the others."""
    if not table.size:
        return Scan(np.empty((0, 3)))
    if table.dtype.kind not in "fiu" or table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path} holds an array of {table.dtype} and shape {table.shape}, not numbers of shape (N, 3)")
    table = table.astype(np.float64)
    return Scan(table[:, :3].copy(), None, _normalise(table[:, 3:6]) if table.shape[1] == 6 else None)


def _normalise(normals: np.ndarray) -> np.ndarray | None:
    """Return the normals (N, 3) at unit length, or None when one is missing."""
    normals = np.asarray(normals, dtype=np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / length if len(normals) and np.all(np.isfinite(length) & (length > 0)) else None


def to_smallest_float(points: np.ndarray) -> np.ndarray:
    """Return points (N, 3) as float32, or as float64 where float32 would move them by more than 1e-5 of their extent.

    The latter happens far from the origin, for example to people in the frame of a map.
    """
    points = np.asarray(points, dtype=np.float64)
    if not points.size:
        return points.astype(np.float32)
    step = float(np.spacing(np.float32(np.abs(points).max())))
    return points if step > 1e-5 * float(np.ptp(points, axis=0).max()) else points.astype(np.float32)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None = None) -> None:
    """Write a binary PLY mesh.

    Args:
        path: file to write.
        vertices: (V, 3) in any frame and unit.
        faces: (F, 3).
        colours: (V, 3) RGB, 0 to 255, or None.
    """
    vertices = to_smallest_float(vertices)
    kind = f"<f{vertices.itemsize}"
    fields: list[tuple[str, str]] = [("x", kind), ("y", kind), ("z", kind)]
    if colours is not None:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    rows = np.zeros(len(vertices), dtype=fields)
    for name, column in zip(("x", "y", "z"), vertices.T, strict=True):
        rows[name] = column
    if colours is not None:
        for name, column in zip(("red", "green", "blue"), np.asarray(colours).T, strict=True):
            rows[name] = column
    triangles = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    triangles["count"], triangles["index"] = 3, faces
    types = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {types[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes() + triangles.tobytes())
