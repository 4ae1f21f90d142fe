# SPDX-License-Identifier: Apache-2.0
"""The scene from above: tracks and dots lie where the people and the walls are, by the picture's own scale."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowing_puppet_ros.bag.replay.replay import METADATA_NAME
from flowing_puppet_ros.bag.typestore import BagMessageFactory
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.report.data import gather_data
from flowing_puppet_ros.report.report import build_report_page
from flowing_puppet_ros.report.scene_above import AboveData, TrackAbove, draw_above
from flowing_puppet_ros.stream.messages.clouds import make_cloud
from flowing_puppet_ros.stream.messages.geometry import make_header, make_point

FACTORY = BagMessageFactory()
BODIES, CLOUD = "flowing_puppet_msgs/msg/BodyArray", "sensor_msgs/msg/PointCloud2"
START, STEP, FRAMES = 7_000_000_000, 100_000_000, 12
SENSOR_HEIGHT, WALL_M = 1.5, 8.0
JOINTS = {"shoulder": (0.2, 1.4), "hip": (0.1, 0.9), "ankle": (0.1, 0.1)}
OPTICAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""From x forward, y left, z up to x right, y down, z forward."""
REJECTED = [
    {"place": [3.0, -2.0, -1.5], "probability": 0.02, "reason": "its shape is no person's"},
    {"place": [40.0, 0.0, -1.5], "probability": 0.01, "reason": "far away"},
    {"place": [5.0, -2.5, -1.5], "probability": 0.4, "reason": "no upright <body> explains it"},
]


def walk(frame: int) -> dict[str, tuple[float, float]]:
    """One person walks to the left, one stands and is out of sight for a while."""
    people = {"ezuxg": (4.0, -1.0 + 0.15 * frame), "fdjnz": (6.0, 2.0)}
    return {name: place for name, place in people.items() if name == "ezuxg" or not 4 <= frame < 9}


def scene() -> np.ndarray:
    """A floor and a wall, as seen by a sensor that stands 1.5 m over the floor."""
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(1, 10, 20000), rng.uniform(-5, 5, 20000), np.zeros(20000)])
    wall = np.column_stack([np.full(5000, WALL_M), rng.uniform(-5, 5, 5000), rng.uniform(0.3, 2, 5000)])
    ceiling = floor[:3000] + np.array([0, 0, 3.0])
    return np.concatenate([floor, wall, ceiling]) - [0, 0, SENSOR_HEIGHT]


def make_body(identity: str, place: tuple[float, float], turn: np.ndarray) -> Any:
    joints = [
        FACTORY.make(
            "flowing_puppet_msgs/msg/BodyJoint",
            name=f"{side}_{name}",
            position=make_point(FACTORY, turn @ [place[0], place[1] + sign * width, height - SENSOR_HEIGHT]),
            confidence=0.9,
        )
        for name, (width, height) in JOINTS.items()
        for side, sign in (("left", 1), ("right", -1))
    ]
    return FACTORY.make("flowing_puppet_msgs/msg/Body", id=identity, joints=joints)


def write_bags(folder: Path, turn: np.ndarray, rejected: list[dict[str, Any]]) -> tuple[Path, Path]:
    with BagWriter(folder / "given") as given, BagWriter(folder / "made") as made:
        given.add_topic("/points", CLOUD)
        made.add_topic("/bodies", BODIES)
        for frame in range(FRAMES):
            stamp = START + frame * STEP
            header = make_header(FACTORY, stamp, "lidar")
            given.write("/points", stamp, make_cloud(FACTORY, header, scene() @ turn.T))
            bodies = [make_body(name, place, turn) for name, place in walk(frame).items()]
            made.write("/bodies", stamp, FACTORY.make(BODIES, header=header, bodies=bodies))
        told = {"body_fitter": {"stamp_ns": stamp, "candidates": rejected}} if rejected else {}
        made.add_metadata(METADATA_NAME, {"replay": json.dumps({"rejected": told})})
    return folder / "given", folder / "made"


class Picture:
    """An `<svg>` whose pixels are converted to metres by its own ticks."""

    def __init__(self, svg: str) -> None:
        self.svg = svg
        xs = re.findall(r'<text x="([\d.]+)" y="[\d.]+" class="tick centre">(-?[\d.]+)</text>', svg)
        ys = re.findall(r'<text x="[\d.]+" y="([\d.]+)" class="tick end mid">(-?[\d.]+)</text>', svg)
        self.x, self.y = (np.polyfit(at, value, 1) for at, value in (np.array(pairs, float).T for pairs in (xs, ys)))

    def metres(self, path: str) -> list[np.ndarray]:
        """Return the places (N, 2) of each piece of a path."""
        pieces = [np.array(re.findall(r"([-\d.]+),([-\d.]+)", piece), float) for piece in path.split("M")[1:]]
        return [np.column_stack([np.polyval(self.x, p[:, 0]), np.polyval(self.y, p[:, 1])]) for p in pieces]

    def dots(self, name: str) -> np.ndarray:
        (path,) = re.findall(rf'<path class="{name}" d="([^"]*)"', self.svg)
        return np.concatenate(self.metres(path))

    def tracks(self) -> list[list[np.ndarray]]:
        return [self.metres(d) for d in re.findall(r'class="track"[^>]*><path d="([^"]*)"', self.svg)]


@pytest.mark.parametrize("turn", [np.eye(3), OPTICAL], ids=["level", "optical"])
def test_tracks_and_dots_lie_where_people_and_walls_are(tmp_path: Path, turn: np.ndarray) -> None:
    data = gather_data(*write_bags(tmp_path, turn, []))
    assert data.above is not None and data.above.rejected == []
    picture = Picture(draw_above(data.above))
    assert picture.x[0] == pytest.approx(-picture.y[0], rel=0.01), "metres are equal along x and y"
    walker, stander = picture.tracks()
    assert [len(piece) for piece in walker] == [FRAMES] and [len(piece) for piece in stander] == [4, 3]
    assert np.abs(walker[0] - [walk(k)["ezuxg"] for k in range(FRAMES)]).max() < 0.02
    assert all(np.abs(piece - (6.0, 2.0)).max() < 0.02 for piece in stander)
    wall = picture.dots("cloud")
    assert 50 < len(wall) <= 4000 and np.abs(wall[:, 0] - WALL_M).max() < 0.05, "neither floor nor ceiling"
    floor = picture.dots("floor")
    assert 1000 < len(floor) <= 4000 and floor[:, 0].min() < 2.0
    colours = re.findall(r'class="track" style="stroke:([^"]*)"', picture.svg)
    assert len(set(colours)) == 2
    assert picture.svg.count(">ezuxg</text>") == picture.svg.count(">fdjnz</text>") == 1


def test_rejected_candidates_are_marked_with_their_reasons(tmp_path: Path) -> None:
    data = gather_data(*write_bags(tmp_path, np.eye(3), REJECTED))
    html = build_report_page(data)
    assert html.count('class="rejected"') == 2 and "People from above" in html
    assert "no upright &lt;body&gt; explains it" in html and "<body> explains" not in html
    assert data.above is not None
    picture = Picture(draw_above(data.above))
    marks = re.findall(r'class="rejected"><title>([^<]*)</title><path d="M([\d.]+),([\d.]+)', picture.svg)
    assert [mark[0][:9] for mark in marks] == ["no uprigh", "its shape"], "the likeliest first, nothing far away"
    corner = picture.metres(f"M{marks[0][1]},{marks[0][2]}")[0][0]
    assert np.abs(corner - (5.0, -2.5)).max() < 5 * picture.x[0], "its corner is 4 px away"


def test_a_person_seen_once_is_drawn() -> None:
    one = TrackAbove(np.array([0.0]), np.array([[2.0, 0.0]]))
    svg = draw_above(AboveData("", {"ezuxg": one}, np.zeros((0, 3)), 0.0, []))
    assert "nan" not in svg and Picture(svg).tracks()[0][0] == pytest.approx(np.array([[2.0, 0.0]]), abs=0.02)
