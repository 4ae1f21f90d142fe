# SPDX-License-Identifier: Apache-2.0
"""BVH, TRC, OBJ and JSON, read back by other programs: the bodies that were written."""

import json
from dataclasses import replace
from pathlib import Path

import bvhio  # type: ignore[import-untyped]
import numpy as np
import pytest
import trimesh

from flowing_puppet_ros.exchange.bones import BONES, NAMES
from flowing_puppet_ros.exchange.bvh import write_bvh
from flowing_puppet_ros.exchange.files import write_obj, write_people
from flowing_puppet_ros.exchange.motion import BodyMotion
from flowing_puppet_ros.exchange.trc import write_trc


def read_bvh(path: Path, frame: int) -> dict[str, np.ndarray]:
    """Return where another library places every joint of a frame, in metres."""
    root = bvhio.readAsHierarchy(str(path))
    root.loadPose(frame)
    return {joint.Name: np.array(joint.PositionWorld) / 100 for joint, _, _ in root.layout()}


def true_places(motion: BodyMotion, frame: int) -> dict[str, np.ndarray]:
    names = motion.model.joint_names
    return {bone.name: motion.joints[frame, names.index(bone.joint)] for bone in BONES if bone.joint}


def test_bvh_of_one_frame_places_every_joint(still: BodyMotion, tmp_path: Path) -> None:
    write_bvh(tmp_path / "still.bvh", still)
    found = read_bvh(tmp_path / "still.bvh", 0)
    for name, place in true_places(still, 0).items():
        np.testing.assert_allclose(found[name], place, atol=1e-4, err_msg=name)


def test_bvh_of_a_motion_keeps_lengths_and_follows_the_joints(motion: BodyMotion, tmp_path: Path) -> None:
    write_bvh(tmp_path / "walk.bvh", motion)
    read = bvhio.readAsBvh(str(tmp_path / "walk.bvh"))
    assert (read.FrameCount, read.FrameTime) == (len(motion.stamps_ns), pytest.approx(0.04))
    errors, lengths = [], []
    for frame in range(len(motion.stamps_ns)):
        found, truth = read_bvh(tmp_path / "walk.bvh", frame), true_places(motion, frame)
        errors.append([np.linalg.norm(found[name] - truth[name]) for name in truth])
        lengths.append(np.linalg.norm(found["left_lower_leg"] - found["left_upper_leg"]))
    assert np.ptp(lengths) < 1e-4
    assert np.mean(errors) < 0.01
    wrists = motion.joints[:, motion.model.joint_names.index("left_wrist")]
    assert np.linalg.norm(wrists - wrists[0], axis=1).max() > 0.1, "a skeleton that stands still would be noticed"


def test_bvh_at_rest_stands_upright_and_faces_z(motion: BodyMotion, tmp_path: Path) -> None:
    write_bvh(tmp_path / "walk.bvh", motion)
    root = bvhio.readAsHierarchy(str(tmp_path / "walk.bvh"))
    root.loadRestPose()
    rest = {joint.Name: np.array(joint.PositionWorld) for joint, _, _ in root.layout()}
    assert set(NAMES) <= set(rest)
    assert rest["head"][1] - rest["left_foot"][1] > 100  # centimetres
    assert rest["left_upper_arm"][0] - rest["right_upper_arm"][0] > 20
    foot = motion.bones.ends(motion.joints, motion.model.joint_names)[NAMES.index("left_foot")]
    assert foot[2] > 0.1  # toes point along z


def test_trc_has_markers_times_and_rate(motion: BodyMotion, tmp_path: Path) -> None:
    write_trc(tmp_path / "walk.trc", motion)
    lines = (tmp_path / "walk.trc").read_text().splitlines()
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (header["Units"], float(header["DataRate"])) == ("mm", 25.0)
    assert (int(header["NumFrames"]), int(header["NumMarkers"])) == (12, len(motion.model.joint_names))
    assert [name for name in lines[3].split("\t")[2:] if name] == list(motion.model.joint_names)
    table = np.genfromtxt(tmp_path / "walk.trc", delimiter="\t", skip_header=6)
    np.testing.assert_array_equal(table[:, 0], np.arange(1, 13))
    np.testing.assert_allclose(table[:, 1], 0.04 * np.arange(12))
    np.testing.assert_allclose(table[:, 2:].reshape(12, -1, 3) / 1000, motion.joints, atol=1e-6)


def test_opensim_reads_the_trc(motion: BodyMotion, tmp_path: Path) -> None:
    """Where the package opensim is installed."""
    opensim = pytest.importorskip("opensim")
    write_trc(tmp_path / "walk.trc", motion)
    table = opensim.TimeSeriesTableVec3(str(tmp_path / "walk.trc"))
    assert list(table.getColumnLabels()) == list(motion.model.joint_names)
    rows = [table.getRowAtIndex(k) for k in range(table.getNumRows())]
    read = np.array([[[row[j][axis] for axis in range(3)] for j in range(table.getNumColumns())] for row in rows])
    np.testing.assert_allclose(read / 1000, motion.joints, atol=1e-6)


def test_obj_is_the_mesh(still: BodyMotion, tmp_path: Path) -> None:
    write_obj(tmp_path / "still.obj", still, 0)
    scene = trimesh.load(tmp_path / "still.obj", process=False, maintain_order=True, group_material=False)
    mesh = scene if isinstance(scene, trimesh.Trimesh) else trimesh.util.concatenate(scene.dump())
    assert mesh.area == pytest.approx(trimesh.Trimesh(still.vertices[0], still.model.faces).area, rel=1e-4)
    rows = [line.split()[1:] for line in (tmp_path / "still.obj").read_text().splitlines() if line.startswith("v ")]
    np.testing.assert_allclose(np.array(rows, float), still.vertices[0], atol=1e-6)
    faces = [line.split()[1:] for line in (tmp_path / "still.obj").read_text().splitlines() if line.startswith("f ")]
    written = {tuple(face) for face in (np.array(faces, int) - 1).tolist()}
    assert written == {tuple(face) for face in still.model.faces.tolist()}


def test_json_needs_no_model(motion: BodyMotion, tmp_path: Path) -> None:
    (path,) = write_people([motion], "json", tmp_path)
    read = json.loads(path.read_text())
    (person,) = read["people"]
    assert (person["id"], person["model"], read["unit"], read["up"]) == ("b1", "neutral", "m", "y")
    joints = np.array([frame["joints"] for frame in person["frames"]])
    np.testing.assert_allclose(joints, motion.joints, atol=1e-5)
    wrist = read["joint_names"].index("left_wrist")
    hand = read["bone_names"].index("left_hand")
    np.testing.assert_allclose(person["frames"][3]["bones"]["position"][hand], joints[3, wrist], atol=2e-5)


def test_stamps_that_are_not_even_are_resampled(motion: BodyMotion, tmp_path: Path) -> None:
    stamps = np.delete(motion.stamps_ns, 5)
    names = ("vertices", "joints", "part_rotation", "part_center", "shape", "confidence", "reliable")
    gap = replace(motion, stamps_ns=stamps, **{name: np.delete(getattr(motion, name), 5, axis=0) for name in names})
    filled = gap.resample()
    np.testing.assert_array_equal(filled.stamps_ns, motion.stamps_ns)
    assert np.linalg.norm(filled.joints[5] - motion.joints[5], axis=1).max() < 0.005
    np.testing.assert_allclose(filled.joints[6:], motion.joints[6:], atol=1e-9)
    turned = filled.part_rotation
    np.testing.assert_allclose(turned @ np.swapaxes(turned, 2, 3), np.broadcast_to(np.eye(3), turned.shape), atol=1e-9)
