# SPDX-License-Identifier: Apache-2.0
"""`fit --scene FOLDER`: two people whom no puppet model made keep their ids through the scans of a folder."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from fit_verb import FAST, fitted  # type: ignore[import-not-found]

from flowing_puppet_ros.evaluate.body.synthetic_scans import make_box
from flowing_puppet_ros.evaluate.scene.synthetic_scenes import scan_scene

LEARN = pytest.mark.skipif(not (find_spec("anny") and find_spec("body_models")), reason="needs the extra learn")
NAMES = ("scan8", "scan9", "scan10")
STARTS = np.array([[5.0, -1.5, 0.0], [6.5, 1.5, 0.0]])
STEPS = np.array([[0.0, 0.12, 0.0], [0.0, -0.12, 0.0]])
HEIGHT = 1.5


def write_scans(folder: Path) -> None:
    """Three scans of a floor, a wall and two people who walk towards each other, by a LiDAR at HEIGHT."""
    from flowing_puppet_ros.learn.anny.body import AnnyBody

    anny = AnnyBody("neutral")
    rest = anny.make_rest_body(anny.mean_phenotype())
    standing = rest.vertices - [*rest.vertices[:, :2].mean(axis=0), rest.vertices[:, 2].min()]
    around = [
        make_box(np.array([0, 0, -0.05]), np.array([40, 40, 0.1]), np.eye(3)),
        make_box(np.array([12.0, 0, 1.5]), np.array([0.2, 40, 3]), np.eye(3)),
    ]
    folder.mkdir()
    for number, name in enumerate(NAMES):
        people = [(standing + place, anny.triangles) for place in STARTS + number * STEPS]
        points, _ = scan_scene(around, people, np.random.default_rng(number), "spinning-64", HEIGHT)
        np.save(folder / f"{name}.npy", points)


@LEARN
@pytest.mark.slow
def test_two_people_keep_their_ids(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scans(tmp_path / "scans")
    status, scans, _ = fitted(capsys, tmp_path / "scans", "--scene", "--out", tmp_path / "o", *FAST)
    assert status == 0
    assert [Path(scan["input"]).stem for scan in scans] == list(NAMES), "scan10 comes last"
    ids: list[list[str]] = []
    for number, (name, scan) in enumerate(zip(NAMES, scans, strict=True)):
        near = {}
        for person in scan["people"]:
            assert person["output"] == str(tmp_path / "o" / f"{name}-{person['id']}.npz") and person["view"] == "single"
            with np.load(person["output"]) as fit:
                middle = fit["vertices"].mean(axis=0)[:2]
            away = np.linalg.norm(STARTS[:, :2] + number * STEPS[:, :2] - middle, axis=1)
            assert away.min() < 0.15
            near[int(away.argmin())] = person["id"]
        assert len(scan["people"]) == 2 and set(near) == {0, 1}
        ids.append([near[0], near[1]])
    assert sorted(ids[0]) == ["b1", "b2"] and ids[1] == ids[2] == ids[0]


def test_what_cannot_be_tracked_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scans").mkdir()
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / "scans" / name, np.random.default_rng(0).uniform(0, 5, (50, 3)))
    flags = ("--scene", "--out", tmp_path / "o")
    for arguments, part in (
        ((tmp_path / "scans", tmp_path / "scans" / "a.npy"), "give one folder"),
        ((tmp_path / "scans", "--scan-rate", "0"), "--scan-rate is 0"),
        ((tmp_path / "scans", "--upright", "any"), "are upright"),
    ):
        status, _, (sentence,) = fitted(capsys, *arguments, *flags)
        assert status == 2 and part in sentence
    np.save(tmp_path / "scans" / "c.npy", np.zeros((0, 3)))
    status, scans, sentences = fitted(capsys, tmp_path / "scans", *flags, *FAST)
    assert status == 1 and [scan.get("people") for scan in scans] == [[], [], None]
    assert len(sentences) == 1 and "c.npy" in sentences[0]
