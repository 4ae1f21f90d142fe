# SPDX-License-Identifier: Apache-2.0
"""People with things that touch them: these are where they belong, and the people are seen."""

import numpy as np
import pytest

from flowing_puppet_ros.evaluate.body.synthetic_bodies import BodySource
from flowing_puppet_ros.evaluate.props.furniture import CUSHION_M, Place, make_chair, make_desk
from flowing_puppet_ros.evaluate.props.people import PROPS
from flowing_puppet_ros.evaluate.props.poses import draw_seated
from flowing_puppet_ros.evaluate.props.scenes import draw_props
from flowing_puppet_ros.evaluate.rgbd.views import RgbdPair, RgbdStudio, make_camera

pytest.importorskip("body_models")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def studio() -> RgbdStudio:
    camera = make_camera((160, 120), 131.0)
    return RgbdStudio(BodySource(), RgbdPair(camera, camera))


@pytest.mark.parametrize("prop", PROPS)
def test_everybody_is_seen_and_the_same_seed_gives_the_same_frame(studio: RgbdStudio, prop: str) -> None:
    frame, again = (draw_props(studio, np.random.default_rng(3), prop) for _ in range(2))
    assert len(frame.bodies) == (2 if prop == "couple" else 1)
    for person in range(len(frame.bodies)):
        assert np.count_nonzero(frame.person == person) > 200
    assert frame.depth.tobytes() == again.depth.tobytes()


def test_a_chair_is_under_and_behind_who_sits_and_a_desk_before(studio: RgbdStudio) -> None:
    rng = np.random.default_rng(4)
    body = draw_seated(studio.source, rng, "desk")
    place = Place.of(studio.source, body)
    seat, back, *_ = (vertices for vertices, _ in make_chair(place, rng))
    assert seat[:, 2].max() == pytest.approx(place.seat + CUSHION_M)
    assert back[:, 0].min() < place.back < seat[:, 0].max()
    top = make_desk(place, rng)[0][0]
    assert top[:, 2].min() > place.lap
    assert top[:, 0].min() > place.belly
    child = studio.source.draw_child(rng)
    assert 0.9 < child.stature < 1.5
