# SPDX-License-Identifier: Apache-2.0
"""MoveNet and BlazePose together, with networks that see what a test says, and the real ones where nobody is."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flowing_puppet_ros.bag.frames import open_bag_frames
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.keypoints import Keypoints
from flowing_puppet_ros.image.formats.skeletons import COCO_17, MEDIAPIPE_33
from flowing_puppet_ros.image.networks.choice import are_installed, load_networks
from flowing_puppet_ros.image.networks.keypoint_networks import FoundPerson, KeypointNetworks, brighten
from flowing_puppet_ros.image.networks.pose_networks import Landmarks
from flowing_puppet_ros.image.networks.poses import NetworkPose
from flowing_puppet_ros.image.person_mask import PersonMask
from test.helpers.painted_people import ground

installed = pytest.mark.skipif(not are_installed(), reason="no keypoint networks: `flowing-puppet networks --install`")
GOLDEN = Path(__file__).parents[3] / "bags" / "golden" / "golden.mcap"
SIZE = (640, 480)
MASK = PersonMask.of_grid(np.full((48, 64), 255, np.uint8), SIZE)
WIDTH = 60.0  # shoulders px
HEIGHTS = {"nose": -0.7, "eye": -0.8, "ear": -0.75, "shoulder": 0, "elbow": 0.8, "wrist": 1.5, "hip": 1.4, "knee": 2.6,
           "ankle": 3.7, "index": 1.8, "heel": 3.9, "foot_index": 4.0, "foot": 4.0}  # fmt: skip
SPREAD = {"nose": 0, "eye": 0.1, "ear": 0.2, "elbow": 0.7, "wrist": 0.75, "index": 0.8, "shoulder": 0.5}


def place_joints(names: Sequence[str], neck: float, width: float = WIDTH) -> np.ndarray:
    """Return where somebody upright whose neck is at x = `neck` has the joints; NaN for names nobody here has."""
    places = []
    for name in names:
        side, _, part = name.partition("_") if name.startswith(("left", "right")) else ("", "", name)
        sign = {"left": 1.0, "right": -1.0, "": 0.0}[side]
        places.append((sign * SPREAD.get(part, 0.3), HEIGHTS.get(part, np.nan)))
    return np.array(places) * width + (neck, 120.0)


def pose(neck: float, score: float = 0.8, joint_score: float = 0.8, width: float = WIDTH) -> NetworkPose:
    return NetworkPose(place_joints(COCO_17, neck, width), np.full(17, joint_score), score)


def known(neck: float) -> Keypoints:
    return Keypoints(COCO_17, place_joints(COCO_17, neck), np.full(17, 0.5))


def picture(level: int = 120) -> np.ndarray:
    """Return an image whose left side can be told from its right one."""
    image = np.full((SIZE[1], SIZE[0], 3), level, np.uint8)
    image[:, -1] = level + 1
    return image


@dataclass
class Seeing:
    """Both networks: MoveNet sees `everybody` in the whole image and those of `near` whose hips are in a square."""

    everybody: list[NetworkPose]
    near: list[NetworkPose]
    exchanged: bool = False
    presence: float = 0.9
    visibility: float = 1.0
    shifts: dict[str, float] = field(default_factory=dict)
    looks: list[str] = field(default_factory=list)
    light: float = 0.0

    def detect(self, image: np.ndarray, side: int) -> list[NetworkPose]:
        self.looks.append("all")
        self.light = float(image.mean())
        return self.everybody

    def detect_in_square(self, image: np.ndarray, center: Any, half: float, side: int) -> list[NetworkPose]:
        assert half > 0 and side == 192
        self.looks.append("square")
        mirrored = image[0, 0, 0] > image[0, -1, 0]
        people = [one.mirror(image.shape[1]) for one in self.near] if mirrored else self.near
        return [one for one in people if np.abs(one.joints[[11, 12]].mean(axis=0) - center).max() < half]

    def locate(self, image: np.ndarray, person: NetworkPose) -> Landmarks:
        """Return the landmarks of whom the pose is; those named in `shifts` are moved right."""
        self.looks.append("landmarks")
        mirrored = image[0, 0, 0] > image[0, -1, 0]
        neck = person.joints[[5, 6], 0].mean()
        points = np.nan_to_num(place_joints(MEDIAPIPE_33, neck))
        for name, shift in self.shifts.items():
            points[MEDIAPIPE_33.index(name), 0] += -shift if mirrored else shift
        if self.exchanged:
            points = points[[MEDIAPIPE_33.index(_other(name)) for name in MEDIAPIPE_33]]
        return Landmarks(points, np.full(33, self.visibility), self.presence, MASK)


def _other(name: str) -> str:
    for one, other in (("left", "right"), ("right", "left")):
        if name.startswith(one) or name.endswith(one):
            return name.replace(one, other)
    return name


def find(seeing: Seeing, *given: Any, thorough: bool = False, **asked: Any) -> list[FoundPerson]:
    networks = KeypointNetworks(seeing, seeing, thorough=thorough)  # type: ignore[arg-type]
    return networks.find(picture(), *given, **asked)


def necks(people: Sequence[FoundPerson]) -> list[int]:
    rows = [COCO_17.index(name) for name in ("left_shoulder", "right_shoulder")]
    return [round(float(person.keypoints.xy[rows, 0].mean())) for person in people]


def at(person: FoundPerson, name: str) -> tuple[np.ndarray, float]:
    row = person.keypoints.names.index(name)
    return person.keypoints.xy[row], float(person.keypoints.confidence[row])


def test_everybody_is_found_most_certain_first_with_hands_and_feet() -> None:
    found = find(Seeing([pose(100, 0.5), pose(300, 0.7)], []))
    assert necks(found) == [300, 100] and [one.score for one in found] == [0.7, 0.5]
    names = found[0].keypoints.names
    assert names[:17] == COCO_17 and set(names[17:]) == {
        f"{side}_{part}" for side in ("left", "right") for part in ("hand", "heel", "foot")
    }
    expected = place_joints([name.replace("hand", "index") for name in names], 300)
    np.testing.assert_allclose(found[0].keypoints.xy, expected, atol=1e-6)
    np.testing.assert_allclose(found[0].keypoints.confidence, 1.0)


def test_a_doubtful_person_of_the_whole_image_needs_a_second_look() -> None:
    doubtful = [pose(100, 0.15), pose(300, 0.15), pose(500, 0.09)]
    seeing = Seeing(doubtful, [pose(302, 0.6), pose(500, 0.9)])
    found = find(seeing)
    assert necks(found) == [301] and found[0].score == 0.6 and seeing.looks.count("square") == 2
    assert find(Seeing(doubtful, [pose(300, 0.19)])) == []
    assert find(Seeing(doubtful, [pose(300 + 0.7 * WIDTH, 0.9)])) == [], "somebody else is there"


def test_a_small_person_is_looked_at_again_and_a_large_one_only_when_thorough() -> None:
    """In the image reduced to 256 px a trunk of 1.4 shoulder widths has 30 px for shoulders of 54 px."""
    seeing = Seeing([pose(300, 0.7, width=WIDTH)], [])
    find(seeing)
    assert seeing.looks == ["all", "landmarks"]
    seeing = Seeing([pose(300, 0.7, width=50.0)], [])
    assert necks(find(seeing)) == [300] and seeing.looks == ["all", "square", "landmarks"]


def test_known_people_are_looked_at_where_expected_and_nobody_else() -> None:
    seeing = Seeing([pose(500)], [pose(110), pose(300)])
    found = find(seeing, [known(100), known(300)], everybody=False)
    assert sorted(necks(found)) == [110, 300] and "all" not in seeing.looks
    assert seeing.looks.count("square") == 2
    assert necks(find(seeing, [known(300)])) == [300, 500], "known ones first, however certain the others"


def test_known_people_who_are_gone_are_not_found() -> None:
    gone = [known(100)]
    assert find(Seeing([], []), gone) == []
    assert find(Seeing([], [pose(100, 0.19)]), gone) == []
    assert find(Seeing([], [pose(100 + 1.6 * WIDTH)]), gone) == []
    assert necks(find(Seeing([], [pose(100 + 1.4 * WIDTH)]), gone)) == [184]
    without_hips = Keypoints(COCO_17[:9], place_joints(COCO_17[:9], 100), np.ones(9))
    assert find(Seeing([], [pose(100)]), [without_hips], everybody=False) == []


def test_a_known_person_who_is_seen_in_the_whole_image_too_is_one_person_by_the_closer_look() -> None:
    found = find(Seeing([pose(296, 0.9)], [pose(304, 0.8)], shifts={"left_wrist": 0.2 * WIDTH}), [known(300)])
    # The landmarks' wrist is a fifth of the shoulder width away from MoveNet's.
    assert necks(found) == [304] and found[0].score == 0.8
    assert at(found[0], "left_wrist")[1] == pytest.approx(0.7)


def test_a_known_person_whom_the_closer_look_misses_is_taken_from_the_whole_image() -> None:
    found = find(Seeing([pose(296, 0.9), pose(500, 0.7)], []), [known(300)])
    assert necks(found) == [296, 500]


def test_two_known_people_in_one_place_are_one_the_one_who_is_nearer_to_where_expected() -> None:
    turned = known(240)
    turned.xy[:] = pose(240).exchange_sides().joints
    found = find(Seeing([], [pose(300)], exchanged=True), [turned, known(305)], everybody=False)
    assert necks(found) == [300]
    assert at(found[0], "left_shoulder")[0][0] > 300, "sides are those of the person who is expected at 305"
    assert len(find(Seeing([], [pose(300), pose(340)]), [known(295), known(345)], everybody=False)) == 2


def test_no_more_people_than_asked_for() -> None:
    seeing = Seeing([pose(100, 0.5), pose(300, 0.7), pose(500, 0.6)], [pose(100, 0.5)])
    assert necks(find(seeing, max_people=2)) == [300, 500]
    assert necks(find(seeing, [known(100)], max_people=2)) == [100, 300]
    assert find(seeing, max_people=0) == []


def test_where_the_landmarks_have_left_and_right_exchanged_hands_and_feet_are_exchanged_too() -> None:
    """The known person decides: MoveNet is right."""
    (found,) = find(Seeing([], [pose(300)], exchanged=True), [known(300)], everybody=False)
    names = found.keypoints.names
    np.testing.assert_allclose(
        found.keypoints.xy, place_joints([name.replace("hand", "index") for name in names], 300), atol=1e-6
    )
    assert found.keypoints.confidence.min() == pytest.approx(1.0)


def test_landmarks_of_nobody_or_of_somebody_else_are_left_out() -> None:
    for seeing in (Seeing([pose(300, 0.7, 0.6)], [], presence=0.29), Seeing([pose(300, 0.7, 0.6)], [])):
        if seeing.presence > 0.3:
            seeing.shifts = dict.fromkeys(MEDIAPIPE_33, 1.1 * WIDTH)
        (found,) = find(seeing)
        assert found.keypoints.names == COCO_17
        np.testing.assert_allclose(found.keypoints.xy, place_joints(COCO_17, 300), atol=1e-6)
        np.testing.assert_allclose(found.keypoints.confidence, 0.6 / 0.65)


def test_landmarks_between_two_people_are_of_neither() -> None:
    """Of somebody alone landmarks 0.6 widths away still count; not of one of two who are 1.5 widths apart."""
    shifts = dict.fromkeys(MEDIAPIPE_33, 0.6 * WIDTH)
    (alone,) = find(Seeing([pose(300)], [], shifts=shifts))
    assert necks([alone])[0] > 310
    both = find(Seeing([pose(300, 0.9), pose(390, 0.7)], [], shifts=shifts))
    assert necks(both)[0] == 300
    np.testing.assert_allclose(both[0].keypoints.confidence, 1.0)


def test_where_the_networks_disagree_a_joint_is_unknown_and_its_hand_too() -> None:
    (found,) = find(Seeing([pose(300)], [], shifts={"left_wrist": 5 * WIDTH, "right_wrist": 0.2 * WIDTH}))
    place, confidence = at(found, "left_wrist")
    assert np.isnan(place).all() and confidence == 0.0 and np.isnan(at(found, "left_hand")[0]).all()
    place, confidence = at(found, "right_wrist")
    assert confidence == pytest.approx(0.7)
    right = place_joints(("right_wrist",), 300)[0]
    shares = 0.8 + 1.0  # scores of the two networks
    np.testing.assert_allclose(place, right + np.array([0.2 * WIDTH / shares, 0]), atol=1e-6)
    assert at(found, "right_hand")[1] == pytest.approx(0.7)


def test_a_hand_lies_beside_the_wrist_of_both_networks() -> None:
    """Landmarks that have a whole lower arm elsewhere take the hand along as far as they take the wrist."""
    shifts = {"left_wrist": 12.0, "left_index": 12.0}
    (found,) = find(Seeing([pose(300)], [], shifts=shifts))
    expected = place_joints(("left_wrist", "left_index"), 300) + np.array([12 / 1.8, 0])
    np.testing.assert_allclose([at(found, "left_wrist")[0], at(found, "left_hand")[0]], expected, atol=1e-6)


def test_elbows_of_the_landmarks_count_half() -> None:
    (found,) = find(Seeing([pose(300)], [], shifts={"left_elbow": 13.0}))
    place, _ = at(found, "left_elbow")
    np.testing.assert_allclose(place, place_joints(("left_elbow",), 300)[0] + (13 * 0.5 / 1.3, 0), atol=1e-6)


def test_the_thorough_look_adds_a_square_and_the_mirror_image_of_both_networks() -> None:
    seeing = Seeing([pose(300)], [pose(300)], shifts={"left_wrist": 12.0})
    (found,) = find(seeing, thorough=True)
    assert seeing.looks == ["all", "square", "landmarks", "square", "landmarks"]
    weights = 0.8 * 3, 1.0
    place, _ = at(found, "right_ankle")
    np.testing.assert_allclose(place, place_joints(("right_ankle",), 300)[0], atol=1e-6)
    # In the mirror image the person's left wrist is called the right one, which nothing shifts.
    place, _ = at(found, "left_wrist")
    np.testing.assert_allclose(
        place, place_joints(("left_wrist",), 300)[0] + (12 * weights[1] / (weights[0] + 2), 0), atol=1e-6
    )


def test_grey_images_are_taken_and_others_are_one_sentence() -> None:
    seeing = Seeing([pose(300)], [])
    networks = KeypointNetworks(seeing, seeing)  # type: ignore[arg-type]
    assert len(networks.find(picture()[..., 0])) == 1
    for wrong in (picture().astype(float), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 5, 3), np.uint8)):
        with pytest.raises(InputError, match="an image must be"):
            networks.find(wrong)


def test_only_a_nearly_black_image_is_brightened_and_keeps_its_order_of_light() -> None:
    bright = picture(60)
    assert brighten(bright) is bright
    dark = np.zeros((240, 320, 3), np.uint8)
    dark[60:180, 80:240] = np.linspace(2, 20, 160).astype(np.uint8)[None, :, None]
    lit = brighten(dark)
    row = lit[100, 80:240, 0].astype(int)
    assert lit.mean() > 40 > dark.mean() and (np.diff(row) >= 0).all() and row[-1] >= 250
    assert lit[0, 0, 0] == 0 and lit.dtype == np.uint8
    assert not brighten(np.zeros((3, 2000, 3), np.uint8)).any()
    seeing = Seeing([], [])
    KeypointNetworks(seeing, seeing).find(dark)  # type: ignore[arg-type]
    assert seeing.light == pytest.approx(lit.mean()), "the networks see the brightened image"


def furniture(seed: int) -> np.ndarray:
    """Return a room with shelves, a table and a window: upright and level edges, plain surfaces, soft light."""
    rng = np.random.default_rng(seed)
    image = np.full((480, 640, 3), rng.integers(120, 220, 3), np.uint8)
    image[330:] = rng.integers(60, 140, 3)
    for _ in range(10):
        x, y = (int(value) for value in rng.integers((0, 60), (560, 330)))
        w, h = (int(value) for value in rng.integers((30, 30), (160, 180)))
        colour = [int(value) for value in rng.integers(20, 240, 3)]
        cv2.rectangle(image, (x, y), (x + w, y + h), colour, -1)
        cv2.rectangle(image, (x, y), (x + w, y + h), [value // 2 for value in colour], 3)
    light = np.linspace(0.7, 1.1, 640)[None, :, None]
    noise = rng.normal(0, 4, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.2) * light + noise, 0, 255).astype(np.uint8)


@installed
@pytest.mark.parametrize("kind", ["black", "plain", "noise", "texture", "furniture"])
def test_the_real_networks_find_nobody_where_nobody_is(kind: str) -> None:
    networks = load_networks("neural")
    assert networks is not None
    for seed in range(3):
        rng = np.random.default_rng(seed)
        images = {
            "black": np.zeros((240, 320, 3), np.uint8),
            "plain": np.full((240, 320, 3), rng.integers(0, 256, 3), np.uint8),
            "noise": rng.integers(0, 256, (240, 320, 3)).astype(np.uint8),
            "texture": ground(rng, (320, 240)),
            "furniture": furniture(seed),
        }
        assert networks.find(images[kind]) == []


@installed
@pytest.mark.parametrize("size", [(1, 1), (2000, 3), (3, 2000), (31, 33)])
def test_the_real_networks_take_images_of_any_shape(size: tuple[int, int]) -> None:
    networks = load_networks("neural")
    assert networks is not None
    image = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    assert networks.find(image) == [] == networks.find(image[..., 0])
    inside = Keypoints(COCO_17, place_joints(COCO_17, 10.0, 5.0), np.ones(17))
    assert networks.find(image, [inside], everybody=False) == []


@installed
def test_the_real_networks_find_a_person_of_a_recording_where_they_are_in_the_mirror_too() -> None:
    """The truth is the body's in the recording, projected into the image with little noise."""
    frame, people = next(iter(open_bag_frames(GOLDEN, "", False, pytest.fail)))
    assert people is not None
    (truth,) = people
    networks = load_networks("neural")
    assert networks is not None
    (found,) = networks.find(frame.image)
    (mirrored,) = networks.find(np.ascontiguousarray(frame.image[:, ::-1]))
    width = frame.image.shape[1]
    true = dict(zip(truth.names, truth.xy, strict=True))
    shoulders = float(np.hypot(*(true["left_shoulder"] - true["right_shoulder"])))
    for part in ("shoulder", "hip", "elbow", "wrist", "knee", "ankle"):
        for side in ("left", "right"):
            place = true[f"{side}_{part}"]
            assert np.hypot(*(at(found, f"{side}_{part}")[0] - place)) < 0.5 * shoulders
            there, _ = at(mirrored, f"{'right' if side == 'left' else 'left'}_{part}")
            assert np.hypot(*((width - 1 - there[0], there[1]) - place)) < 0.5 * shoulders


def test_a_mask_is_the_persons_only_if_the_landmarks_are() -> None:
    (person,) = find(Seeing([pose(320)], [pose(320)]))
    assert person.keypoints.mask is MASK
    elsewhere = Seeing([pose(320)], [pose(320)], presence=0.1)
    (person,) = find(elsewhere)
    assert person.keypoints.mask is None
