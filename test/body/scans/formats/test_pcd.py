# SPDX-License-Identifier: Apache-2.0
"""Files of the Point Cloud Library in every form: the same points, whatever else a point has."""

import struct
from pathlib import Path

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.formats.pcd import _unpack_lzf, read_pcd
from flowing_puppet_ros.body.scans.scan import read_scan
from flowing_puppet_ros.errors import InputError

RNG = np.random.default_rng(0)
POINTS = np.round(RNG.normal(size=(24, 3)), 4)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
FORMS = ("ascii", "binary", "binary_compressed")


def pcd(form: str, columns: dict[str, np.ndarray], extra: str = "", size: str = "WIDTH 24\nHEIGHT 1") -> bytes:
    """Write a .pcd, its compressed data as LZF of literals only; a column may have several numbers a point."""
    table = {name: column.reshape(len(column), -1) for name, column in columns.items()}
    kinds = [{"f": "F", "i": "I", "u": "U"}[column.dtype.kind] for column in table.values()]
    header = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(table)}\n"
    header += f"SIZE {' '.join(str(column.itemsize) for column in table.values())}\nTYPE {' '.join(kinds)}\n"
    header += f"COUNT {' '.join(str(column.shape[1]) for column in table.values())}\n{size}\n{extra}POINTS 24\n"
    rows = [b"".join(column[k].tobytes() for column in table.values()) for k in range(24)]
    if form == "ascii":
        text = [" ".join(str(number) for column in table.values() for number in column[k].tolist()) for k in range(24)]
        body = "\n".join(text).encode() + b"\n"
    elif form == "binary":
        body = b"".join(rows)
    else:
        raw = b"".join(column.tobytes() for column in table.values())
        pieces = [raw[k : k + 32] for k in range(0, len(raw), 32)]
        packed = b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)
        body = struct.pack("<II", len(packed), len(raw)) + packed
    return f"{header}DATA {form}\n".encode() + body


def columns(kind: str) -> dict[str, np.ndarray]:
    x, y, z = (column.astype(kind) for column in POINTS.T)
    return {
        "intensity": RNG.random(24).astype("<f4"),
        "x": x,
        "_": np.zeros((24, 4), "<u1"),
        "y": y,
        "z": z,
        "ring": np.arange(24, dtype="<u2"),
        "time": RNG.random(24),
    }


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_points_among_other_fields_in_any_form(tmp_path: Path, form: str, kind: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(form, columns(kind)))
    np.testing.assert_allclose(read_scan(tmp_path / "a.pcd").points, POINTS, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_organised_clouds_with_gaps_colours_and_normals(tmp_path: Path, form: str) -> None:
    gaps = POINTS.astype("<f4")
    gaps[[0, 5]] = np.nan
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    fields = dict(zip(names, np.hstack([gaps, NORMALS.astype("<f4")]).T.copy(), strict=True))
    fields["rgb"] = np.full(24, 200 << 16 | 30 << 8 | 60, "<u4").view("<f4")
    (tmp_path / "a.pcd").write_bytes(pcd(form, fields, "VIEWPOINT 0 1 0.5 1 0 0 0\n", "WIDTH 6\nHEIGHT 4"))
    cloud = read_pcd(tmp_path / "a.pcd")
    assert cloud.shape == (4, 6)
    assert cloud.rgb is not None and cloud.rgb[3].tolist() == [200, 30, 60]
    np.testing.assert_array_equal(np.isnan(cloud.points[:, 0]), np.isin(np.arange(24), [0, 5]))
    scan = read_scan(tmp_path / "a.pcd")
    np.testing.assert_allclose(scan.points, np.delete(POINTS, [0, 5], axis=0), atol=1e-6)
    assert scan.normals is not None
    np.testing.assert_allclose(scan.normals, np.delete(NORMALS, [0, 5], axis=0), atol=1e-6)
    np.testing.assert_array_equal(scan.viewpoint, [0, 1, 0.5])


def test_version_5_without_counts_and_windows_lines(tmp_path: Path) -> None:
    text = pcd("ascii", columns("<f8") | {"_": np.zeros(24, "<u1")}).decode()
    kept = [line for line in text.splitlines() if not line.startswith(("COUNT", "#", "VIEWPOINT"))]
    (tmp_path / "a.pcd").write_text("\n".join(kept).replace("VERSION 0.7", "VERSION .5"), newline="\r\n")
    np.testing.assert_allclose(read_scan(tmp_path / "a.pcd").points, POINTS)


def test_coordinates_of_a_map_keep_the_digits_that_text_has(tmp_path: Path) -> None:
    far = POINTS + np.array([431200.0, 5411220.0, 300.0])
    text = pcd("ascii", dict(zip("xyz", far.T, strict=True))).replace(b"SIZE 8 8 8", b"SIZE 4 4 4")
    (tmp_path / "a.pcd").write_bytes(text)
    np.testing.assert_allclose(read_scan(tmp_path / "a.pcd").points, far, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_cut_file_is_refused(tmp_path: Path, form: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(form, columns("<f4"))[:-40])
    with pytest.raises(InputError, match="ends early or is damaged"):
        read_scan(tmp_path / "a.pcd")


def test_a_cloud_without_heights_is_refused_by_its_fields(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd("binary", dict(zip("xy", POINTS.T[:2].copy(), strict=True))))
    with pytest.raises(InputError, match="has the fields x, y; x, y and z are needed"):
        read_scan(tmp_path / "a.pcd")


def test_lzf_copies_reach_back_and_into_themselves() -> None:
    """By the format's description: two literals, a copy of eleven from distance 2, a long one of 20 from distance 1."""
    stored = np.array([1, 65, 66, (7 << 5) | 0, 2, 1, (7 << 5) | 0, 11, 0], np.uint8)
    unpacked = np.zeros(33, np.uint8)
    assert _unpack_lzf(stored, unpacked) == 33
    assert bytes(unpacked) == b"AB" + b"ABABABABABA" + b"A" * 20
    assert _unpack_lzf(stored[:-1], unpacked) == -1
    assert _unpack_lzf(np.array([32, 5], np.uint8), unpacked) == -1
