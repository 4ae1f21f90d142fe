# SPDX-License-Identifier: Apache-2.0
"""Every dialect of .ply reads alike, and damaged files are one sentence."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flowing_puppet_ros.body.scans.formats.ply import read_ply
from flowing_puppet_ros.body.scans.scan import read_scan, write_ply
from flowing_puppet_ros.errors import InputError

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5], [5e5, 0.25, 3]], dtype=float)
POLYGONS = [[0, 1, 2, 3], [0, 1, 4], [4, 3, 2]]
TRIANGLES = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [4, 3, 2]]


def ply(form: str, polygons: list[list[int]]) -> bytes:
    """A file with a colour before the places, normals, an edge table between, and a float after each polygon."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    header = [
        "ply", f"format {form} 1.0", "comment made by hand", f"element vertex {len(POINTS)}", "property uchar red",
        *(f"property double {name}" for name in "xyz"), *(f"property float n{name}" for name in "xyz"),
        "element edge 2", "property int a", f"element face {len(polygons)}",
        "property list uchar int vertex_indices", "property float quality", "end_header", "",
    ]  # fmt: skip
    body = b""
    if not order:
        rows = [f"7 {x} {y} {z} 0 0 1" for x, y, z in POINTS] + ["1", "2"]
        rows += [" ".join(map(str, [len(face), *face, 0.5])) for face in polygons]
        body = ("\n".join(rows) + "\n").encode()
    else:
        for point in POINTS:
            body += np.uint8(7).tobytes() + point.astype(order + "f8").tobytes()
            body += np.array([0, 0, 1], order + "f4").tobytes()
        body += np.array([1, 2], order + "i4").tobytes()
        for face in polygons:
            body += np.uint8(len(face)).tobytes() + np.array(face, order + "i4").tobytes()
            body += np.array([0.5], order + "f4").tobytes()
    return "\n".join(header).encode() + body


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("even", [False, True])
def test_every_dialect_reads_alike(tmp_path: Path, form: str, even: bool) -> None:
    (tmp_path / "a.ply").write_bytes(ply(form, TRIANGLES if even else POLYGONS))
    points, normals, faces = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, POINTS)
    assert normals is not None
    np.testing.assert_array_equal(normals, np.tile([0, 0, 1], (5, 1)))
    assert faces.tolist() == TRIANGLES
    (tmp_path / "b.ply").write_bytes(ply(form, []))
    cloud = read_scan(tmp_path / "b.ply")
    assert cloud.faces is None and cloud.normals is not None


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]), st.data())
def test_damaged_files_are_refused_and_print_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], form: str, data: st.DataObject
) -> None:
    whole = bytearray(ply(form, POLYGONS))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(whole)))
    (tmp_path / "a.ply").write_bytes(bytes(whole[:cut]))
    try:
        read_scan(tmp_path / "a.ply")
    except InputError as error:
        assert "a.ply" in str(error) and "\n" not in str(error)
    assert capfd.readouterr() == ("", "")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS, np.array(TRIANGLES), np.full((5, 3), 9))
    points, normals, faces = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(points, POINTS)
    assert normals is None and faces.tolist() == TRIANGLES
