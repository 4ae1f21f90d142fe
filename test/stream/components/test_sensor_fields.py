# SPDX-License-Identifier: Apache-2.0
"""What the sensor can know reaches the fit: from depth images, organised clouds and scans without order."""

from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.body.cloud.person_cloud import PersonCloud
from flowing_puppet_ros.body.fit.fitter import BodyFit, BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.evidence.cloud.sensor_field import SensorField
from flowing_puppet_ros.stream.components.body_fitter import BodyFitterComponent, BodyFitterSettings
from flowing_puppet_ros.stream.messages.clouds import decode_pixels, make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header
from flowing_puppet_ros.stream.messages.images import make_image
from flowing_puppet_ros.stream.messages.message_types import CAMERA_INFO

FACTORY = BagMessageFactory()
WIDTH, HEIGHT, FOCAL = 80, 60, 60.0
OUTSIDE = np.array([[2.0, 0.0, -1.2], [2.0, 1.5, 0.0], [2.0, 0.0, 1.2]])
"""Below, left of and above the image, 2 m ahead, z up."""
INSIDE = np.array([[2.0, 0.0, -0.8], [2.0, 1.2, 0.0], [2.5, 0.0, 0.0]])


@pytest.fixture
def fields(monkeypatch: pytest.MonkeyPatch) -> list[SensorField | None]:
    """The fields of all fits, each of which finds a standing person."""
    found: list[SensorField | None] = []

    def fit(fitter: BodyFitter, points: Any, normals: Any, *, viewpoint: Any, field: Any, **_: Any) -> BodyFit:
        found.append(field)
        state = fitter.model.rest_state()
        return fitter.assess(state, fitter.prepare_cloud(points, normals, viewpoint, field))

    monkeypatch.setattr(BodyFitter, "fit", fit)
    return found


def person_depth() -> np.ndarray:
    """A depth image in which only a board of 30 by 40 pixels is seen, 2 m ahead."""
    depth = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    depth[10:50, 25:55] = 2.0
    return depth


def component() -> BodyFitterComponent:
    return BodyFitterComponent(BodyFitterSettings.from_mapping({"scene": False, "view": "single"}), FACTORY)


def test_a_depth_image_ends_at_its_border(fields: list[SensorField | None]) -> None:
    fitter, header = component(), make_header(FACTORY, 10**9, "camera")
    k = np.array([FOCAL, 0, 39.5, 0, FOCAL, 29.5, 0, 0, 1.0])
    info = FACTORY.make(CAMERA_INFO, header=header, width=WIDTH, height=HEIGHT, k=k, p=np.zeros(12))
    fitter.handle("camera_info", info)
    fitter.handle("depth", make_image(FACTORY, header, person_depth(), "32FC1"))
    (field,) = fields
    assert field is not None
    assert field.find_unknown(OUTSIDE).all() and not field.find_unknown(INSIDE).any()
    np.testing.assert_allclose(field.projection.scale, FOCAL, rtol=1e-4)


def test_an_organised_cloud_ends_where_its_image_does_and_another_is_unlimited(
    fields: list[SensorField | None],
) -> None:
    depth = person_depth()
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    points = np.stack([(u - 39.5) / FOCAL * depth, (v - 29.5) / FOCAL * depth, depth], axis=2)
    header = make_header(FACTORY, 10**9, "camera_optical_frame")
    organised = make_cloud(FACTORY, header, points)
    assert (organised.height, organised.width, organised.is_dense) == (HEIGHT, WIDTH, False)
    read, _, places = decode_pixels(organised)
    np.testing.assert_array_equal(places, np.flatnonzero(np.isfinite(depth)))
    np.testing.assert_allclose(read, points.reshape(-1, 3)[places], rtol=1e-6)
    component().handle("points", organised)
    component().handle("points", make_cloud(FACTORY, header, read))
    assert fields[0] is not None and fields[0].find_unknown(OUTSIDE).all()
    assert fields[1] is None, "a person alone does not say where the sensor's view ends"


def test_everybody_in_a_scan_without_order_is_hidden_by_the_others() -> None:
    angles = np.linspace(-np.pi, np.pi, 721)[:-1]
    rings = np.tan(np.radians(np.arange(-12.0, 12.1, 0.5)))
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    hall = np.concatenate([np.column_stack([5 * circle, np.full(720, 5 * ring)]) for ring in rings])
    near = np.abs(angles) < 0.2
    front = np.concatenate([np.column_stack([2 * circle[near], np.full(near.sum(), 2 * ring)]) for ring in rings])
    hall = hall[np.abs(np.arctan2(hall[:, 1], hall[:, 0])) >= 0.2]
    scan = SceneCloud(np.concatenate([hall, front]), None, 0)
    rows = np.arange(len(hall), len(scan.points))
    beside = np.flatnonzero(hall[:, 1] > 4.9)
    people = [PersonCloud(scan.points[each], viewpoint=np.zeros(3), rows=each) for each in (rows, beside)]
    first, second = (person.field for person in scan.with_fields(people))
    assert first is not None and second is not None
    behind = np.array([[3.0, 0.0, 0.0]])
    assert not first.find_unknown(behind).any(), "its own points hide nothing of a person"
    assert second.find_unknown(behind).all()
    assert first.find_unknown(np.array([[3.0, 0.0, -1.2]])).all(), "below the lowest ring"
    assert scan.with_fields([scan.whole])[0].field is None
