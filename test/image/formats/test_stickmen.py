# SPDX-License-Identifier: Apache-2.0
"""Stick figures: what they are of a puppet, and their text files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.image.formats.stickmen import STICKS, read_sticks, sticks_from_joints, write_sticks
from flowing_puppet_ros.model.ds.puppet import DeformableStructures


def test_sticks_of_the_mean_puppet_stand_where_its_limbs_do() -> None:
    model = DeformableStructures.load()
    joints = model.mean_joints()
    sticks = dict(zip(STICKS, sticks_from_joints(model.joint_names, joints), strict=True))
    for side in ("left", "right"):
        shoulder, elbow, wrist = (
            joints[model.joint_names.index(f"{side}_{j}")] for j in ("shoulder", "elbow", "wrist")
        )
        np.testing.assert_array_equal(sticks[f"{side}_upper_arm"], [shoulder, elbow])
        np.testing.assert_array_equal(sticks[f"{side}_lower_arm"], [elbow, wrist])
    head, torso = sticks["head"], sticks["torso"]
    # y points down: the head ends above the neck, the torso runs down from the shoulders.
    assert head[1, 1] < head[0, 1] < torso[0, 1] < torso[1, 1]
    assert 0.15 < np.linalg.norm(head[1] - head[0]) < 0.35


def test_unknown_joints_leave_their_sticks_unknown() -> None:
    model = DeformableStructures.load()
    joints = model.mean_joints()
    joints[model.joint_names.index("left_wrist")] = np.nan
    known = np.isfinite(sticks_from_joints(model.joint_names, joints)).all(axis=(1, 2))
    assert [name for name, fine in zip(STICKS, known, strict=True) if not fine] == ["left_lower_arm"]


@pytest.mark.slow
@given(st.dictionaries(st.integers(0, 10**6), st.lists(arrays(np.int64, (6, 2, 2), elements=st.integers(-999, 9999)),
                                                        min_size=1, max_size=3), min_size=1, max_size=4))  # fmt: skip
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, frames: dict[int, list[np.ndarray]]) -> None:
    path = tmp_path_factory.mktemp("sticks") / "s.txt"
    write_sticks(path, frames)
    again = read_sticks(path)
    assert again.keys() == frames.keys()
    for number, people in frames.items():
        np.testing.assert_array_equal(again[number], people)


def test_lines_may_break_after_every_stick(tmp_path: Path) -> None:
    path = tmp_path / "s.txt"
    path.write_text("  7\n" + "".join(f"{k} 2.5 3 4\n" for k in range(6)))
    (person,) = read_sticks(path)[7]
    np.testing.assert_array_equal(person[3], [[3, 2.5], [3, 4]])


@pytest.mark.parametrize("text", ["", "1 2 3", "x " * 25, "-1 " + "0 " * 24, "1.5 " + "0 " * 24])
def test_other_files_are_one_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "s.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"s\.txt") as caught:
        read_sticks(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_sticks(tmp_path / "none.txt")
