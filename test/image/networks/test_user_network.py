# SPDX-License-Identifier: Apache-2.0
"""Networks of the user's own, run for real: from description and file to keypoints in the image."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson
from flowing_puppet_ros.image.networks.user_network import NetworkDescription, UserNetwork
from test.helpers.tiny_networks import Colours, write_onnx, write_tflite

SIZE = (64, 48)
NAMES = ["left_shoulder", "right_wrist"]
type Writer = Callable[..., bytes]


@pytest.fixture(params=["onnx", "tflite"])
def kind(request: pytest.FixtureRequest) -> str:
    if request.param == "tflite":
        pytest.importorskip(
            "ai_edge_litert", reason="LiteRT is not installed: pip install 'flowing_puppet_ros[neural]'"
        )
    return str(request.param)


@dataclass
class Finder:
    """Finds the same people in every image, and remembers how it was asked."""

    people: list[FoundPerson]
    asked: list[tuple[int, bool]] = field(default_factory=list)

    def find(
        self, image: Any, known: Sequence[Keypoints] = (), everybody: bool = True, max_people: int = 6
    ) -> list[FoundPerson]:
        self.asked.append((len(known), everybody))
        return self.people


def person(*places: tuple[float, float]) -> Keypoints:
    return Keypoints(("left_shoulder", "right_hip"), np.array(places), np.ones(2))


def load(
    folder: Path,
    kind: str,
    decoder: str,
    outputs: dict[str, np.ndarray],
    finder: Finder | None = None,
    factors: Colours = (1, 1, 1),
    **told: Any,
) -> UserNetwork:
    """Write a network and its description, and load it."""
    if kind == "onnx" and tuple(map(int, cv2.__version__.split(".")[:2])) < (4, 7):
        pytest.skip("OpenCV 4.6 cannot run the constant outputs of the tiny network")
    write: Writer = write_tflite if kind == "tflite" else write_onnx
    (folder / f"tiny.{kind}").write_bytes(write(SIZE, outputs, factors))
    lines = {"file": f"tiny.{kind}", "decoder": decoder, "input": list(SIZE), "joints": NAMES} | told
    description = folder / "network.yaml"
    description.write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    return UserNetwork.load(description, finder)


def image(size: tuple[int, int] = (128, 96), colour: tuple[int, int, int] = (255, 255, 255)) -> np.ndarray:
    return np.full((size[1], size[0], 3), colour, np.uint8)


YOLO = np.array([[32.0, 24, 20, 30, 0.9, 10, 20, 0.8, 40, 30, 0.6]])
MOVENET = np.array([[0.5, 0.25, 0.9, 0.75, 0.5, 0.4, 0, 0, 0, 0, 0.8]])


def spots(places: Sequence[tuple[int, int]], values: Sequence[float]) -> np.ndarray:
    """Return heat maps (1, K, 12, 16) with one pixel each."""
    maps = np.zeros((1, len(places), 12, 16))
    for k, ((x, y), value) in enumerate(zip(places, values, strict=True)):
        maps[0, k, y, x] = value
    return maps


def test_yolo_and_movenet_find_people_in_the_pixels_of_the_image(tmp_path: Path, kind: str) -> None:
    """The image is twice as large as the input: its pixel x is at (x + 0.5) / 2 - 0.5 there."""
    (found,) = load(tmp_path, kind, "yolo", {"out": YOLO.T[None]}).find(image())
    assert found.keypoints.names == tuple(NAMES) and found.score == pytest.approx(0.9, rel=1e-5)
    np.testing.assert_allclose(found.keypoints.xy, [(20.5, 40.5), (80.5, 60.5)], rtol=1e-5)
    np.testing.assert_allclose(found.keypoints.confidence, (0.8, 0.6), rtol=1e-5)
    (found,) = load(tmp_path, kind, "movenet", {"out": MOVENET[None]}).find(image())
    np.testing.assert_allclose(found.keypoints.xy, [(31.5, 47.5), (63.5, 71.5)], rtol=1e-5)


def test_bars_beside_an_image_of_another_shape_are_no_part_of_it(tmp_path: Path, kind: str) -> None:
    network = load(tmp_path, kind, "yolo", {"out": 2 * YOLO[None]})  # half of what it sees is black
    (found,) = network.find(image((64, 24)))
    np.testing.assert_allclose(found.keypoints.xy, [(10, 20 - 12), (40, 30 - 12)], atol=0.01)
    assert found.score == pytest.approx(0.9, rel=1e-5)


@pytest.mark.parametrize(
    ("told", "colour", "scale"),
    [
        ({}, (255, 0, 51), 1.0 + 0.2 * 4),
        ({"colours": "bgr"}, (51, 0, 255), 1.0 + 0.2 * 4),
        ({"mean": 51, "deviation": 102}, (153, 0, 51), 1.0),
        ({"mean": "[10, 20, 30]", "deviation": "[100, 1, 50]"}, (110, 0, 30), 1.0),
        ({"colours": "bgr", "mean": "[10, 20, 30]", "deviation": "[100, 1, 50]"}, (130, 9, 10), 4 * 2.0),
    ],
)
def test_colours_are_what_the_description_says(
    tmp_path: Path, kind: str, told: dict[str, Any], colour: tuple[int, int, int], scale: float
) -> None:
    """The network's output is a constant times its first colour plus four times its third one."""
    network = load(tmp_path, kind, "yolo", {"out": YOLO[None] / scale}, factors=(3, 0, 12), **told)
    (found,) = network.find(image(SIZE, colour))
    np.testing.assert_allclose(found.keypoints.xy, [(10, 20), (40, 30)], rtol=1e-4)


def test_simcc_and_heat_maps_look_at_the_box_of_whom_somebody_found(tmp_path: Path, kind: str) -> None:
    """The box of 160 by 120 px is widened by a quarter; the input shows it reduced to 64 by 48."""
    finder = Finder([FoundPerson(person((100.0, 100.0), (260.0, 220.0)), 0.5)])
    across, down = np.zeros((1, 2, 128)), np.zeros((1, 2, 96))
    across[0, 0, 0], down[0, 0, 0] = 0.5, 0.5  # the box's first pixel
    across[0, 1, 64], down[0, 1, 48] = 0.6, 0.8
    network = load(tmp_path, kind, "simcc", {"x": 1.0 * across, "a_y": down}, finder)
    (found,) = network.find(image((400, 300)))
    step = 1.25 * 160 / 64
    first = np.array([180.0, 160.0]) - step * (np.array(SIZE) - 1) / 2
    np.testing.assert_allclose(found.keypoints.xy, [first, first + step * np.array([32, 24])], atol=1e-3)
    np.testing.assert_allclose(found.keypoints.confidence, (0.5, 0.6), rtol=1e-5)
    network = load(tmp_path, kind, "heatmap", {"out": spots([(0, 0), (8, 6)], [0.5, 0.7])}, finder)
    (found,) = network.find(image((400, 300)))
    middles = np.array([(0.5, 0.5), (8.5, 6.5)]) * 4 - 0.5
    assert np.abs(found.keypoints.xy - (first + step * middles)).max() <= 0.26 * 4 * step
    assert finder.asked == [(0, True)] * 2


def test_known_people_are_looked_at_without_the_finder_unless_everybody_is_wanted(tmp_path: Path) -> None:
    finder = Finder([FoundPerson(person((10.0, 10.0), (50.0, 50.0)), 0.5)] * 3)
    network = load(tmp_path, "onnx", "heatmap", {"out": spots([(8, 6), (8, 6)], [0.5, 0.7])}, finder)
    unknown = person((np.nan, np.nan), (4.0, 5.0))
    found = network.find(image(), [person((60.0, 60.0), (80.0, 80.0)), unknown], everybody=False)
    assert len(found) == 1 and np.abs(found[0].keypoints.xy - 70).max() < 3 and not finder.asked
    found = network.find(image(), [person((60.0, 60.0), (80.0, 80.0))], max_people=2)
    assert len(found) == 2 and finder.asked == [(1, True)]


def test_people_below_the_score_are_left_out_and_joints_without_score_unknown(tmp_path: Path) -> None:
    rows = np.array([YOLO[0], YOLO[0] + [200, 0, 0, 0, -0.4, *[0] * 6]])
    assert len(load(tmp_path, "onnx", "yolo", {"out": rows[None]}, min_score=0.4).find(image())) == 2
    people = load(tmp_path, "onnx", "yolo", {"out": rows[None]}, min_score=0.6).find(image())
    assert [round(one.score, 3) for one in people] == [0.9]
    rows[0, 7], rows[0, 10] = 0.0, 3.0
    (found,) = load(tmp_path, "onnx", "yolo", {"out": rows[:1][None]}).find(image())
    assert np.isnan(found.keypoints.xy[0]).all() and found.keypoints.confidence.tolist() == [0.0, 1.0]
    assert load(tmp_path, "onnx", "yolo", {"out": rows[None]}).find(image(colour=(0, 0, 0))) == []


def test_grey_images_are_taken_and_others_are_one_sentence(tmp_path: Path) -> None:
    network = load(tmp_path, "onnx", "yolo", {"out": YOLO[None]}, factors=(0, 0, 3))
    assert len(network.find(image()[..., 0])) == 1 and len(network.find(image((1, 1)))) == 1
    with pytest.raises(InputError, match="must be RGB or grey uint8"):
        network.find(image().astype(float))


def test_an_input_that_the_network_does_not_take_is_one_sentence(tmp_path: Path, kind: str) -> None:
    network = load(tmp_path, kind, "yolo", {"out": YOLO[None]}, input=[32, 32])
    with pytest.raises(InputError, match="check `input` in its description") as error:
        network.find(image())
    assert "\n" not in str(error.value) and "32, 32" in str(error.value)


def test_a_network_of_whole_numbers_takes_the_pixels_as_they_are(tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert", reason="LiteRT is not installed: pip install 'flowing_puppet_ros[neural]'")
    (tmp_path / "whole.tflite").write_bytes(write_tflite(SIZE, {"out": YOLO[None] / 200}, whole=True))
    description = tmp_path / "network.yaml"
    lines = f"file: whole.tflite\ndecoder: yolo\ninput: [64, 48]\njoints: [{', '.join(NAMES)}]\n"
    description.write_text(lines)
    with pytest.raises(InputError, match="whole numbers: set deviation to 1"):
        UserNetwork.load(description, None)
    description.write_text(lines + "deviation: 1\n")
    (found,) = UserNetwork.load(description, None).find(image(SIZE, (200, 200, 200)))
    np.testing.assert_allclose(found.keypoints.xy, [(10, 20), (40, 30)], rtol=1e-4)


def test_an_output_of_another_shape_is_one_sentence(tmp_path: Path) -> None:
    network = load(tmp_path, "onnx", "yolo", {"out": YOLO[None]}, joints="coco")
    with pytest.raises(InputError, match=r"shape \(1, 1, 11\).*for 17 joints"):
        network.find(image())


def test_a_network_for_one_person_needs_somebody_who_finds_people(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sees one person at a time.*networks --install"):
        load(tmp_path, "onnx", "heatmap", {"out": spots([(8, 6)], [0.5])})


@pytest.mark.parametrize("name", ["weights.onnx", "weights.tflite", "weights.TFLITE", "weights.pt"])
def test_a_file_that_is_no_network_is_one_sentence(tmp_path: Path, name: str) -> None:
    (tmp_path / "network.yaml").write_text(f"file: {name}\ndecoder: yolo\ninput: [64, 48]\n")
    with pytest.raises(InputError, match=f"{name}, which .*network.yaml names, cannot be read: No such file"):
        UserNetwork.load(tmp_path / "network.yaml", None)
    for data in (b"", b"words", write_onnx(SIZE, {"out": YOLO[None]})[:90]):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=f"{name}, which .* cannot be used: ") as error:
            UserNetwork.load(tmp_path / "network.yaml", None)
        assert "\n" not in str(error.value)


def test_the_shortest_description_has_the_usual_values(tmp_path: Path) -> None:
    (tmp_path / "network.yaml").write_text("file: sub/net.onnx\ndecoder: yolo\ninput: [640, 480]\n")
    told = NetworkDescription.read(tmp_path / "network.yaml")
    assert told.file == tmp_path / "sub" / "net.onnx" and told.size == (640, 480) and told.joints == COCO_17
    assert not told.reversed_colours and told.mean.tolist() == [0] * 3 and told.deviation.tolist() == [255] * 3


GOOD = {"file": "net.onnx", "decoder": "yolo", "input": "[64, 48]"}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"decoder": "yolov9"}, "no decoder 'yolov9'; known are yolo, movenet, simcc, heatmap"),
        ({"decoder": "[yolo]"}, "no decoder"),
        ({"colours": "rgba"}, "colours are 'rgba'"),
        ({"colours": "[rgb]"}, "colours are"),
        ({"input": "640"}, "input is two whole numbers"),
        ({"input": "[640]"}, "input is two whole numbers"),
        ({"input": "[64.5, 48]"}, "input is two whole numbers"),
        ({"input": '"64"'}, "input is two whole numbers"),
        ({"input": "[.inf, 48]"}, "input is two whole numbers"),
        ({"input": "[0, 48]"}, "input 0 x 48 cannot be"),
        ({"input": "[64, 100000]"}, "input 64 x 100000 cannot be"),
        ({"mean": "[1, 2]"}, "one number or three"),
        ({"mean": "much"}, "one number or three"),
        ({"deviation": "0"}, "deviation is not 0"),
        ({"deviation": "[1, 0, 1]"}, "deviation is not 0"),
        ({"deviation": ".nan"}, "finite"),
        ({"min_score": ".nan"}, "finite"),
        ({"min_score": "some"}, "min_score is one"),
        ({"joints": "halpe"}, "joints are `coco` or a list of names"),
        ({"joints": "[]"}, "joints are `coco` or a list of names"),
        ({"joints": "[1, 2]"}, "joints are `coco` or a list of names"),
        ({"colors": "rgb"}, "has 'colors'; known are file, decoder, input"),
        ({"file": None}, "needs at least file, decoder and input"),
        ({"mean": "2026-77-88"}, "not a YAML file|one number or three"),
        ({"mean": "[1, 2"}, "is not a YAML file"),
        ({"mean": "!!python/name:os.system x"}, "is not a YAML file"),
    ],
)
def test_each_mistake_in_a_description_is_one_sentence(
    tmp_path: Path, changes: dict[str, str | None], sentence: str
) -> None:
    path = tmp_path / "network.yaml"
    lines = {key: value for key, value in (GOOD | changes).items() if value is not None}
    path.write_text("".join(f"{key}: {value}\n" for key, value in lines.items()))
    with pytest.raises(InputError, match=sentence) as error:
        NetworkDescription.read(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("data", [b"", b"- a\n- b\n", b"words", b"\xff\xfe\x00", b"a: 1\na: 2\n"])
def test_another_file_in_its_place_is_one_sentence(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "network.yaml"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"is not a YAML file|needs at least") as error:
        NetworkDescription.read(path)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        NetworkDescription.read(tmp_path)
