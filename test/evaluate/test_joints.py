# SPDX-License-Identifier: Apache-2.0
"""Joint errors against hand-made cases."""

import math

import numpy as np
import pytest

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.evaluate.joints import (
    ARM_JOINTS,
    LEG_JOINTS,
    LIMB_JOINTS,
    JointErrors,
    count_id_switches,
    count_swapped,
    is_swapped,
    measure_joint_errors,
    name_points,
)

RNG = np.random.default_rng(3)


def body(dimensions: int = 3) -> dict[str, np.ndarray]:
    """Return joints with the left at y > 0 and the right at y < 0, as in the model frame."""
    points = {}
    for k, joint in enumerate(ARM_JOINTS + LEG_JOINTS):
        for side, sign in (("left", 1), ("right", -1)):
            points[f"{side}_{joint}"] = np.array([0.1 * k, sign * 0.2, 1.0 - 0.2 * k])[:dimensions]
    return points


def test_distances_against_a_known_shift() -> None:
    reference = {10: body(), 20: body()}
    frames = {stamp: {name: point + np.array([0, 0.03, 0.04]) for name, point in body().items()} for stamp in (10, 20)}
    errors = measure_joint_errors(frames, reference)
    assert errors.names == LIMB_JOINTS and errors.distance.shape == (2, 12)
    assert errors.mean == pytest.approx(0.05) and errors.percentile(50) == pytest.approx(0.05)
    assert errors.fraction_within(0.051) == 1.0 and errors.fraction_within(0.049) == 0.0


def test_unknown_joints_and_stamps_do_not_count() -> None:
    frames = {1: body(2), 2: body(2), 3: body(2)}
    del frames[1]["left_wrist"]
    reference = {1: body(2), 3: body(2) | {"right_knee": np.array([np.nan, 0.0])}}
    errors = measure_joint_errors(frames, reference)
    assert np.isnan(errors.distance[0, LIMB_JOINTS.index("left_wrist")])
    assert np.isnan(errors.distance[1]).all() and np.isnan(errors.per_frame()[1])
    assert np.isnan(errors.distance[2, LIMB_JOINTS.index("right_knee")])
    assert errors.known.size == 22 and errors.summarise()["frames"] == 2


def test_summary_matches_numpy() -> None:
    distance = RNG.uniform(0, 10, (7, 3))
    distance[2, 1] = np.nan
    errors = JointErrors(("a", "b", "c"), distance)
    figures = errors.summarise((5.0,))
    assert figures["mean"] == pytest.approx(np.nanmean(distance))
    assert figures["median"] == pytest.approx(np.nanmedian(distance))
    assert figures["max"] == np.nanmax(distance)
    assert figures["within 5"] == pytest.approx((distance[np.isfinite(distance)] <= 5).mean())
    assert errors.per_joint()["b"].mean == pytest.approx(np.nanmean(distance[:, 1]))
    assert errors.per_frame() == pytest.approx(np.nanmean(distance, axis=1))


def test_nothing_known_is_nan_without_warnings() -> None:
    errors = JointErrors(("a",), np.full((2, 1), np.nan))
    assert all(math.isnan(errors.summarise((1.0,))[key]) for key in ("mean", "median", "max", "within 1"))
    assert np.isnan(errors.per_frame()).all()


def test_named_points_reads_detector_names() -> None:
    points = np.array([[1, 2], [3, 4], [5, 6], [np.nan, 7]])
    found = name_points(["LWrist", "right_wrist", "Something", "Neck"], points)
    assert set(found) == {"left_wrist", "right_wrist"} and found["left_wrist"].tolist() == [1, 2]
    with pytest.raises(InputError, match="2 joint names need as many points"):
        name_points(["LWrist", "RWrist"], np.zeros((3, 2)))


def test_swapped_limbs_are_found_one_pair_at_a_time() -> None:
    reference = body()
    noisy = {name: point + RNG.normal(0, 0.03, 3) for name, point in reference.items()}
    assert is_swapped(noisy, reference, ARM_JOINTS) is False and is_swapped(noisy, reference, LEG_JOINTS) is False
    crossed = dict(noisy)
    for joint in ARM_JOINTS:
        left, right = f"left_{joint}", f"right_{joint}"
        crossed[left], crossed[right] = noisy[right], noisy[left]
    assert is_swapped(crossed, reference, ARM_JOINTS) is True and is_swapped(crossed, reference, LEG_JOINTS) is False
    assert is_swapped({"left_wrist": np.zeros(3)}, reference, ARM_JOINTS) is None
    assert count_swapped({1: crossed, 2: noisy, 3: noisy}, {1: reference, 2: reference}, ARM_JOINTS) == (1, 2)


@pytest.mark.parametrize(
    ("ids", "expected"),
    [
        ([["a1"], ["a1"], [], ["a1"]], 0),
        ([["a1"], ["a2"], ["a2"]], 1),
        ([["a1"], [], ["a2"], ["a1"]], 2),
        ([["a1"], ["a1", "a2"], ["a2"]], 0),
        ([["a1", "a2"], ["a3", "a4"]], 2),
        ([], 0),
    ],
)
def test_id_switches(ids: list[list[str]], expected: int) -> None:
    assert count_id_switches(ids) == expected
