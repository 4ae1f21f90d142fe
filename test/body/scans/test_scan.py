# SPDX-License-Identifier: Apache-2.0
"""Reading and writing scans; every bad file gives one sentence."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowing_puppet_ros.body.scans.scan import Scan, read_scan, to_smallest_float, write_ply
from flowing_puppet_ros.body.scans.scan_frame import (
    UP_AXES,
    ScanFrame,
    parse_axis,
    propose_up_axes,
    rotation_to_z_up,
)
from flowing_puppet_ros.errors import InputError

BOX = np.array([[x, y, z] for x in (0, 0.5) for y in (0, 0.3) for z in (0, 1.7)], dtype=float)
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def volume(scan: Scan) -> float:
    assert scan.faces is not None
    a, b, c = (scan.points[scan.faces[:, k]] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def text_mesh(folder: Path, suffix: str) -> Path:
    path = folder / f"box{suffix}"
    if suffix == ".off":
        lines = ["OFF", "8 12 0", *(f"{x} {y} {z}" for x, y, z in BOX), *(f"3 {a} {b} {c}" for a, b, c in BOX_FACES)]
    else:
        lines = [f"v {x} {y} {z}" for x, y, z in BOX] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in BOX_FACES]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("suffix", [".off", ".obj"])
def test_text_meshes_keep_the_order_of_vertices(tmp_path: Path, suffix: str) -> None:
    scan = read_scan(text_mesh(tmp_path, suffix))
    np.testing.assert_allclose(scan.points, BOX)
    assert scan.faces is not None and scan.faces.shape == (12, 3)
    assert volume(scan) == pytest.approx(0.5 * 0.3 * 1.7)


@pytest.mark.parametrize("coloured", [False, True])
def test_written_ply_reads_back_and_inside_out_faces_are_flipped(tmp_path: Path, coloured: bool) -> None:
    colours = np.full((8, 3), 7) if coloured else None
    write_ply(tmp_path / "a.ply", BOX, BOX_FACES[:, ::-1], colours)
    scan = read_scan(tmp_path / "a.ply")
    np.testing.assert_allclose(scan.points, BOX, atol=1e-6)
    assert volume(scan) > 0
    assert scan.area == pytest.approx(2 * (0.5 * 0.3 + 0.5 * 1.7 + 0.3 * 1.7))


def test_places_far_from_the_origin_keep_their_digits(tmp_path: Path) -> None:
    far = BOX + np.array([5e5, 5.5e6, 300.0])
    assert to_smallest_float(BOX).dtype == np.float32
    np.testing.assert_array_equal(to_smallest_float(far), far)
    write_ply(tmp_path / "a.ply", far, BOX_FACES)
    np.testing.assert_array_equal(read_scan(tmp_path / "a.ply").points, far)


def test_surface_samples_lie_on_the_mesh_evenly() -> None:
    without_area = np.array([[0, 0, 1], [2, 2, 2]])
    points, normals = Scan(BOX, np.concatenate([without_area, BOX_FACES, without_area])).sample_surface(
        4000, np.random.default_rng(0)
    )
    assert normals is not None and np.isfinite(normals).all()
    on_top = np.isclose(points[:, 2], 1.7)
    np.testing.assert_allclose(np.abs(normals[on_top][:, 2]), 1)
    assert np.all(normals[on_top][:, 2] > 0)
    assert on_top.mean() == pytest.approx(0.15 / 3.02, abs=0.015)


def test_clouds_from_text_numpy_and_archives(tmp_path: Path) -> None:
    cloud = np.random.default_rng(0).normal(size=(20, 3))
    cloud[3, 1] = np.nan
    np.savetxt(tmp_path / "a.xyz", cloud)
    np.save(tmp_path / "a.npy", cloud.astype(np.float32))
    np.savez(tmp_path / "a.npz", xyz=cloud, normals=np.tile([0, 0, 2.0], (20, 1)), other=np.zeros((4, 4)))
    for name in ("a.xyz", "a.npy", "a.npz"):
        scan = read_scan(tmp_path / name)
        np.testing.assert_allclose(scan.points, np.delete(cloud, 3, axis=0), atol=1e-6)
    assert scan.normals is not None
    np.testing.assert_allclose(scan.normals, np.tile([0, 0, 1.0], (19, 1)))


BAD: dict[str, bytes | None] = {
    "missing.ply": None,
    "picture.jpg": b"x",
    "empty.ply": b"",
    "empty.xyz": b"",
    "words.xyz": b"not numbers at all\n",
    "two.xyz": b"1 2\n3 4\n",
    "same.xyz": b"1 2 3\n" * 60,
    "broken.npy": b"\x93NUMPY\x01\x00",
    "broken.npz": b"PK\x03\x04junk",
    "broken.obj": b"\x00\x01\x02",
    "broken.stl": b"solid x\nfacet",
    "broken.pcd": b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n",
    "cut.off": b"OFF\n100 200 0\n0 0 0\n1 0 0\n",
    "cut.ply": b"ply\nformat ascii 1.0\nelement vertex 500\nproperty float x\nproperty float y\nproperty float z\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    content = BAD[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as refusal:
        read_scan(tmp_path / name)
    assert name in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_pickles_and_wrong_arrays_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "flat.npy", np.zeros(9))
    np.savez(tmp_path / "many.npz", a=np.zeros((5, 3)), b=np.zeros((5, 3)))
    np.save(tmp_path / "nan.npy", np.full((9, 3), np.nan))
    for name, words in (("objects", "NumPy"), ("flat", r"\(9,\)"), ("nan", "none of which is finite")):
        with pytest.raises(InputError, match=words):
            read_scan(tmp_path / f"{name}.npy")
    with pytest.raises(InputError, match="a, b"):
        read_scan(tmp_path / "many.npz")


def test_frame_there_and_back() -> None:
    frame = ScanFrame(0.01, rotation_to_z_up(parse_axis("y")))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(frame.to_scan(frame.to_body(points)), points)
    np.testing.assert_allclose(frame.to_body(np.array([[0.0, 100.0, 0.0]])), [[0.0, 0.0, 1.0]])


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda up: np.linalg.norm(up) > 0.1))
def test_every_direction_becomes_z_by_a_rotation(up: list[float]) -> None:
    turn = rotation_to_z_up(np.array(up))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ up, [0, 0, np.linalg.norm(up)], atol=1e-9)
    np.testing.assert_allclose(ScanFrame(0.01, turn).up, np.array(up) / np.linalg.norm(up), atol=1e-9)


def test_people_with_y_up_look_along_z_and_z_up_stays() -> None:
    assert np.array_equal(rotation_to_z_up(parse_axis("z")), np.eye(3))
    assert np.array_equal(rotation_to_z_up(parse_axis("y")) @ [0, 0, 1], [1, 0, 0])
    assert np.array_equal(parse_axis("-x"), [-1, 0, 0])
    assert len({tuple(parse_axis(name)) for name in UP_AXES}) == 6


def test_people_who_lie_askew_have_their_length_among_the_directions() -> None:
    cloud = np.random.default_rng(0).normal(size=(500, 3)) * [0.5, 0.15, 0.1]
    assert len(propose_up_axes(cloud, False)) == 6
    turn = rotation_to_z_up(np.array([1.0, 1.0, 0.2])).T
    askew = propose_up_axes(cloud[:, [1, 2, 0]] @ turn.T, False)
    assert len(askew) == 8
    np.testing.assert_allclose(np.abs(askew[6] @ turn[:, 2]), 1, atol=0.01)
    np.testing.assert_allclose(askew[6], -askew[7])
    assert len(propose_up_axes(cloud[:, [1, 2, 0]] @ turn.T, True)) == 6
