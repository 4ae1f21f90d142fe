# SPDX-License-Identifier: Apache-2.0
"""The track verb from keypoints to tracks, with the shipped body model, and its one-sentence refusals."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.reader import open_bag
from flowing_puppet_ros.bag.writer import BagWriter
from flowing_puppet_ros.cli import main
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

GOLDEN = Path(__file__).parents[2] / "bags" / "golden" / "golden.mcap"
MODEL = DeformableStructures.load()
PUPPET = MODEL.puppet_from_joints(MODEL.mean_joints() * 150 + [150, 110], 150.0)


def draw(shift: float) -> np.ndarray:
    """Draw the mean puppet with its own texture, `shift` px to the right, over a still background."""
    rng = np.random.default_rng(3)
    pictures = [cv2.resize(rng.integers(0, 255, (40, 60, 3)).astype(np.uint8), (320, 240)) for _ in range(2)]
    mask = np.zeros((240, 320), np.uint8)
    for contour in PUPPET.contours:
        cv2.fillPoly(mask, [np.round(contour).astype(np.int32)], 1)
    move = np.array([[1, 0, shift], [0, 1, 0]], float)
    image = pictures[0]
    cv2.copyTo(cv2.warpAffine(pictures[1], move, (320, 240)), cv2.warpAffine(mask, move, (320, 240)), image)
    return image


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), draw(2.0 * k))
    return folder


def write_keypoints(path: Path, frames: Any, names: Any = MODEL.joint_names) -> Path:
    path.write_text(json.dumps({"joint_names": names, "frames": frames}))
    return path


def start() -> list[list[float]]:
    return [[float(x), float(y), 0.9] for x, y in PUPPET.joints]


def test_tracks_follow_the_person_and_say_all_that_the_format_promises(frames: Path, tmp_path: Path) -> None:
    init, out = write_keypoints(tmp_path / "k.json", {"0": [start()]}), tmp_path / "new" / "tracks.json"
    assert main(["track", str(frames), "--init", str(init), "--out", str(out)]) == 0
    tracks = json.loads(out.read_text())
    assert tracks["joint_names"] == list(MODEL.joint_names)
    assert tracks["fps"] == 30.0
    assert [frame["index"] for frame in tracks["frames"]] == list(range(6))
    assert tracks["frames"][3]["stamp_ns"] == 100_000_000
    assert tracks["frames"][3]["path"].endswith("3.png")
    (puppet,) = tracks["frames"][5]["puppets"]
    assert puppet["id"] == "a1"
    moved = np.array(puppet["joints"])[:, :2] - PUPPET.joints
    inside = PUPPET.joints[:, 1] < 235
    np.testing.assert_allclose(np.median(moved[inside], axis=0), [10, 0], atol=1.0)
    assert [part["name"] for part in puppet["parts"]] == list(MODEL.tree.names)
    assert sorted(part["depth"] for part in puppet["parts"]) == list(range(10))
    assert np.array(puppet["parts"][0]["contour"]).shape[1] == 2


def test_same_bits_twice_and_another_seed_another_id(frames: Path, tmp_path: Path) -> None:
    init = write_keypoints(tmp_path / "k.json", {"1": [start()]})
    texts = []
    for name, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        arguments = ["track", str(frames), "--init", str(init), "--out", str(tmp_path / name), "--seed", seed]
        assert main(arguments) == 0
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]
    assert json.loads(texts[2])["frames"][1]["puppets"][0]["id"] == "b1"
    assert json.loads(texts[0])["frames"][0]["puppets"] == []


@pytest.mark.slow
def test_a_folder_of_openpose_starts_the_same_people(frames: Path, tmp_path: Path) -> None:
    places = dict(zip(MODEL.joint_names, start(), strict=True))
    order = [f"{side}_{part}" for side in ("right", "left") for part in ("shoulder", "elbow", "wrist")]
    named = write_keypoints(tmp_path / "k.json", {"1": [[places[name] for name in order]]}, order)
    values = [0.0] * 75
    for number, name in enumerate(order, 2):
        values[3 * number : 3 * number + 3] = places[name]
    folder = tmp_path / "json"
    folder.mkdir()
    for index in range(3):
        people = [{"pose_keypoints_2d": values}] if index == 1 else []
        (folder / f"{index}_keypoints.json").write_text(json.dumps({"people": people}))
    texts = []
    for init in (named, folder):
        assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "t.json")]) == 0
        texts.append(json.loads((tmp_path / "t.json").read_text())["frames"])
    assert len(texts[0][1]["puppets"]) == 1
    # In frames 0 and 2 OpenPose looked, and in ours nobody did: only what was found counts here.
    assert texts[1][1]["puppets"][0]["joints"] == texts[0][1]["puppets"][0]["joints"]


@pytest.mark.slow
def test_landmarks_in_shares_of_the_image_start_people_in_a_bag(tmp_path: Path) -> None:
    shares = {"shoulder": (0.1, 0.3), "elbow": (0.15, 0.45), "wrist": (0.16, 0.55), "hip": (0.06, 0.6)}
    texts = []
    for width, height in ((1, 1), (192, 240)):  # 192x240 are the images of the bag
        places = {
            f"{side}_{part}": {"x": (0.5 + sign * dx) * width, "y": y * height}
            for part, (dx, y) in shares.items()
            for side, sign in (("left", 1), ("right", -1))
        }
        init = tmp_path / "landmarks.json"
        init.write_text(json.dumps([places]))
        assert main(["track", str(GOLDEN), "--init", str(init), "--out", str(tmp_path / "t.json")]) == 0
        texts.append((tmp_path / "t.json").read_text())
    assert texts[0] == texts[1] and len(json.loads(texts[0])["frames"][0]["puppets"]) == 1


@pytest.mark.slow
def test_live_uses_no_later_frame_and_the_whole_clip_does(frames: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shift = np.column_stack([rng.normal(0, 4, (6, 2)), np.zeros(6)])
    shaken = {str(k): [np.add(start(), shift[k]).tolist()] for k in range(6)}
    joints = {}
    for name, count, flags in (("l6", 6, ["--live"]), ("l4", 4, ["--live"]), ("b6", 6, []), ("b4", 4, [])):
        init = write_keypoints(tmp_path / "k.json", {k: shaken[k] for k in list(shaken)[:count]})
        assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / name), *flags]) == 0
        tracks = json.loads((tmp_path / name).read_text())
        joints[name] = np.array([frame["puppets"][0]["joints"] for frame in tracks["frames"][:4]])
    np.testing.assert_array_equal(joints["l6"], joints["l4"])
    assert np.abs(joints["b6"] - joints["b4"]).max() > 0.1
    # Joints below the image have no flow to follow.
    shake = {name: np.linalg.norm(np.diff(at[:, PUPPET.joints[:, 1] < 230], 2, axis=0)) for name, at in joints.items()}
    assert shake["b6"] < 0.5 * shake["l6"]


def test_json_prints_one_object(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    init = write_keypoints(tmp_path / "k.json", {"0": [start()], "2": []})
    assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "o.json"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 6
    assert summary["ids"] == ["a1"]


def test_null_joints_are_unknown_and_none_is_written_as_nan(frames: Path, tmp_path: Path) -> None:
    person: list[Any] = start()
    person[MODEL.joint_names.index("left_wrist")] = [None, None, None]
    init = write_keypoints(tmp_path / "k.json", {"0": [person]})
    assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "o.json")]) == 0
    text = (tmp_path / "o.json").read_text()
    assert "NaN" not in text
    assert len(json.loads(text)["frames"][0]["puppets"]) == 1


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"joint_names": ["neck"], "frames": []}',
        '{"joint_names": 3, "frames": {}}',
        '{"joint_names": ["tail"], "frames": {}}',
        '{"joint_names": ["neck"], "frames": {"x": []}}',
        '{"joint_names": ["neck"], "frames": {"0": [3]}}',
        '{"joint_names": ["neck"], "frames": {"0": [[[1, 2]]]}}',
        '{"joint_names": ["neck"], "frames": {"0": [[["a", "b", "c"]]]}}',
        '{"joint_names": ["neck"], "frames": {"99": [[[1, 2, 1]]]}}',
    ],
)
def test_bad_keypoints_are_one_sentence(
    text: str, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    init = tmp_path / "k.json"
    init.write_text(text)
    assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "o.json")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "k.json" in line


def test_missing_inputs_are_one_sentence(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["track", str(tmp_path / "none.mp4"), "--out", "o.json"]) == 2
    assert "none.mp4 does not exist" in capsys.readouterr().err
    assert main(["track", str(frames), "--out", "o.json", "--init", str(tmp_path / "none.json")]) == 2
    assert "none.json cannot be read" in capsys.readouterr().err


@pytest.mark.slow
def test_without_keypoints_the_detector_looks(frames: Path, tmp_path: Path) -> None:
    for name, flags in (("whole", []), ("live", ["--live"])):
        assert main(["track", str(frames), "--out", str(tmp_path / name), *flags]) == 0
        tracks = json.loads((tmp_path / name).read_text())
        assert [frame["index"] for frame in tracks["frames"]] == list(range(6))
        for puppet in (puppet for frame in tracks["frames"] for puppet in frame["puppets"]):
            assert all(0 <= confidence <= 1 for _, _, confidence in puppet["joints"])


@pytest.mark.slow
def test_the_loop_of_the_thesis_places_the_arms_near_the_keypoints(frames: Path, tmp_path: Path) -> None:
    moved = [[[x + 2.0 * k, y, c] for x, y, c in start()] for k in range(6)]
    init = write_keypoints(tmp_path / "k.json", {str(k): [person] for k, person in enumerate(moved)})
    small = ["--thesis-loop-particles", "20", "--thesis-loop-rounds", "1", "--thesis-loop-iterations", "3"]
    for out in ("one.json", "two.json"):
        words = ["track", str(frames), "--init", str(init), "--out", str(tmp_path / out), "--method", "thesis", *small]
        assert main(words) == 0
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()
    for k, frame in enumerate(json.loads((tmp_path / "one.json").read_text())["frames"]):
        (puppet,) = frame["puppets"]
        joints = np.array(puppet["joints"])[:, :2]
        assert np.abs(joints - np.array(moved[k])[:, :2]).max() < 60


def test_the_loop_of_the_thesis_is_not_live(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["track", str(frames), "--out", str(tmp_path / "t.json"), "--method", "thesis", "--live"]
    assert main(words) == 2
    assert "exclude each other" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("flags", [[], ["--live"]])
def test_where_nobody_is_nobody_is_tracked(flags: list[str], tmp_path: Path) -> None:
    rng, folder = np.random.default_rng(2), tmp_path / "frames"
    folder.mkdir()
    ground = (np.linspace(60, 180, 240)[:, None, None] + rng.normal(0, 12, (240, 320, 3))).astype(np.uint8)
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), np.roll(ground, 2 * k, axis=1))
    assert main(["track", str(folder), "--out", str(tmp_path / "t.json"), *flags]) == 0
    assert [frame["puppets"] for frame in json.loads((tmp_path / "t.json").read_text())["frames"]] == [[]] * 4


def test_a_bag_brings_its_own_detections(tmp_path: Path) -> None:
    out = tmp_path / "tracks.json"
    assert main(["track", str(GOLDEN), "--out", str(out), "--topic", "/cam2/image/compressed"]) == 0
    tracks = json.loads(out.read_text())
    assert len(tracks["frames"]) == 8
    assert all(frame["puppets"] for frame in tracks["frames"]), "two images have no detection: flow carries the person"
    assert tracks["fps"] > 1
    assert {puppet["id"] for frame in tracks["frames"] for puppet in frame["puppets"]} == {"a1"}


def test_bags_without_the_topic_or_broken_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_text("no bag")
    for arguments, says in (([str(GOLDEN), "--topic", "/x"], "/cam1/image/compressed"), ([str(broken)], "broken.mcap")):
        assert main(["track", *arguments, "--out", str(tmp_path / "o.json")]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert says in line


@pytest.mark.parametrize(
    ("frames_of", "sentence"),
    [
        ({}, "has no person in any frame"),
        ({"0": []}, "has no person in any frame"),
        ({"9" * 5000: [start()]}, "frame '999999999999999999' must be an index"),
        ({"6": [start()]}, "has keypoints from frame 6 on"),
    ],
)
def test_keypoints_that_reach_no_frame_are_refused(
    frames_of: Any, sentence: str, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    init = write_keypoints(tmp_path / "k.json", frames_of)
    assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "t.json")]) == 2
    assert sentence in capsys.readouterr().err


def test_inputs_are_never_overwritten(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    init = write_keypoints(tmp_path / "k.json", {"0": [start()]})
    before = init.read_bytes()
    assert main(["track", str(frames), "--init", str(init), "--out", str(init)]) == 2
    assert "is an input itself" in capsys.readouterr().err
    assert init.read_bytes() == before


def test_images_that_cannot_be_used_are_named_and_left_out(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(frames / "3.png"), np.zeros((1, 1, 3), np.uint8))
    init, out = write_keypoints(tmp_path / "k.json", {"0": [start()]}), tmp_path / "t.json"
    assert main(["track", str(frames), "--init", str(init), "--out", str(out)]) == 0
    assert "frame 3: an image must be at least 16 px on each side" in capsys.readouterr().err
    assert [frame["index"] for frame in json.loads(out.read_text())["frames"]] == [0, 1, 2, 4, 5]


def test_a_bag_with_damaged_messages_or_without_its_end_is_tracked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("/cam1/image/compressed", "/cam1/detections")
    seen = 0
    with open_bag(GOLDEN) as bag, BagWriter(tmp_path / "whole.mcap") as writer:
        for name in names:
            writer.add_topic(name, bag.topics[name])
        for record in bag.messages(names):
            seen += record.topic == names[0]
            spoiled = record.topic == names[0] and seen == 3
            writer.write_raw(record.topic, record.log_time, b"\0\1\0\0" if spoiled else record.raw)
    cut, out = tmp_path / "cut.mcap", tmp_path / "t.json"
    cut.write_bytes((tmp_path / "whole.mcap").read_bytes()[:-40])
    assert main(["track", str(cut), "--out", str(out)]) == 2
    assert "add --salvage" in capsys.readouterr().err
    assert main(["track", str(cut), "--out", str(out), "--salvage"]) == 0
    assert "frame 2: a message on /cam1/image/compressed is not" in capsys.readouterr().err
    tracks = json.loads(out.read_text())
    assert [frame["index"] for frame in tracks["frames"]] == [0, 1, 3, 4, 5, 6, 7]
    assert all(frame["puppets"] for frame in tracks["frames"])


def test_overlay_shows_what_was_tracked_and_plays_back(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    init = write_keypoints(tmp_path / "k.json", {"0": [start()]})
    command = ["track", str(frames), "--init", str(init), "--out", str(tmp_path / "t.json")]
    assert main([*command, "--overlay", str(tmp_path / "o.mp4")]) == 0
    capture = cv2.VideoCapture(str(tmp_path / "o.mp4"))
    shown = [capture.read() for _ in range(7)]
    assert [read for read, _ in shown] == [True] * 6 + [False]
    picture = shown[2][1]
    assert picture.shape == (240, 640, 3)
    x, y = PUPPET.contours[0].mean(axis=0).astype(int)
    assert np.abs(picture[y, x].astype(int) - draw(4.0)[y, x]).max() > 20, "the puppet is painted over the frame"
    assert main([*command, "--overlay", str(tmp_path / "o.gif")]) == 2
    assert "must end in .mp4" in capsys.readouterr().err


def test_broken_images_cuts_and_single_frames_do_not_stop_the_run(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (frames / "1.png").write_bytes(b"\x89PNG")
    for k in (3, 4, 5):
        cv2.imwrite(str(frames / f"{k}.png"), draw(0.0)[::-1, ::-1] // 3)
    init = write_keypoints(tmp_path / "k.json", {"0": [start()], "4": [start()]})
    assert main(["track", str(frames), "--init", str(init), "--out", str(tmp_path / "t.json")]) == 0
    said = capsys.readouterr().err
    assert "1.png is not a readable image and is skipped" in said
    assert "frame 3: the picture changes as at a cut" in said
    tracks = json.loads((tmp_path / "t.json").read_text())["frames"]
    assert [frame["index"] for frame in tracks] == [0, 2, 3, 4, 5]
    assert [[p["id"] for p in frame["puppets"]] for frame in tracks] == [["a1"], ["a1"], [], ["a2"], ["a2"]]
    one = write_keypoints(tmp_path / "one.json", {"0": [start()]})
    assert main(["track", str(frames / "0.png"), "--init", str(one), "--out", str(tmp_path / "s.json")]) == 0
    assert len(json.loads((tmp_path / "s.json").read_text())["frames"]) == 1
