# SPDX-License-Identifier: Apache-2.0
"""The report of small made-up replays: what it gathers, and the page it makes."""

import base64
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.bag.recording import read_recording
from flowing_puppet_ros.report.data import gather_data
from flowing_puppet_ros.report.pictures.bag_pictures import ImageBox, body_axes
from flowing_puppet_ros.report.report import build_report_page, make_collage, write_report

type Replay = Callable[..., tuple[Path, Path]]

VOID = {"meta", "img", "input", "br", "line", "circle", "path", "image"}


class Page(HTMLParser):
    """Checks that tags are closed in order, and keeps what a page refers to."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.ids: list[str | None] = []
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        self.links += [str(values[key]) for key in ("src", "href", "action", "srcset") if key in values]
        if tag == "img":
            self.images.append(values)
        if "id" in values:
            self.ids.append(values["id"])

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def page_of(replay: Replay, **content: bool) -> tuple[str, Page]:
    html = build_report_page(gather_data(*replay(**content)))
    return html, Page(html)


@pytest.mark.slow
def test_the_whole_page_stands_alone(replay: Replay) -> None:
    html, page = page_of(replay)
    assert page.open == [] and html.startswith("<!DOCTYPE html>")
    assert all(link.startswith(("data:image/", "#")) for link in page.links)
    assert not re.search(r"https?:|@import|url\(|file:", html)
    assert all(image.get("alt") for image in page.images)
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    # 5 frames of track and bodies, 3 pictures of each of 4 flows, for 3 bodies 2 sides and 2 cameras, 2 colour scales.
    assert len(page.images) == 2 * 5 + 3 * 4 + 3 * (2 + 2) + 2
    for image in page.images:
        data = base64.b64decode(str(image["src"]).split(",", 1)[1])
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    assert len(html) < 2_000_000


@pytest.mark.slow
def test_figures_are_those_of_the_bags(replay: Replay) -> None:
    data = gather_data(
        *replay(),
        summary={
            "frames_per_second": 12.5,
            "settings": {"tracker": {"seed": 3}},
            "counters": {"left/tracker": {"searches for everybody": 2, "paired detections": 0}},
        },
    )
    assert data.shown_camera == "front"
    front = data.camera("front")
    assert front is not None and (front.tracked, front.images, front.switches) == (5, 5, 0)
    assert front.errors.distance == pytest.approx(np.full((5, 12), 3.0), abs=1e-4)
    assert front.errors_cm.mean == pytest.approx(300 / 65, abs=1e-4)
    assert front.swapped == {"arms": (0, 5), "legs": (0, 5)}
    assert front.energy.tolist() == [12.5] * 5 and front.seconds == pytest.approx(np.arange(5) / 10)
    assert front.part_confidence == pytest.approx(np.full((1, 5), 0.7))
    assert data.bodies is not None
    assert data.bodies.errors.distance == pytest.approx(np.full((3, 12), 0.03), abs=2e-3)
    assert data.bodies.energy.tolist() == [2.5, 4.5, 6.5]
    text = Page(build_report_page(data)).text
    assert "People found by keypoint networks" in " ".join(text.split())
    assert "12.5 images/s" in text and "tracker: settings" in text and "arms 0 of 5, legs 0 of 5" in text


def test_puppet_flow_follows_the_walk(replay: Replay) -> None:
    data = gather_data(*replay())
    assert [shot.stamp for shot in data.flow] == sorted(shot.stamp for shot in data.flow) and len(data.flow) == 4
    for shot in data.flow:
        assert shot.explained > 0.9
        # 2 cm at 4 m are 1.3 px to the right (red); the background stays (white).
        red = shot.puppet_flow.astype(int)
        assert ((red[..., 0] > 240) & (red[..., 1] < 140)).sum() > 50
        assert (red.min(axis=2) > 225).mean() > 0.5


@pytest.mark.slow
def test_body_is_drawn_where_the_cameras_see_it(replay: Replay) -> None:
    given, made = replay()
    data = gather_data(given, made)
    assert sorted(name for name, _ in data.body_shots[0].views) == ["front", "side"]
    for shot in data.body_shots:
        for picture in (shot.front, shot.side):
            assert (picture != 250).any(axis=2).mean() > 0.1
        for _, picture in shot.views:
            height, width = picture.shape[:2]
            # The wall is dark and the box is grey: only the box is bright in the middle of the cut.
            assert picture[height // 3 : height // 2, 2 * width // 5 : 3 * width // 5].mean() > 100


def test_bystanders_do_not_disturb_the_reference(replay: Replay) -> None:
    data = gather_data(*replay(bystander=True))
    assert data.bodies is not None and data.bodies.errors.mean == pytest.approx(0.03, abs=2e-3)
    assert all(camera.errors.mean == pytest.approx(3.0, abs=1e-4) for camera in data.cameras)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "sentences"),
    [
        ({"bodies": False}, ["The output bag has no 3D bodies"]),
        ({"puppets": False}, ["The output bag has no puppets", "no flow to show"]),
        ({"images": False}, ["The input bag has no images", "no flow to show"]),
        ({"detections": False}, ["The input bag has no detections"]),
    ],
)
def test_missing_parts_are_said_in_a_sentence(replay: Replay, content: dict[str, bool], sentences: list[str]) -> None:
    _, page = page_of(replay, **content)
    assert page.open == [] and all(sentence in page.text for sentence in sentences)
    assert "nan" not in page.text.lower().split()


def test_bags_without_results_are_refused(replay: Replay, tmp_path: Path) -> None:
    given, _ = replay(puppets=False, bodies=False, images=False)
    with pytest.raises(InputError, match="there is no bag"):
        gather_data(given, tmp_path / "missing")
    with pytest.raises(InputError, match=r"neither puppets nor bodies; its topics are .*/front/detections"):
        gather_data(given, given)


def test_recording_knows_cameras_and_images(replay: Replay) -> None:
    given, made = replay()
    with open_bag(given) as source, open_bag(made) as result:
        recording = read_recording(source, result)
    assert sorted(recording.cameras) == ["/front", "/side"]
    front = recording.cameras["/front"]
    assert front.image_topic == "/front/image/compressed" and front.name == "front" and len(front.detections) == 5
    assert front.camera is not None
    assert front.camera.centre == pytest.approx([4, 0, 0.9], abs=1e-9)
    pixels, _ = front.camera.project(np.array([[0, 0.5, 0.9]]))
    assert pixels[0] == pytest.approx([59.5 + 260 * 0.5 / 4, 79.5])
    assert recording.cloud_topics == {"hull": "/hull", "body_vertices": "/body_vertices"}
    assert recording.body_frame == "world" and len(recording.triangles) == 12


@pytest.mark.slow
def test_command_line_writes_the_page_and_the_picture(
    replay: Replay, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, made = replay()
    before = set(tmp_path.rglob("*"))
    page, picture = tmp_path / "report.html", tmp_path / "demo.png"
    assert main(["report", str(made), "--input", str(given), "--out", str(page), "--picture", str(picture)]) == 0
    assert capsys.readouterr().out.strip() == str(page)
    assert set(tmp_path.rglob("*")) - before == {page, picture}
    assert cv2.imread(str(picture)).shape == make_collage(gather_data(given, made)).shape  # type: ignore[union-attr]


def test_command_line_says_what_is_wrong(replay: Replay, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given, made = replay(bodies=False)
    noise = tmp_path / "noise.mcap"
    noise.write_bytes(b"no bag" * 50)
    for arguments in (
        [str(tmp_path / "missing.mcap"), "--input", str(given)],
        [str(noise), "--input", str(given)],
        [str(made), "--input", str(given), "--out", str(noise / "folder.html")],
    ):
        assert main(["report", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and "Traceback" not in error


@pytest.mark.slow
def test_the_same_bags_make_the_same_page(replay: Replay, tmp_path: Path) -> None:
    given, made = replay()
    pages = []
    for name in ("a.html", "b.html"):
        write_report(given, made, tmp_path / name, {"seconds": 2.0})
        pages.append((tmp_path / name).read_bytes())
    assert pages[0] == pages[1]


def test_the_output_alone_shows_its_overlays_bodies_and_settings(replay: Replay) -> None:
    _, made = replay(overlays=True)
    data = gather_data(made, made)
    assert [round(float(picture.mean()) / 40) for _, picture in data.strip] == [0, 1, 2, 3, 4]
    assert data.scene is not None and len(data.scene["frames"]) == 3 and data.flow == []
    text = Page(build_report_page(data)).text
    assert "front/puppet_tracker: settings" in text and "particles" in text and "42" in text


@pytest.mark.slow
def test_settings_that_are_alike_stand_in_one_table(replay: Replay) -> None:
    summary = {
        "settings": {"cam01/tracker": {"seed": 3}, "cam02/tracker": {"seed": 3}, "fitter": {"seed": 4}},
        "seconds_of": {"fitter": 1.25},
        "warnings": ["an image was <bad>"],
    }
    text = Page(build_report_page(gather_data(*replay(), summary=summary))).text
    assert "cam01/tracker, cam02/tracker: settings" in text and "fitter: time" in text
    assert "1 warning(s)" in text and "an image was <bad>" in text


def test_facing_finds_up_in_other_frames() -> None:
    upright = {
        f"{side}_{joint}": np.array([0.0, y, z])
        for side, y in (("left", 0.2), ("right", -0.2))
        for joint, z in (("shoulder", 1.4), ("hip", 0.9))
    }
    assert np.allclose(body_axes(upright), np.eye(3))
    # In an optical frame (x right, y down, z away) a person who faces the camera has its left at the right.
    optical = {name: np.array([p[1], -p[2], 3 - p[0]]) for name, p in upright.items()}
    assert np.allclose(body_axes(optical), [[0, 0, -1], [1, 0, 0], [0, -1, 0]])
    assert np.allclose(body_axes({}), np.eye(3))


@pytest.mark.parametrize("points", [[[30, 40], [50, 90]], [[-80, 5], [20, 10]], [[90, 70], [130, 500]]])
def test_boxes_hold_their_points_and_stay_in_the_image(points: list[list[float]]) -> None:
    shape = (120, 100, 3)
    box = ImageBox.around(np.array([*points, [np.nan, 3.0]]), shape, 0.1, aspect=0.75)
    assert 0 <= box.left < box.right <= 100 and 0 <= box.top < box.bottom <= 120
    inside = np.clip(points, 0, (99, 119))
    assert (inside >= (box.left, box.top)).all() and (inside < (box.right, box.bottom)).all()
    part = box.crop(np.zeros(shape))
    assert part.shape[1] / part.shape[0] == pytest.approx(0.75, abs=0.02) or 100 in part.shape or 120 in part.shape
    assert ImageBox.around(np.full((2, 2), np.nan), shape, 0.1) == ImageBox(0, 0, 100, 120)


def test_people_in_space_are_shown_in_all_cameras_and_compared_with_their_puppets(replay: Replay) -> None:
    data = gather_data(*replay(space=True))
    html = build_report_page(data)
    assert data.space is not None and data.space.ids == ["b1"]
    assert [sorted(pictures) for _, pictures in data.space.moments] == [["front", "side"]] * 3
    for each in data.space.reprojection.values():  # puppets are 3 px beside the truth, and one wrist is 50 cm off
        assert len(each.pixels) == 5 * 12 and each.agrees.sum() == 5 * 11
        assert each.mean_of_agreeing == pytest.approx(3.0, abs=0.01)
        assert each.pixels[~each.agrees].min() > 20
    assert "People in all cameras" in Page(html).text and "Heights of the joints of b1" in html


def test_without_people_in_space_there_is_no_section(replay: Replay) -> None:
    data = gather_data(*replay())
    assert data.space is None and "People in all cameras" not in build_report_page(data)
