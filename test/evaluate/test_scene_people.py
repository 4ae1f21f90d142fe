# SPDX-License-Identifier: Apache-2.0
"""People of synthetic scenes who sit, crouch, bend, lift their arms or stand on a step are as that says."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.props.scene_people import draw_empty_seat, draw_posed
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import SceneKind, draw_scene

pytest.importorskip("body_models")
pytestmark = pytest.mark.slow
TOPS_M = {
    "seated": (1.1, 1.7),
    "floor": (0.65, 1.35),
    "crouching": (0.8, 1.6),
    "bent": (0.8, 1.6),
    "arms-up": (1.6, 2.4),
}


@pytest.fixture(scope="module")
def source() -> BodySource:
    return BodySource()


@pytest.mark.parametrize("pose", TOPS_M)
def test_who_is_posed_is_as_high_as_such_people_are(source: BodySource, pose: str) -> None:
    for seed in range(4):
        (body,), meshes = draw_posed(source, np.random.default_rng(seed), pose)
        low, high = TOPS_M[pose]
        assert low < body.vertices[:, 2].max() < high
        assert body.vertices[:, 2].min() == pytest.approx(0.0, abs=0.08)
        assert bool(meshes) == (pose == "seated")


def test_the_same_seed_gives_the_same_scene_with_people_on_seats_and_seats_without(source: BodySource) -> None:
    kind = SceneKind(draw=lambda source, rng: draw_posed(source, rng, "seated"), empty=(2, draw_empty_seat), height=1.5)
    one, other = (draw_scene(source, np.random.default_rng(5), "hall", "spinning-16", 2, kind) for _ in range(2))
    assert one.points.tobytes() == other.points.tobytes() and 1 <= len(one.people) <= 3
    bare = draw_scene(source, np.random.default_rng(5), "hall", "spinning-16", 2, SceneKind(draw=kind.draw, height=1.5))
    assert [body.stature for body in bare.people] == [body.stature for body in one.people]
    assert bare.points.shape != one.points.shape or not np.array_equal(bare.points, one.points)
