# SPDX-License-Identifier: Apache-2.0
"""Which way is up in clouds without a frame_id: as in a camera's frame where they look like one's, else z."""

from typing import Any

import numpy as np
import pytest
from capsule_man import cloud_of, joints_of  # type: ignore[import-not-found]

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header

FACTORY = BagMessageFactory()
# From x ahead, y left, z up to x right, y down, z ahead.
TO_OPTICAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


@pytest.fixture
def upright(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every fit is somebody who stands where the cloud is, along z."""

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any = None, **_: Any) -> BodyFit:
        state = fitter.model.rest_state()
        state.center[:] += points.mean(axis=0) - fitter.model.vertices(state).mean(axis=0)
        return fitter.assess(state, fitter.prepare_cloud(points, normals, viewpoint))

    monkeypatch.setattr(BodyFitter, "fit", fit)


def standing() -> np.ndarray:
    """A person 3 m ahead of a sensor that is 1.2 m above the floor on which they stand; and 1 m of that floor."""
    person = cloud_of(joints_of(), 3000)[0]
    floor = np.pad(np.random.default_rng(0).uniform(-1, 1, (2000, 2)), ((0, 0), (0, 1)))
    floor[:, 2] = person[:, 2].min()
    return np.asarray(np.concatenate([person, floor]) + np.array([3, 0, -1.2 - floor[0, 2]]))


@pytest.mark.usefixtures("upright")
@pytest.mark.parametrize(
    ("frame", "rotation", "moved", "up", "told"),
    [
        ("", TO_OPTICAL, 0.0, [0, -1, 0], "-y is taken as up, since their points lie ahead along z"),
        ("", np.eye(3), 0.0, [0, 0, 1], "z is taken as up, since their points lie around the origin"),
        # A map whose origin is on the floor, below the person.
        ("", np.eye(3), 1.2, [0, 0, 1], "z is taken as up"),
        ("eye_optical_frame", TO_OPTICAL, 0.0, [0, -1, 0], ""),
        ("map", np.eye(3), 0.0, [0, 0, 1], ""),
    ],
)
def test_bodies_stand(frame: str, rotation: np.ndarray, moved: float, up: list[float], told: str) -> None:
    settings = BodyFitterSettings.from_mapping({"fitter.max_points": 500, "fitter.threads": 1, "track": False})
    component = BodyFitterComponent(settings, FACTORY)
    for k in range(2):
        points = (standing() + np.array([0, 0, moved])) @ rotation.T
        made = dict(component.handle("points", make_cloud(FACTORY, make_header(FACTORY, k, frame), points)))
        (body,) = made["bodies"].bodies
        places = {joint.name: np.array([joint.position.x, joint.position.y, joint.position.z]) for joint in body.joints}
        height = (places["left_ear"] if "left_ear" in places else places["nose"]) - places["left_ankle"]
        assert height @ up > 1.2
    warnings = [text for text in component.report.drain_warnings() if "frame_id" in text]
    assert len(warnings) == bool(told)
    assert not told or told in warnings[0]
