# SPDX-License-Identifier: Apache-2.0
"""Things that stand as people do: what they are made of, and that scenes without them are as before."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import TrueBody
from flowing_puppet_ros.evaluate.scene.lookalikes import KINDS, turn_profile
from flowing_puppet_ros.evaluate.scene.scene_meshes import make_prism
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import cover_people, make_place, scan_scene


def measure_volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_solid_of_revolution_has_the_volume_of_its_frusta() -> None:
    solid = turn_profile((3.0, -2.0), [(0.2, 0.1), (0.3, 0.6), (0.1, 1.5)], flat=0.5, yaw=0.4)
    frusta = sum(h * (r * r + r * s + s * s) for r, s, h in ((0.2, 0.3, 0.5), (0.3, 0.1, 0.9))) / 3
    polygon = 0.5 * 14 * np.sin(2 * np.pi / 14)  # area of 14 corners on the unit circle
    assert measure_volume(*solid) == pytest.approx(0.5 * polygon * frusta, rel=1e-9)


@pytest.mark.parametrize("make", dict.fromkeys(KINDS))
def test_lookalikes_stand_on_the_floor_and_are_of_a_persons_size(make: type) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        corners = np.concatenate([vertices for vertices, _ in make(rng, 5.0, -3.0)])
        assert -1e-9 < corners[:, 2].min() < 0.1 and 0.75 < corners[:, 2].max() < 2.5
        assert np.hypot(*(corners[:, :2] - [5.0, -3.0]).T).max() < 0.9


def test_scenes_without_lookalikes_are_as_before() -> None:
    plain, more = np.random.default_rng(4), np.random.default_rng(4)
    meshes, blocked = make_place(plain, "hall", 0)
    crowded, taken = make_place(more, "hall", 5)
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(meshes, crowded, strict=False))
    assert len(crowded) >= len(meshes) + 5 and len(taken) == len(blocked) + 5
    assert plain.random() == more.random()


def test_what_covers_somebody_stands_between_and_hides_the_legs() -> None:
    vertices, triangles = make_prism((5.0, 1.0), 0.2, 0, 1.7)
    person = TrueBody(vertices, np.array([[5.0, 1.0, 0.9]]), hard=False, stature=1.7)
    low, high = [], []
    for boxes in ([], cover_people(np.random.default_rng(1), [person], 1.0)):
        points, owner = scan_scene(boxes, [(vertices, triangles)], np.random.default_rng(0), "spinning-64", 1.5)
        height = points[owner == 0, 2] + 1.5
        low.append(int((height < 0.3).sum()))
        high.append(int((height > 1.55).sum()))
    assert low[0] > 20 and low[1] == 0
    assert high[0] == high[1] > 20
    assert not cover_people(np.random.default_rng(1), [person], 0.0)
