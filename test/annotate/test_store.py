# SPDX-License-Identifier: Apache-2.0
"""The annotations: what is written is there after a kill, and nobody overwrites anybody unawares."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowing_puppet_ros.annotate.store import FILE_NAME, AnnotationStore, ConflictError, check_people
from flowing_puppet_ros.errors import InputError, PuppetError
from flowing_puppet_ros.image.formats.stickmen import read_sticks
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES

NAMES = JOINT_NAMES[10]


def person(shift: float = 0.0, **changes: Any) -> dict[str, Any]:
    joints = [[10.0 * k + shift, 5.0 * k, 1] for k in range(len(NAMES))]
    return {"joints": joints, "gender": "neutral", "view": "front"} | changes


def test_what_was_put_is_on_the_disk_at_once(tmp_path: Path) -> None:
    store = AnnotationStore(tmp_path, NAMES)
    assert store.put("a.png", 0, [person()]) == 1
    data = json.loads((tmp_path / FILE_NAME).read_text())
    assert data == {"joint_names": list(NAMES), "images": {"a.png": [person()]}}
    store.close()
    again = AnnotationStore(tmp_path, NAMES)
    assert again.get("a.png") == (1, [person()])
    assert again.count_people() == {"a.png": 1}


def test_the_later_of_two_writers_is_told(tmp_path: Path) -> None:
    store = AnnotationStore(tmp_path, NAMES)
    store.put("a.png", 0, [person(1)])
    with pytest.raises(ConflictError):
        store.put("a.png", 0, [person(2)])
    assert store.get("a.png") == (1, [person(1)])


def test_a_second_program_is_refused_and_may_follow(tmp_path: Path) -> None:
    store = AnnotationStore(tmp_path, NAMES)
    with pytest.raises(InputError, match="another run"):
        AnnotationStore(tmp_path, NAMES)
    store.close()
    AnnotationStore(tmp_path, NAMES).close()


def test_a_full_disk_leaves_the_annotation_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = AnnotationStore(tmp_path, NAMES)
    store.put("a.png", 0, [person()])

    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for key, revision in (("a.png", 1), ("b.png", 0)):
        with pytest.raises(PuppetError, match="No space left"):
            store.put(key, revision, [person(3)])
    assert store.get("a.png") == (1, [person()])
    assert store.get("b.png") == (0, [])
    assert json.loads((tmp_path / FILE_NAME).read_text())["images"] == {"a.png": [person()]}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"joint_names": []}', '{"joint_names": ["a"], "images": {}}'])
def test_a_file_that_is_none_of_ours_is_kept_and_told(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    with pytest.raises(InputError):
        AnnotationStore(tmp_path, NAMES)
    assert (tmp_path / FILE_NAME).read_text() == text


BAD_PEOPLE: list[object] = [
    None,
    {},
    [1],
    [person()] * 51,
    [person(gender="other")],
    [person(view=["front"])],
    [person(joints=[])],
    [person(joints=[[0, 0, 1]] * 14)],
    [person(joints=[[0, float("nan"), 1]] * 15)],
    [person(joints=[[0, 1e9, 1]] * 15)],
    [person(joints=[[0, 0, 2]] * 15)],
    [person(joints=[[0, True, 1]] * 15)],
    [person(joints=[["0", 0, 1]] * 15)],
]


@pytest.mark.parametrize("people", BAD_PEOPLE, ids=range(len(BAD_PEOPLE)))
def test_people_that_cannot_be_are_refused(people: object) -> None:
    with pytest.raises(InputError):
        check_people(people, 15)


@pytest.mark.slow
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=3) | st.sampled_from(["front", "male", "joints"]),
        lambda inner: st.lists(inner, max_size=15) | st.dictionaries(st.sampled_from(["joints", "view"]), inner),
    )
)
def test_any_json_is_people_or_one_sentence(value: object) -> None:
    try:
        people = check_people(value, 15)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert people == value


def test_nothing_but_what_belongs_there_is_kept() -> None:
    assert check_people([person(extra="<script>")], 15) == [person()]


def test_stick_figures_carry_the_numbers_of_the_names(tmp_path: Path) -> None:
    store = AnnotationStore(tmp_path, NAMES)
    store.put("img0020.png", 0, [person(), person(7)])
    out = tmp_path / "sticks.txt"
    store.write_sticks(out, ["img0007.png", "img0020.png"])
    assert {number: len(people) for number, people in read_sticks(out).items()} == {20: 2}
    joints = np.array(person()["joints"])[:, :2]
    left_upper_arm = read_sticks(out)[20][0][1]
    np.testing.assert_allclose(left_upper_arm, joints[[NAMES.index("left_shoulder"), NAMES.index("left_elbow")]])
    store.write_sticks(out, ["b/img0020.png", "img0020.png"])
    assert list(read_sticks(out)) == [1]
