# SPDX-License-Identifier: Apache-2.0
"""What the 3D view is given: places to a thousandth of the scene, upright, and small enough."""

import base64
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.report.pictures.bag_pictures import BodyMesh
from flowing_puppet_ros.report.pictures.scene_3d import (
    MAX_BYTES,
    MAX_POINTS,
    SceneFrame,
    count_affordable_frames,
    make_scene_data,
)

X, Y, Z = np.eye(3)
RNG = np.random.default_rng(0)
BODY = RNG.uniform([-0.3, -0.5, 0], [0.3, 0.5, 1.8], (200, 3))
FACES = np.arange(198).reshape(-1, 3)


def mesh(shift: float = 0.0, points: np.ndarray | None = None) -> BodyMesh:
    cloud = np.zeros((0, 3)) if points is None else points
    return BodyMesh(BODY + shift * X, FACES, np.full((200, 3), 99.6), cloud)


def places(scene: Any, text: str) -> np.ndarray:
    """As the page reads them."""
    whole = np.frombuffer(base64.b64decode(text), "<i2").reshape(-1, 3)
    return np.asarray(whole * scene["step"] + scene["origin"])


def test_places_are_those_of_the_bodies() -> None:
    cloud = np.concatenate([BODY[:50] + 0.01, [[500.0, 0, 0], [np.nan, 0, 0]]])
    frames = [SceneFrame(0.0, [mesh(0.0, cloud)]), SceneFrame(0.5, [mesh(1.0), mesh(2.0)])]
    scene = make_scene_data(frames, X, Z)
    assert scene["step"] < 1e-4, "a stray point makes all places coarse"
    first, second = scene["frames"]
    np.testing.assert_allclose(places(scene, first["mesh"]), BODY, atol=0.51 * scene["step"])
    np.testing.assert_allclose(places(scene, first["points"]), BODY[:50] + 0.01, atol=0.51 * scene["step"])
    assert (first["bodies"], second["bodies"], second["t"]) == (1, 2, 0.5)
    expected = np.concatenate([BODY + X, BODY + 2 * X])
    np.testing.assert_allclose(places(scene, second["mesh"]), expected, atol=0.51 * scene["step"])
    assert scene["vertices"] == 200 and scene["azimuth"] == 0
    assert np.frombuffer(base64.b64decode(scene["faces"]), "<u4").tolist() == FACES.ravel().tolist()
    assert set(base64.b64decode(scene["colours"])) == {100}


@pytest.mark.parametrize("up", [Z, -Y, Y, X, -Z, Z + 0.1 * X])
def test_up_is_up_whatever_the_frame(up: np.ndarray) -> None:
    up = up / np.linalg.norm(up)
    scene = make_scene_data([SceneFrame(0.0, [mesh()])], np.roll(up, 1), up)
    turned = places(scene, scene["frames"][0]["mesh"])
    np.testing.assert_allclose(turned[:, 2], BODY @ up, atol=scene["step"])
    centred = [cloud - cloud.mean(axis=0) for cloud in (turned, BODY)]
    assert np.linalg.det(np.linalg.lstsq(centred[1], centred[0])[0]) == pytest.approx(1, abs=1e-3), "it is mirrored"
    assert scene["floor"] == pytest.approx((BODY @ up).min(), abs=2 * scene["step"])


def test_large_scenes_show_fewer_stamps() -> None:
    assert count_affordable_frames(1, 3707) >= 100
    assert count_affordable_frames(8, 20000) * 6 * (8 * 20000 + MAX_POINTS) <= MAX_BYTES
    assert count_affordable_frames(100, 100_000) == 1
    dense = SceneFrame(0.0, [mesh(0.0, RNG.uniform(0, 1, (50_001, 3)))])
    assert 0.5 * MAX_POINTS <= len(dense.points) <= MAX_POINTS
