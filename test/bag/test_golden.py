# SPDX-License-Identifier: Apache-2.0
"""The golden bag: the same bytes twice, the expected results, and the truth that made the recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from flowing_puppet_ros.bag.reader import Record, open_bag
from flowing_puppet_ros.bag.replay.replay import replay
from flowing_puppet_ros.ids import make_public_id
from flowing_puppet_ros.model.tree import mirrored_name
from flowing_puppet_ros.multiview.camera import Camera
from flowing_puppet_ros.stream.messages.bodies.silhouettes import decode_silhouettes
from flowing_puppet_ros.stream.messages.clouds import decode_cloud
from flowing_puppet_ros.stream.messages.geometry import FrameTree, stamp_ns
from flowing_puppet_ros.stream.messages.images import decode_image, decode_labels

CAMERAS = ("cam1", "cam2", "cam3", "cam4")
ENDS = ("hand", "foot", "toe", "heel")
LIMBS = ("elbow", "wrist", "knee", "ankle", "shoulder", "hip")

PERSON = make_public_id("/visual_hull", "b1")
"""Whom the node of the hull carves; the body fitter keeps the id."""


def records(path: Path, *topics: str) -> list[Record]:
    with open_bag(path) as bag:
        return list(bag.messages(topics or None))


def cameras(path: Path) -> dict[str, Camera]:
    """The calibrated cameras as the output bag tells them."""
    frames = FrameTree()
    for record in records(path, "/tf_static"):
        frames.add(record.message)
    found = {}
    for name in CAMERAS:
        info = records(path, f"/{name}/camera_info")[0].message
        world = frames.lookup_pose("world", info.header.frame_id)
        assert world is not None
        found[name] = Camera.from_info(info.k, info.d, info.width, info.height, world[1], world[0])
    return found


def joints(message: Any) -> dict[str, NDArray[np.float64]]:
    return {joint.name: np.array([joint.x, joint.y]) for joint in message.joints}


@pytest.mark.slow
def test_two_replays_give_the_same_bytes_on_any_number_of_threads(golden: Any, tmp_path: Path) -> None:
    assert golden.options.jobs == 3
    replay(golden.source, tmp_path / "out.mcap", replace(golden.options, jobs=1))
    assert (tmp_path / "out.mcap").read_bytes() == golden.replay.read_bytes()


def test_nothing_is_lost_and_nothing_is_said(golden: Any) -> None:
    counts = golden.summary["messages"]
    assert golden.summary["frames"] == 32
    assert golden.summary["bodies"] == counts["/silhouettes"] == counts["/bodies"] == 8
    assert counts["/hull"] == counts["/hull/joints"] == 2
    for name in CAMERAS:
        made = ("puppets", "part_labels", "overlay/compressed", "camera_info", "detections_2d", "annotations")
        assert [counts[f"/{name}/{topic}"] for topic in made] == [8] * 6
        assert counts[f"/{name}/detections"] == 6
    assert counts["/body_topology"] == counts["/tf_static"] == 1
    assert golden.summary["warnings"] == []


def test_results_carry_the_stamps_and_frames_of_their_input(golden: Any) -> None:
    out = golden.replay
    for name in CAMERAS:
        made = [record.message.header for record in records(out, f"/{name}/puppets")]
        given = [record.message.header for record in records(golden.source, f"/{name}/image/compressed")]
        assert made == given
    stamps = {stamp_ns(record.message) for record in records(golden.source, "/cam1/image/compressed")}
    for record in records(out, "/hull", "/bodies", "/part_poses", "/body_vertices"):
        assert record.message.header.frame_id == "world"
        assert stamp_ns(record.message) in stamps
    assert [r.message.transforms[0].child_frame_id for r in records(out, "/tf")] == [f"body_{PERSON}"] * 8


@pytest.mark.parametrize(("kind", "tolerance"), [("puppets", 1.0), ("bodies", 0.02)])
def test_results_are_those_expected(golden: Any, kind: str, tolerance: float) -> None:
    """Tolerances in pixels and metres: libraries of another processor may round differently.

    Another OpenCV finds another flow and other silhouettes, in which the ends of the limbs have little hold.
    """
    same_opencv = golden.expected["opencv"] == cv2.__version__.rpartition(".")[0]
    topics = [f"/{name}/puppets" for name in CAMERAS] if kind == "puppets" else ["/bodies"]
    compared = 0
    for record in records(golden.replay, *topics):
        expected = golden.expected[kind][record.topic] if kind == "puppets" else golden.expected[kind]
        people = record.message.puppets if kind == "puppets" else record.message.bodies
        for person, wanted in zip(people, expected[str(stamp_ns(record.message))], strict=True):
            for joint in person.joints:
                if not same_opencv and joint.name.endswith(ENDS):
                    continue
                place = joint if kind == "puppets" else joint.position
                found = [place.x, place.y] + ([] if kind == "puppets" else [place.z])
                np.testing.assert_allclose(found, wanted[joint.name], atol=tolerance, err_msg=joint.name)
                compared += 1
    assert compared >= (32 * 15 if kind == "puppets" else 8 * 15)


def test_puppets_follow_the_true_joints(golden: Any) -> None:
    """Elbows, wrists, knees and ankles, with frames that the detector missed: 72 px are a metre."""
    seen = cameras(golden.replay)
    errors: dict[str, list[float]] = {}
    for name in CAMERAS:
        for record in records(golden.replay, f"/{name}/puppets"):
            (puppet,) = record.message.puppets
            truth = golden.truth[str(stamp_ns(record.message))]
            for joint, place in joints(puppet).items():
                true = seen[name].project(np.array([truth[joint]]))[0][0]
                errors.setdefault(joint, []).append(float(np.linalg.norm(place - true)))
    for side in ("left", "right"):
        for joint in ("elbow", "wrist", "knee", "ankle"):
            found = np.array(errors[f"{side}_{joint}"])
            assert np.median(found) < 3.5, joint
            assert np.quantile(found, 0.9) < 10, joint


def test_boxes_and_drawings_lie_on_the_true_person(golden: Any) -> None:
    """72 px are a metre; the message's origin is half a pixel from ours."""
    seen = cameras(golden.replay)
    for name in CAMERAS:
        drawings = records(golden.replay, f"/{name}/annotations")
        for record, drawing in zip(records(golden.replay, f"/{name}/detections_2d"), drawings, strict=True):
            (detection,) = record.message.detections
            truth = golden.truth[str(stamp_ns(record.message))]
            true = seen[name].project(np.array(list(truth.values())))[0] + 0.5
            centre, half = detection.bbox.center.position, np.array([detection.bbox.size_x, detection.bbox.size_y]) / 2
            corners = np.array([centre.x, centre.y]) + np.array([-half, half])
            assert (np.abs(corners[0] - true.min(axis=0)) < 18).all() and (
                np.abs(corners[1] - true.max(axis=0)) < 18
            ).all()
            drawn = np.array([(circle.position.x, circle.position.y) for circle in drawing.message.circles])
            nearest = np.linalg.norm(drawn[:, None] - true, axis=2).min(axis=1)
            assert len(drawn) == 19 and np.median(nearest) < 3.5
            assert [text.text for text in drawing.message.texts] == [detection.id]
            assert drawing.message.timestamp == detection.header.stamp


def test_bodies_are_near_the_true_joints_and_never_mirrored(golden: Any) -> None:
    for record in records(golden.replay, "/bodies", "/hull/joints"):
        (body,) = record.message.bodies
        truth = {name: np.array(place) for name, place in golden.truth[str(stamp_ns(record.message))].items()}
        places = {joint.name: np.array([joint.position.x, joint.position.y, joint.position.z]) for joint in body.joints}
        limbs = [f"{side}_{limb}" for side in ("left", "right") for limb in LIMBS]
        errors = [np.linalg.norm(places[name] - truth[name]) for name in limbs]
        mirrored = [np.linalg.norm(places[name] - truth[mirrored_name(name)]) for name in limbs]
        assert np.mean(errors) < (0.035 if record.topic == "/bodies" else 0.06), record.topic
        assert np.mean(mirrored) > 0.2, record.topic


def test_hull_and_mesh_lie_on_each_other_and_look_outward(golden: Any) -> None:
    out = golden.replay
    triangles = np.array([t.vertex_indices for t in records(out, "/body_topology")[0].message.triangles])
    meshes = {stamp_ns(record.message): record.message for record in records(out, "/body_vertices")}
    for hull in records(out, "/hull"):
        points, normals = decode_cloud(hull.message)
        assert normals is not None
        assert ((points - points.mean(axis=0)) * normals).sum(axis=1).mean() > 0.02
        mesh, _ = decode_cloud(meshes[stamp_ns(hull.message)])
        corners = mesh[triangles]
        volume = np.linalg.det(corners).sum() / 6
        assert 0.04 < volume < 0.12, "cubic metres of a person, positive for outward triangles"
        nearest = np.linalg.norm(points[::7, None] - mesh[None], axis=2).min(axis=1)
        assert np.median(nearest) < 0.04


def test_silhouettes_hold_the_cameras_and_the_person(golden: Any) -> None:
    seen = cameras(golden.replay)
    for record in records(golden.replay, "/silhouettes"):
        truth = golden.truth[str(stamp_ns(record.message))]
        views = dict(
            zip((each.camera for each in record.message.silhouettes), decode_silhouettes(record.message), strict=True)
        )
        assert set(views) == set(CAMERAS)
        for name, (camera, mask) in views.items():
            np.testing.assert_allclose(camera.centre, seen[name].centre, atol=1e-9)
            for joint in ("neck", "belly", "left_hip", "right_knee"):
                column, row = np.rint(camera.project(np.array(truth[joint]))[0]).astype(int)
                assert mask[row, column] == 255, (name, joint)


def test_markers_poses_and_labels_say_the_same(golden: Any) -> None:
    out = golden.replay
    mesh, _ = decode_cloud(records(out, "/body_vertices")[0].message)
    (marker,) = records(out, "/body_meshes")[0].message.markers
    corners = np.array([[p.x, p.y, p.z] for p in marker.points])
    assert 3 * 1500 < len(corners) <= 3 * 2000, "a preview"
    apart = np.abs(corners[::50, None] - mesh[None]).max(axis=2).min(axis=1)
    np.testing.assert_allclose(apart, 0, atol=1e-5, err_msg="on the body's own vertices")
    (body,) = records(out, "/bodies")[0].message.bodies
    assert [part.pose for part in body.parts] == records(out, "/part_poses")[0].message.poses
    for name in CAMERAS:
        labels = decode_labels(records(out, f"/{name}/part_labels")[0].message)
        puppet = records(out, f"/{name}/puppets")[0].message.puppets[0]
        assert labels.shape == (240, 192)
        assert set(np.unique(labels)) <= {0} | {part.label for part in puppet.parts}
        torso = joints(puppet)["belly"]
        assert labels[round(torso[1]), round(torso[0])] > 0
        overlay = decode_image(records(out, f"/{name}/overlay/compressed")[0].message)
        assert overlay.shape == (240, 192, 3)


def test_other_readers_read_the_result(golden: Any) -> None:
    with AnyReader([golden.replay]) as reader:
        kinds = {reader.deserialize(raw, c.msgtype).__class__.__name__ for c, _, raw in reader.messages()}
    assert {"flowing_puppet_msgs__msg__PuppetArray", "flowing_puppet_msgs__msg__BodyArray"} <= kinds
