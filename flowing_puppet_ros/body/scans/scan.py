# SPDX-License-Identifier: Apache-2.0
"""Reads meshes and clouds from files of many kinds, and writes .ply."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowing_puppet_ros.body.cloud.mesh_geometry import vertex_normals
from flowing_puppet_ros.body.scans.formats.gltf import read_gltf
from flowing_puppet_ros.body.scans.formats.obj_off import read_obj, read_off
from flowing_puppet_ros.body.scans.formats.pcd import read_pcd
from flowing_puppet_ros.body.scans.formats.ply import read_ply
from flowing_puppet_ros.body.scans.formats.stl import read_stl
from flowing_puppet_ros.body.scans.formats.tables import read_lidar_scan, read_numpy, read_text_table
from flowing_puppet_ros.body.scans.names import SUFFIXES
from flowing_puppet_ros.errors import InputError

MESH_READERS = {".obj": read_obj, ".off": read_off, ".stl": read_stl, ".glb": read_gltf, ".gltf": read_gltf}
"""Readers of vertices and triangles by suffix."""
PACKED = {
    ".gz": "gunzip -k", ".zip": "unzip", ".bz2": "bunzip2 -k", ".xz": "unxz -k", ".zst": "unzstd", ".lz4": "unlz4",
}  # fmt: skip
LFS_POINTER = b"version https://git-lfs"


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A mesh or a cloud in the file's own frame and unit.

    Attributes:
        points: (N, 3) float64 vertices in the file's order.
        faces: (F, 3) int64 outward, or None for a cloud.
        normals: (N, 3) unit normals of a cloud or None.
        viewpoint: (3,) position of the sensor that the file names, or None.
    """

    points: np.ndarray
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None
    viewpoint: np.ndarray | None = None

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
    """Read a mesh or cloud; points that are not finite and in no face are dropped.

    Raises:
        InputError: when the file is missing, of another kind, damaged, or holds no points.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a file; give a mesh or cloud ({' '.join(SUFFIXES)})")
    suffix = path.suffix.lower()
    _refuse_other_files(path)
    if suffix in (".npy", ".npz"):
        vertices, normals, triangles = read_numpy(path)
        scan = Scan(vertices, triangles, None if normals is None else _normalise(normals))
    elif suffix in MESH_READERS:
        vertices, faces = MESH_READERS[suffix](path)
        scan = Scan(vertices, faces if len(faces) else None)
    elif suffix == ".pcd":
        cloud = read_pcd(path)
        scan = Scan(cloud.points, None, _normalise_known(cloud.points, cloud.normals), cloud.viewpoint)
    elif suffix == ".ply":
        vertices, normals, faces = read_ply(path)
        scan = (
            Scan(vertices, faces)
            if len(faces)
            else Scan(vertices, None, None if normals is None else _normalise(normals))
        )
    else:
        vertices, normals = (read_lidar_scan if suffix == ".bin" else read_text_table)(path)
        scan = Scan(vertices, None, None if normals is None else _normalise(normals))
    return _validate(scan, path)


def _validate(scan: Scan, path: Path) -> Scan:
    if not len(scan.points):
        raise InputError(f"{path} holds no points or is damaged; export it again and check that it is complete")
    finite = np.isfinite(scan.points).all(axis=1)
    if scan.faces is None:
        if not finite.any():
            raise InputError(f"{path} holds {len(scan.points)} points, none of which is finite; export it again")
        points, normals = scan.points[finite], None if scan.normals is None else scan.normals[finite]
        if not np.ptp(points, axis=0).any():
            raise InputError(f"{path} holds {len(points)} points, all in the same place; export it again")
        return Scan(points, None, normals, scan.viewpoint)
    if scan.faces.min() < 0 or scan.faces.max() >= len(scan.points):
        raise InputError(
            f"{path} has a face that names vertex {scan.faces.max()} of {len(scan.points)}; repair the mesh"
        )
    if not scan.area:
        raise InputError(f"{path} has {len(scan.faces)} faces without any area; repair the mesh")
    points, faces = _drop_unused_vertices(scan.points, scan.faces, finite, path)
    return Scan(points, _orient_outward(points, faces))


def _drop_unused_vertices(
    points: np.ndarray, faces: np.ndarray, finite: np.ndarray, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Drop the vertices that are not finite; InputError when a face has one."""
    if finite.all():
        return points, faces
    used = np.zeros(len(finite), dtype=bool)
    used[faces] = True
    if not finite[used].all():
        raise InputError(f"{path} has a vertex {int(np.argmax(used & ~finite))} that is not finite; repair the mesh")
    return points[finite], (np.cumsum(finite) - 1)[faces]


def _orient_outward(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flip all faces when the volume that they enclose is negative."""
    a, b, c = (points[faces[:, k]] - points.mean(axis=0) for k in range(3))
    return faces if (np.cross(a, b) * c).sum() >= 0 else faces[:, ::-1].copy()


def _refuse_other_files(path: Path) -> None:
    """Raise InputError when a file is of a kind that is not read."""
    suffix = path.suffix.lower()
    if suffix in PACKED:
        raise InputError(f"{path} is packed; unpack it first: {PACKED[suffix]} {path}")
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path} ends in {suffix or 'nothing'}, which is none of {' '.join(SUFFIXES)}; convert it first, for"
            " example with CloudCompare or MeshLab to .ply"
        )
    with path.open("rb") as file:
        if file.read(len(LFS_POINTER)) == LFS_POINTER:
            raise InputError(f"{path} is only a pointer to a file of Git LFS; get the file itself: git lfs pull")


def _normalise_known(points: np.ndarray, normals: np.ndarray | None) -> np.ndarray | None:
    """Return the unit normals (N, 3) where points are finite, or None when one of these is missing."""
    if normals is None:
        return None
    known = np.isfinite(points).all(axis=1)
    unit = _normalise(normals[known])
    if unit is None:
        return None
    filled = np.zeros_like(points)
    filled[known] = unit
    return filled


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
