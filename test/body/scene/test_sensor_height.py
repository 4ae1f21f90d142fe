# SPDX-License-Identifier: Apache-2.0
"""The height of a sensor that sees no floor: as given, as last seen, or by the people."""

from importlib.util import find_spec

import numpy as np
import pytest

from flowing_puppet_ros.body.fit.fitter import BodyFitter
from flowing_puppet_ros.body.scene.scene_cloud import SceneCloud
from flowing_puppet_ros.body.scene.sensor_height import ASKED, INTERVAL_NS, SensorHeight
from flowing_puppet_ros.body.segmentation.candidates import SceneHeights
from flowing_puppet_ros.body.settings import FitterSettings, SegmentationSettings
from flowing_puppet_ros.body.track.scene_tracker import SceneSettings, SceneTracker
from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.reporting import Report
from test.body.segmentation.test_candidates import SENSOR, room

HEIGHT = 1.6
BLIND, SEEING = (room(np.random.default_rng(1), lowest) - SENSOR for lowest in (-16.0, -40.0))


class People:
    """Rates a floor by how near it is to the right one, and counts how often it is asked."""

    def __init__(self, there: bool = True) -> None:
        self.asked, self._there = 0, there

    def rate(self, scene: SceneHeights) -> float:
        self.asked += 1
        return max(1.0 - abs(scene.floor.locate(2.0, 0.5) + HEIGHT) / 0.5, 0.0) if self._there else 0.0


def lay(height: SensorHeight, points: np.ndarray, people: People, stamp: int = 0, given: float | None = None) -> float:
    """Return z of the floor under the person, metres."""
    return height.lay_floor(points, np.zeros(3), stamp, given, people.rate).floor.locate(2.0, 0.5)


def test_a_floor_that_is_seen_needs_nobody() -> None:
    height, people = SensorHeight(), People()
    assert lay(height, SEEING, people) == pytest.approx(-HEIGHT, abs=0.05)
    assert height.is_known and not people.asked


def test_a_given_height_is_taken_where_no_floor_is_seen() -> None:
    height, people = SensorHeight(), People()
    assert lay(height, BLIND, people, given=1.7) == pytest.approx(-1.7, abs=0.02)
    assert height.is_known and not people.asked


def test_a_floor_that_was_seen_is_remembered_until_the_stream_begins_anew() -> None:
    height, people = SensorHeight(), People()
    lay(height, SEEING, people)
    assert lay(height, BLIND, people, 1) == pytest.approx(-HEIGHT, abs=0.05)
    assert height.is_known and not people.asked
    height.reset()
    lay(height, BLIND, people, 2)
    assert people.asked


def test_people_tell_the_height_of_a_sensor_that_never_saw_the_floor() -> None:
    height, people = SensorHeight(), People()
    counts = []
    for number in range(10 * ASKED):
        assert lay(height, BLIND, people, number * INTERVAL_NS // 2) == pytest.approx(-HEIGHT, abs=0.06)
        assert not height.is_known
        counts.append(people.asked)
    assert counts[0] == counts[1] < counts[2] and len(set(counts)) == ASKED


def test_while_nobody_is_there_the_lowest_thing_is_the_floor_and_not_every_scan_is_asked() -> None:
    height, people = SensorHeight(), People(there=False)
    assert lay(height, BLIND, people) > 0.3 - HEIGHT
    asked = people.asked
    lay(height, BLIND, people, INTERVAL_NS // 2)
    assert people.asked == asked and not height.is_known


@pytest.mark.slow
@pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")
def test_a_person_before_a_scanner_that_sees_no_floor_has_the_right_height_and_is_not_reliable() -> None:
    from flowing_puppet_ros.learn.anny.body import AnnyBody

    anny = AnnyBody("neutral")
    rest = anny.make_rest_body(anny.mean_phenotype())
    person = rest.vertices - [*rest.vertices[:, :2].mean(axis=0), rest.vertices[:, 2].min()] + [2.7, 0.3, 0.0]
    walls = [
        make_box(np.array([x, y, 1.4]), np.array(size), np.eye(3))
        for x, y, size in ((4, 0, [0.2, 8, 2.8]), (-4, 0, [0.2, 8, 2.8]), (0, 4, [8, 0.2, 2.8]), (0, -4, [8, 0.2, 2.8]))
    ]
    floor = make_box(np.array([0, 0, -0.05]), np.array([8, 8, 0.1]), np.eye(3))
    points = scan_scene(
        [floor, *walls], [(person, anny.triangles)], np.random.default_rng(0), "spinning-16", HEIGHT + 0.2
    )[0]
    model = StitchedPuppet.load()
    fitter = BodyFitter(model, FitterSettings())
    for given in (0.0, HEIGHT + 0.2):
        settings = SceneSettings(view="single", segmentation=SegmentationSettings(sensor_height=given))
        report = Report()
        (body,) = SceneTracker(fitter, settings, report).fit_once(SceneCloud(points, None, 0), 0)
        assert abs(model.measure_height(body.fit.state.shape) - rest.stature) < 0.15
        assert abs(body.fit.vertices[:, 2].min() + HEIGHT + 0.2) < 0.15
        assert any("no floor is seen" in sentence for sentence in report.warnings) == (not given)
        assert given or not body.fit.reliable
