# SPDX-License-Identifier: Apache-2.0
"""Learning the likelihood from drawn people: it ranks right limbs first, repeats itself, and refuses too little."""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.cli.evaluate import likelihood
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.image.likelihood import Ranks, format_ranks, rank_limbs
from flowing_puppet_ros.image.formats.annotations import Annotations
from flowing_puppet_ros.learn.likelihood import command
from flowing_puppet_ros.learn.likelihood.samples import (
    MIN_WRONG_DISTANCE_M,
    ContourPerturbation,
    PosedPerson,
    perturb_contours,
    pose_people,
)
from flowing_puppet_ros.learn.likelihood.training import LikelihoodSettings, learn_likelihood
from flowing_puppet_ros.model.ds.puppet import DeformableStructures

SKIN, WIDTHS = (190, 140, 115), {"torso": 0.30, "head": 0.17, "upper_arm": 0.10, "lower_arm": 0.085}


@pytest.fixture(scope="module")
def model() -> DeformableStructures:
    return DeformableStructures.load()


def drawn_person(model: DeformableStructures, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw thick lines for limbs before a mottled wall; return the image (180, 220, 3) and the joints (15, 2) px."""
    joints = 130 * (model.mean_joints() - model.mean_joints()[0]) + (110, 60) + rng.normal(0, 4, 2)
    names = model.joint_names
    for side in ("right", "left"):
        for joint, pivot, moved in (("elbow", "shoulder", ("elbow", "wrist")), ("wrist", "elbow", ("wrist",))):
            angle = rng.normal(0, 0.7 if joint == "elbow" else 1.0)
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            centre = joints[names.index(f"{side}_{pivot}")]
            for name in moved:
                index = names.index(f"{side}_{name}")
                joints[index] = centre + (joints[index] - centre) @ turn
    coarse = rng.integers(40, 200, (9, 11, 3)).astype(np.uint8)
    image = cv2.resize(coarse, (220, 180), interpolation=cv2.INTER_CUBIC)
    shirt = tuple(int(value) for value in rng.integers(0, 256, 3))
    for part, name in enumerate(model.tree.names[:6]):
        kind = name.removeprefix("right_").removeprefix("left_")
        ends = joints[list(model.part_joints[part][:2])]
        if kind in ("head", "lower_arm"):
            ends = ends + (ends[1] - ends[0]) * [[0.0], [0.4]]
        start, end = (tuple(int(value) for value in point) for point in np.round(ends))
        cv2.line(image, start, end, SKIN if kind in ("head", "lower_arm") else shirt, round(130 * WIDTHS[kind]))
    noisy = image + rng.normal(0, 4, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), joints


@pytest.fixture(scope="module")
def album(model: DeformableStructures, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 40 annotated drawings."""
    folder = tmp_path_factory.mktemp("album")
    rng, images = np.random.default_rng(0), {}
    for index in range(40):
        image, joints = drawn_person(model, rng)
        cv2.imwrite(str(folder / f"{index:02}.png"), image[:, :, ::-1])
        images[f"{index:02}.png"] = [{"joints": [[*joint, 1] for joint in joints.tolist()], "view": "front"}]
    data = {"joint_names": model.joint_names, "images": images}
    (folder / "annotations.json").write_text(json.dumps(data))
    return folder


def flags(module: object, *words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)  # type: ignore[attr-defined]
    return parser.parse_args(words)


@pytest.fixture(scope="module")
def people(model: DeformableStructures, album: Path) -> list[PosedPerson]:
    return list(pose_people(Annotations.load(album / "annotations.json"), model, 1))


@pytest.mark.slow
def test_it_ranks_right_limbs_of_new_drawings_first(model: DeformableStructures, people: list[PosedPerson]) -> None:
    said: list[str] = []
    learned = learn_likelihood(model, people[:30], LikelihoodSettings(wrong=4), said.append)
    assert len(said) == 4 and learned.counts["upper_arm"] == learned.counts["torso"] == 60
    ranks = rank_limbs(model, learned.likelihood, iter(people[30:]), 20, 1)
    assert set(ranks) == {"torso", "head", "upper_arm", "lower_arm"}
    for kind, variants in ranks.items():
        everything = variants["all"].summarise()
        assert everything[0] > 0.85 and everything[1] <= 4, f"{kind}: {everything}"
    beaten = ranks["lower_arm"]["only skin"].summarise()[0]
    assert 0.7 < beaten < ranks["lower_arm"]["all"].summarise()[0] + 0.05
    without, only = (ranks["upper_arm"][f"contour, {word} on"].summarise()[0] for word in ("without", "only"))
    assert only > 0.7 and without > 0.6
    again = learn_likelihood(model, people[:30], LikelihoodSettings(wrong=4), said.append).likelihood.to_arrays()
    for name, values in learned.likelihood.to_arrays().items():
        np.testing.assert_array_equal(again[name], values)


@pytest.mark.slow
def test_the_command_writes_weights_and_a_card(album: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "weights"
    words = (str(album / "annotations.json"), "--wrong", "2", "--out", str(out))
    assert command.run(flags(command, *words)) == 0
    assert capsys.readouterr().out.strip() == str(out / "likelihood_10.npz")
    card = (out / "likelihood_10.md").read_text()
    assert "40 people in 40 files" in card and "--wrong 2" in card
    assert str(album) not in card, "paths of this machine are nobody's business"


def test_too_little_is_refused_in_a_sentence(model: DeformableStructures, album: Path, tmp_path: Path) -> None:
    data = json.loads((album / "annotations.json").read_text())
    few = album / "few.json"
    few.write_text(json.dumps(data | {"images": dict(list(data["images"].items())[:4])}))
    with pytest.raises(InputError, match=r"show 8 torsos; learning needs at least 20"):
        command.run(flags(command, str(few), "--out", str(tmp_path)))
    words = (str(album / "annotations.json"), "--leave-out", str(album / "annotations.json"), "--out", str(tmp_path))
    with pytest.raises(InputError, match="has no person whose joints determine a scale"):
        command.run(flags(command, *words))


@pytest.mark.slow
def test_the_table_of_the_evaluation(album: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = (str(album / "annotations.json"), "--wrong", "2")
    assert likelihood.run(flags(likelihood, *words)) == 0
    assert "| lower_arm | only skin | 80 |" in capsys.readouterr().out
    for bad, message in ((("--every", "0"), "--every is 0"), (("--seed", "-1"), "--seed is -1")):
        with pytest.raises(InputError, match=message):
            likelihood.run(flags(likelihood, str(album / "annotations.json"), *bad))


def test_ranks_are_told_as_they_are() -> None:
    ranks = Ranks(np.array([0.0, 1.0, 0.5, 10.0]), 10)
    assert ranks.summarise() == pytest.approx((1 - 11.5 / 40, 1.75, 0.5, 0.75))
    assert "| head | all | 4 | 71.2 % | 1.75 of 11 | 50 % | 75 % |" in format_ranks({"head": {"all": ranks}})


@pytest.mark.parametrize("part", range(6))
def test_wrong_contours_are_wrong_and_moves_rigid_when_asked(model: DeformableStructures, part: int) -> None:
    puppet = model.puppet_from_joints(100 * model.mean_joints(), 100.0)
    rng = np.random.default_rng(part)
    wrong = perturb_contours(model, puppet, part, 30, ContourPerturbation(far=0.3), rng)
    assert np.hypot(*np.moveaxis(wrong - puppet.contours[part], 2, 0)).mean(axis=1).min() > 100 * MIN_WRONG_DISTANCE_M
    rigid = perturb_contours(model, puppet, part, 10, ContourPerturbation(stretch=0.0), rng)
    edges = np.linalg.norm(np.diff(rigid, axis=1), axis=2)
    np.testing.assert_allclose(edges, np.tile(np.linalg.norm(np.diff(puppet.contours[part], axis=0), axis=1), (10, 1)))
