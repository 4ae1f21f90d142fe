# SPDX-License-Identifier: Apache-2.0
"""Settings as ROS parameters: descriptors, overrides, refusals in one sentence."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.node.parameters import apply_changes, convert_to_floats, declare
from flowing_puppet_ros.settings import Settings, nested, setting

pytestmark = pytest.mark.ros


@dataclass(frozen=True)
class Sample(Settings):
    """One setting of each kind."""

    count: int = setting(3, "how many", low=1, high=9)
    ratio: float = setting(0.5, "share", low=0.0)
    mode: str = setting("a", "way", choices=("a", "b"))
    loud: bool = setting(False, "speak")


@dataclass(frozen=True)
class Part(Settings):
    """A setting that is offered, and one that is not."""

    gate: float = setting(3.0, "how far", low=1.0)
    patience: int = setting(2, "how often", low=1, advanced=True)


@dataclass(frozen=True)
class Whole(Settings):
    """Settings with a part."""

    part: Part = nested(Part, gate=4.0)


@pytest.fixture(autouse=True)
def ros() -> Iterator[None]:
    """Run each test in its own context."""
    rclpy.init()
    yield
    rclpy.try_shutdown()


def node(**overrides: object) -> Node:
    """Return a node started with these parameters."""
    given = [Parameter(name, value=value) for name, value in overrides.items()]
    return Node("sample", parameter_overrides=given)


def test_defaults_and_overrides() -> None:
    assert declare(node(), Sample) == Sample()
    assert declare(node(count=7, loud=True), Sample) == Sample(count=7, loud=True)


def test_descriptors_show_help_range_and_choices() -> None:
    made = node()
    declare(made, Sample, fixed={"mode"})
    count, ratio, mode = (made.describe_parameter(name) for name in ("count", "ratio", "mode"))
    assert count.description == "how many (1 to 9)"
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 9)
    assert ratio.floating_point_range[0].from_value == 0.0
    assert mode.additional_constraints == "one of a, b"
    assert (count.read_only, mode.read_only) == (False, True)


@pytest.mark.parametrize(("name", "value"), [("count", 0), ("count", 1.5), ("ratio", -0.1), ("mode", "c")])
def test_bad_values_are_one_sentence_with_the_name(name: str, value: object) -> None:
    with pytest.raises(InputError, match=name) as refused:
        declare(node(**{name: value}), Sample)
    assert str(value) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_change_is_checked_as_a_whole_and_changes_nothing_itself() -> None:
    before = Sample()
    after = apply_changes(before, [Parameter("count", value=7), Parameter("use_sim_time", value=True)])
    assert (before, after) == (Sample(), Sample(count=7))
    with pytest.raises(InputError, match="mode is 'c', which is not one of a, b"):
        apply_changes(before, [Parameter("count", value=8), Parameter("mode", value="c")])


def test_whole_numbers_are_taken_for_floating_point_settings() -> None:
    given = [Parameter("ratio", value=2), Parameter("count", value=2), Parameter("mode", value="b")]
    taken = {parameter.name: parameter.value for parameter in convert_to_floats([Sample], given)}
    assert {name: (type(value), value) for name, value in taken.items()} == {
        "ratio": (float, 2.0), "count": (int, 2), "mode": (str, "b"),
    }  # fmt: skip


def test_parts_have_dotted_names_and_advanced_settings_are_declared_only_when_given() -> None:
    plain, expert = node(), node(**{"part.patience": 5, "part.gate": 2.0})
    assert declare(plain, Whole) == Whole()
    assert plain.has_parameter("part.gate") and not plain.has_parameter("part.patience")
    assert declare(expert, Whole) == Whole(Part(2.0, 5))
    assert apply_changes(Whole(), [Parameter("part.gate", value=9.0)]) == Whole(Part(9.0, 2))
    with pytest.raises(InputError, match=r"parameter part\.patience"):
        declare(node(**{"part.patience": 0}), Whole)
