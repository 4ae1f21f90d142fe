# SPDX-License-Identifier: Apache-2.0
"""Files as other programs write them: columns of colours, byte order marks, counts, transposed and raw arrays."""

from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scan import Scan, read_scan
from flowing_puppet_ros.errors import InputError

RNG = np.random.default_rng(0)
POINTS = np.round(RNG.normal(size=(40, 3)), 4)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
BYTES = RNG.integers(0, 256, (40, 3)).astype(float)
RED = np.tile([1.0, 0.0, 0.0], (40, 1))
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)


def save(path: Path, table: np.ndarray) -> Scan:
    """Write a table by its suffix and read it back."""
    np.save(path, table) if path.suffix == ".npy" else np.savetxt(path, table)
    return read_scan(path)


@pytest.mark.parametrize("name", ["a.npy", "a.xyz", "a.txt", "a.asc"])
@pytest.mark.parametrize("colours", [BYTES, BYTES / 255, RED, -NORMALS * 7], ids=["bytes", "unit", "red", "velocity"])
def test_what_is_no_unit_vector_of_both_signs_is_no_normal(tmp_path: Path, name: str, colours: np.ndarray) -> None:
    scan = save(tmp_path / name, np.hstack([POINTS, colours]))
    np.testing.assert_allclose(scan.points, POINTS)
    assert scan.normals is None


@pytest.mark.parametrize("before", [0, 1, 3])
def test_normals_are_found_after_intensities_and_colours(tmp_path: Path, before: int) -> None:
    scan = save(tmp_path / "a.txt", np.hstack([POINTS, BYTES[:, :before], NORMALS]))
    assert scan.normals is not None
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-6)


def lines(separator: str = " ", decimal: str = ".") -> str:
    return "\n".join(separator.join(map(str, row)) for row in POINTS.tolist()).replace(".", decimal) + "\n"


TEXTS = {
    "a byte order mark": "\ufeff" + lines(),
    "a count": f"40\n{lines()}",
    "a count and a comment": f"40\n# from a scanner\n{lines()}",
    "names of columns": f"X,Y,Z\n{lines(',')}",
    "quoted names": f'"x";"y";"z"\n{lines(";")}',
    "a comment of slashes": f"//X Y Z\n{lines()}",
    "commas and spaces": lines(", "),
    "tabs and windows lines": lines("\t").replace("\n", "\r\n"),
    "decimal commas": lines(" ", ","),
    "decimal commas and semicolons": lines(";", ","),
    "decimal commas and commas": lines(", ", ","),
    "a title": f"Scan of the second of March\n\n{lines()}",
    "comments of percent": f"% a scan\n{lines()}% the end\n",
    "names with units": f"x[m];y[m];z[m]\n{lines(';')}",
    "names of a table of points": f'"Points:0","Points:1","Points:2"\n{lines(",")}',
    "names of maps": f"Easting,Northing,Height\n{lines(',')}",
    "brackets": "\n".join(f"[{line}]," for line in lines(", ").splitlines()),
    "quotes": "\n".join('"{}","{}","{}"'.format(*row) for row in POINTS.tolist()),
    "exponents of Fortran": "\n".join(" ".join(f"{number:.6E}".replace("E", "D") for number in row) for row in POINTS),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_text_of_other_programs(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.csv").write_text(TEXTS[kind], encoding="utf-8", newline="")
    np.testing.assert_allclose(read_scan(tmp_path / "a.csv").points, POINTS)
    (tmp_path / "b.xyz").write_text(TEXTS[kind].lstrip("\ufeff"), encoding="utf-16", newline="")
    np.testing.assert_allclose(read_scan(tmp_path / "b.xyz").points, POINTS)


def test_columns_are_taken_by_their_names(tmp_path: Path) -> None:
    rows = "\n".join(f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(POINTS.tolist()))
    (tmp_path / "a.txt").write_text(f"// id x y z\n{rows}\n")
    np.testing.assert_allclose(read_scan(tmp_path / "a.txt").points, POINTS)


@pytest.mark.parametrize("heading", ["time,x,y,z", "# time x y z", "time;pos_x [m];pos_y [m];pos_z [m]", "t,X,Y,Z"])
def test_names_say_which_columns_are_coordinates(tmp_path: Path, heading: str) -> None:
    rows = "\n".join(",".join(map(str, (k / 7, *row))) for k, row in enumerate(POINTS.tolist()))
    (tmp_path / "a.csv").write_text(f"{heading}\n{rows}\n")
    np.testing.assert_allclose(read_scan(tmp_path / "a.csv").points, POINTS)


def test_columns_of_other_names_are_not_guessed(tmp_path: Path) -> None:
    rows = "\n".join(",".join(map(str, (k / 7, *row))) for k, row in enumerate(POINTS.tolist()))
    (tmp_path / "a.csv").write_text(f"t,north,east,down\n{rows}\n")
    with pytest.raises(InputError, match="the columns t, north, east, down; call those of the coordinates x, y and z"):
        read_scan(tmp_path / "a.csv")


def test_arrays_of_other_shapes(tmp_path: Path) -> None:
    fields = np.zeros(40, dtype=[("intensity", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8"), ("rgb", "u4")])
    for name, column in zip("xyz", POINTS.T, strict=True):
        fields[name] = column
    shapes = {
        "transposed": POINTS.T,
        "homogeneous": np.vstack([POINTS.T, np.ones(40)]),
        "organised": POINTS.reshape(5, 8, 3),
        "channels first": np.moveaxis(POINTS[:34].reshape(2, 17, 3), 2, 0),
        "structured": fields,
        "upper case": fields.view([(name.upper(), fields.dtype[name]) for name in fields.dtype.names or ()]),
        "big endian": fields.astype([(name, ">f8") for name in fields.dtype.names or ()]),
        "grouped": np.array([(row, 1) for row in POINTS.tolist()], dtype=[("xyz", "f8", 3), ("label", "u1")]),
        "normals": np.hstack([POINTS, NORMALS]).T,
    }
    for name, array in shapes.items():
        scan = save(tmp_path / f"{name}.npy", array)
        np.testing.assert_allclose(scan.points, POINTS[: len(scan.points)], err_msg=name)
        assert len(scan.points) == (34 if name == "channels first" else 40)
        assert (scan.normals is not None) == (name == "normals")


def test_archives_with_objects_and_colours_beside_the_points(tmp_path: Path) -> None:
    meta = np.array([{"sensor": "a"}], dtype=object)
    np.savez(tmp_path / "a.npz", points=POINTS.T, normals=NORMALS.T, meta=meta)
    scan = read_scan(tmp_path / "a.npz")
    np.testing.assert_allclose(scan.points, POINTS)
    assert scan.normals is not None
    np.testing.assert_allclose(scan.normals, NORMALS)
    np.savez(tmp_path / "b.npz", scan=POINTS, colors=BYTES, meta=meta)
    np.testing.assert_allclose(read_scan(tmp_path / "b.npz").points, POINTS)
    for name, arrays in {
        "short names": {"v": POINTS, "f": np.array([[0, 1, 2], [1, 2, 3]])},
        "columns": dict(zip("xyz", POINTS.T, strict=True)),
        "upper case": {"Points": POINTS},
        "a grid": {"lidar": POINTS.reshape(5, 8, 3)},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
        np.testing.assert_allclose(read_scan(tmp_path / f"{name}.npz").points, POINTS, err_msg=name)
    np.savez(tmp_path / "c.npz", points=meta)
    with pytest.raises(InputError, match=r"points \(pickled\)"):
        read_scan(tmp_path / "c.npz")


@pytest.mark.parametrize(
    ("width", "last"), [(4, RNG.random(40)), (5, RNG.integers(0, 32, 40)), (6, RNG.integers(0, 32, 40))]
)
def test_raw_lidar_scans(tmp_path: Path, width: int, last: np.ndarray) -> None:
    # 40 rows of five are also 50 rows of four, those of six 60.
    table = np.hstack([10 * POINTS, RNG.random((40, width - 4)) * 200, last[:, None]]).astype("<f4")
    (tmp_path / "a.bin").write_bytes(table.tobytes())
    np.testing.assert_allclose(read_scan(tmp_path / "a.bin").points, 10 * POINTS, rtol=1e-6)


@pytest.mark.parametrize("data", [b"", b"123", bytes(range(256)) * 4])
def test_other_binary_files_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(InputError, match="KITTI"):
        read_scan(tmp_path / "a.bin")


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.mark.parametrize(
    "text",
    ["\ufeff" + OBJ, OBJ.replace("f 2 3 4", "f 2 \\\n3 4"), OBJ.replace("f 2 3 4\n", "f 2/1 \\\r\n  3/1 4/1\r\n")],
    ids=["byte order mark", "continued", "continued on windows"],
)
def test_first_lines_and_continued_lines_of_obj(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.obj").write_text(text, encoding="utf-8", newline="")
    scan = read_scan(tmp_path / "a.obj")
    np.testing.assert_array_equal(scan.points, TETRAHEDRON)
    assert scan.faces is not None and scan.faces.tolist() == [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    (tmp_path / "a.off").write_text("\ufeffOFF\n4 0 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n", encoding="utf-8")
    np.testing.assert_array_equal(read_scan(tmp_path / "a.off").points, TETRAHEDRON)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_with_lists_at_its_vertices_and_unused_vertices_without_a_place(tmp_path: Path, form: str) -> None:
    vertices = np.insert(TETRAHEDRON, 1, np.nan, axis=0)
    faces = [[0, 3, 2], [0, 2, 4], [2, 3, 4], [0, 4, 3]]
    header = f"ply\nformat {form} 1.0\nelement vertex 5\nproperty float x\nproperty list uchar float weights\n"
    header += "property float y\nproperty float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
    body = b""
    for row, (x, y, z) in enumerate(vertices):
        if form == "ascii":
            body += f"{x} {row % 3} {'0.5 ' * (row % 3)}{y} {z}\n".encode()
        else:
            body += np.float32(x).tobytes() + bytes([row % 3]) + np.full(row % 3, 0.5, "<f4").tobytes()
            body += np.array([y, z], "<f4").tobytes()
    for face in faces:
        body += (
            f"3 {' '.join(map(str, face))}\n".encode() if form == "ascii" else b"\3" + np.array(face, "<i4").tobytes()
        )
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    scan = read_scan(tmp_path / "a.ply")
    np.testing.assert_array_equal(scan.points, TETRAHEDRON)
    assert scan.faces is not None and scan.faces.tolist() == [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]


def test_a_vertex_without_a_place_in_a_face_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ.replace("v 1 0 0", "v nan 0 0"))
    with pytest.raises(InputError, match="vertex 1 that is not finite"):
        read_scan(tmp_path / "a.obj")


def test_viewpoint_of_a_pcd(tmp_path: Path) -> None:
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\nHEIGHT 1\nVIEWPOINT {}\n"
    header += f"POINTS 40\nDATA ascii\n{lines()}"
    (tmp_path / "a.pcd").write_text(header.format("1.5 -2 0.25 1 0 0 0"))
    scan = read_scan(tmp_path / "a.pcd")
    np.testing.assert_allclose(scan.points, POINTS, atol=1e-6)
    np.testing.assert_array_equal(scan.viewpoint, [1.5, -2, 0.25])
    for words in ("0 0 0 1 0 0 0", "nan 0 0 1 0 0 0", "a b c", "1"):
        (tmp_path / "b.pcd").write_text(header.format(words))
        assert read_scan(tmp_path / "b.pcd").viewpoint is None
