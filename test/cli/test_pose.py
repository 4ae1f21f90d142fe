# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet pose`: its file, its flags, and one sentence for what cannot be used."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli import main
from flowing_puppet_ros.model.ds.puppet import DeformableStructures
from flowing_puppet_ros.model.ds.render import depth_order, render_labels

MODEL = DeformableStructures.load()
JOINTS = MODEL.likely_puppet().joints * 70 + [110, 60]
QUICK = ("--particles", "12", "--iterations", "1")


@pytest.fixture
def person(tmp_path: Path) -> Path:
    """An image with a person on it."""
    puppet = MODEL.puppet_from_joints(JOINTS, 70.0)
    labels = render_labels(puppet.contours, depth_order(MODEL), (200, 220))
    path = tmp_path / "person.png"
    assert cv2.imwrite(str(path), np.where(labels[..., None] > 0, [90, 140, 200], 40).astype(np.uint8))
    return path


@pytest.fixture
def init(tmp_path: Path) -> Path:
    path = tmp_path / "keypoints.json"
    people = [[[*xy, 1.0] for xy in JOINTS]]
    path.write_text(json.dumps({"joint_names": MODEL.joint_names, "frames": {"0": people, "2": people * 2}}))
    return path


def poses(out: Path) -> dict:
    return json.loads(out.read_text(), parse_constant=lambda name: pytest.fail(f"{name} in the file"))


def test_file_has_what_was_agreed(tmp_path: Path, person: Path, init: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "poses.json"
    images = [str(person)] * 3
    assert main(["pose", *images, "--out", str(out), "--init", str(init), "--json", *QUICK, "--solutions", "4"]) == 0
    data = poses(out)
    assert data["joint_names"] == list(MODEL.joint_names)
    assert [len(frame["puppets"]) for frame in data["frames"]] == [1, 0, 2]
    assert [frame["index"] for frame in data["frames"]] == [0, 1, 2]
    assert all(frame["path"] == str(person) and isinstance(frame["stamp_ns"], int) for frame in data["frames"])
    puppet = data["frames"][0]["puppets"][0]
    assert {"id", "scale", "energy", "joints", "parts", "view", "model", "solutions", "gender_probability"} <= set(
        puppet
    )
    assert np.array(puppet["joints"]).shape == (15, 3)
    assert np.linalg.norm(np.array(puppet["joints"])[:, :2] - JOINTS, axis=1).max() < 8
    assert puppet["scale"] == pytest.approx(70, rel=0.1)
    assert [part["name"] for part in puppet["parts"]] == list(MODEL.tree.names)
    assert sorted(part["depth"] for part in puppet["parts"]) == list(range(10))
    assert all(np.array(part["contour"]).shape[1] == 2 for part in puppet["parts"])
    energies = [one["energy"] for one in puppet["solutions"]]
    assert len(energies) == 4 and energies == sorted(energies) and energies[0] == puppet["energy"]
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [len(line["puppets"]) for line in lines] == [1, 0, 2]


def test_same_seed_same_bytes(tmp_path: Path, person: Path, init: Path) -> None:
    files = [tmp_path / f"{k}.json" for k in range(3)]
    for out, seed in zip(files, ("3", "3", "4"), strict=True):
        assert main(["pose", str(person), "--out", str(out), "--init", str(init), "--seed", seed, *QUICK]) == 0
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()


def test_models_and_parts_by_choice(tmp_path: Path, person: Path, init: Path) -> None:
    out = tmp_path / "poses.json"
    flags = ["--out", str(out), "--init", str(init), "--model", "auto", "--parts", "14", *QUICK]
    assert main(["pose", str(person), *flags]) == 0
    (puppet,) = poses(out)["frames"][0]["puppets"]
    assert len(puppet["parts"]) == 14 and puppet["model"].endswith("-14")
    assert sum(puppet["gender_probability"].values()) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (200, 220), (20, 3000)])
def test_images_without_a_person_have_none(tmp_path: Path, shape: tuple[int, int]) -> None:
    path, out = tmp_path / "empty.png", tmp_path / "poses.json"
    assert cv2.imwrite(str(path), np.full(shape, 128, np.uint8))
    assert main(["pose", str(path), "--out", str(out), *QUICK]) == 0
    assert poses(out)["frames"][0]["puppets"] == []


def test_a_folder_with_a_broken_image_is_done_but_for_that(
    tmp_path: Path, person: Path, init: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "folder", tmp_path / "poses.json"
    folder.mkdir()
    (folder / "a.png").write_bytes(person.read_bytes())
    (folder / "b.png").write_bytes(person.read_bytes()[:100])
    (folder / "c.png").write_bytes(person.read_bytes())
    assert main(["pose", str(folder), "--out", str(out), "--init", str(init), *QUICK]) == 1
    assert [len(frame["puppets"]) for frame in poses(out)["frames"]] == [1, 2]
    assert "b.png is not a readable image" in capsys.readouterr().err


@pytest.mark.parametrize("case", ["missing", "broken", "video", "output", "late", "folder", "value"])
def test_unusable_input_is_one_sentence(
    tmp_path: Path, person: Path, init: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    image, out, flags = str(person), tmp_path / "poses.json", ["--init", str(init)]
    if case == "missing":
        image = str(tmp_path / "none.png")
    if case == "broken":
        person.write_bytes(b"no image")
    if case == "video":
        image = str(init)
    if case == "output":
        out = person
    if case == "late":
        init.write_text(json.dumps({"joint_names": ["neck"], "frames": {"7": [[[1, 2, 1]]]}}))
    if case == "folder":
        image = str(tmp_path / "empty")
        (tmp_path / "empty").mkdir()
    if case == "value":
        flags += ["--particles", "1"]
    assert main(["pose", image, "--out", str(out), *flags]) == 2
    told = capsys.readouterr().err
    assert told.startswith("flowing-puppet pose: ") and told.count("\n") == 1


@pytest.mark.slow
def test_other_detectors_files_are_read_by_the_names_of_images(
    tmp_path: Path, person: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same places as ours, as COCO's annotations of `person.jpg` and as shares of the image; other names fail."""
    out, coco = tmp_path / "poses.json", tmp_path / "coco.json"
    joints = dict(zip(MODEL.joint_names, JOINTS, strict=True))
    order = [
        f"{side}_{part}"
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ]
    values = [0.0] * 15 + [number for name in order for number in (*joints[name], 2.0)]
    annotation = {"image_id": 5, "category_id": 1, "keypoints": values}
    data = {"images": [{"id": 9, "file_name": "other.jpg"}, {"id": 5, "file_name": "person.jpg"}]}
    coco.write_text(json.dumps(data | {"annotations": [annotation]}))
    assert main(["pose", str(person), "--out", str(out), "--init", str(coco), *QUICK]) == 0
    (found,) = poses(out)["frames"][0]["puppets"]
    arms = [MODEL.joint_names.index(name) for name in order[:6]]
    assert np.linalg.norm(np.array(found["joints"])[arms, :2] - JOINTS[arms], axis=1).max() < 12
    shares = [{"x": x / 220, "y": y / 200, "name": name} for name, (x, y) in joints.items() if name in order]
    (tmp_path / "media.json").write_text(json.dumps([{"image": "person.png", "landmarks": shares}]))
    assert (
        main(["pose", str(person), "--out", str(tmp_path / "b.json"), "--init", str(tmp_path / "media.json"), *QUICK])
        == 0
    )
    np.testing.assert_allclose(
        np.array(poses(tmp_path / "b.json")["frames"][0]["puppets"][0]["joints"])[arms],
        np.array(found["joints"])[arms],
        atol=0.02,
    )
    coco.write_text(json.dumps(data | {"annotations": [annotation | {"image_id": 9}]}))
    capsys.readouterr()
    assert main(["pose", str(person), "--out", str(out), "--init", str(coco), *QUICK]) == 2
    assert "has no person in any frame" in capsys.readouterr().err
