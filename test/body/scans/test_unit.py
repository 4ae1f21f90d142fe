# SPDX-License-Identifier: Apache-2.0
"""Which units a scan may be in, by the size of people."""

import numpy as np
import pytest

from flowing_puppet_ros.body.scans.scan import Scan
from flowing_puppet_ros.body.scans.unit import (
    UNITS,
    is_closed,
    is_normalised,
    propose_named_unit,
    propose_sensor_units,
    propose_units,
)

CLOUD = np.random.default_rng(0).uniform(0, 1, (500, 3)) * [0.5, 0.3, 1.75]
CENTRE = CLOUD.mean(axis=0)
BOX = np.array([[x, y, z] for x in (0, 0.5) for y in (0, 0.3) for z in (0, 1.3)], dtype=float)
BOX_AREA_M2 = 2 * (0.5 * 0.3 + 0.5 * 1.3 + 0.3 * 1.3)
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


@pytest.mark.parametrize(("name", "metres"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_an_adult_stands_in_one_unit_only(name: str, metres: float) -> None:
    assert [unit.name for unit in propose_units(Scan(CLOUD / metres))][:1] == [name]
    (closed,) = propose_units(Scan(BOX / metres, BOX_FACES))
    assert (closed.name, closed.metres, closed.fitted) == (name, metres, metres)
    assert UNITS[name] == metres


def test_a_closed_surface_of_another_size_is_scaled_to_an_adult() -> None:
    assert is_closed(Scan(BOX, BOX_FACES)) and not is_closed(Scan(BOX, BOX_FACES[1:]))
    (unit,) = propose_units(Scan(BOX * 7, BOX_FACES))
    assert unit.name == "guess"
    assert BOX_AREA_M2 * 7**2 * unit.metres**2 == pytest.approx(1.8)


@pytest.mark.parametrize("height", [0.02, 0.25, 1.0, 10.0, 20.0, 1e20])
def test_scaled_clouds_get_the_size_of_adults(height: float) -> None:
    units = propose_units(Scan(CLOUD * height / 1.75))
    standing = next(unit for unit in units if unit.name == "guess")
    assert standing.fitted * height == pytest.approx(1.7, rel=0.01)


def test_small_people_may_also_be_in_a_named_unit() -> None:
    assert [unit.name for unit in propose_units(Scan(CLOUD * 0.6))] == ["m", "guess"]
    # 1.05 m in cm, or 2.67 m in inches: only the former may be somebody.
    assert [unit.name for unit in propose_units(Scan(CLOUD * 60))] == ["cm", "guess"]
    # 74 cm, or 1.87 m in inches.
    assert [unit.name for unit in propose_units(Scan(CLOUD * 42))] == ["in", "cm"]


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (CLOUD / np.ptp(CLOUD[:, 2]), True),
        (2 * (CLOUD - CENTRE) / np.ptp(CLOUD[:, 2]), True),
        ((CLOUD - CENTRE) / np.linalg.norm(CLOUD - CENTRE, axis=1).max(), True),
        (CLOUD, False),
        (CLOUD * 0.6, False),
    ],
)
def test_normalised_scans_are_recognised(points: np.ndarray, expected: bool) -> None:
    assert is_normalised(points) is expected
    assert (propose_units(Scan(points))[0].name == "guess") is expected


def test_a_named_unit_stays_and_small_people_in_it_may_be_children() -> None:
    assert [(unit.metres, unit.fitted) for unit in propose_named_unit(CLOUD, "m")] == [(1.0, 1.0)]
    adult, child = propose_named_unit(CLOUD * 60, "cm")
    assert (adult.metres, adult.fitted) == (0.01, 0.01)
    assert (child.name, child.metres) == ("cm", 0.01)
    assert child.fitted * np.ptp(CLOUD[:, 2]) * 60 == pytest.approx(1.7, rel=0.01)


def test_sensors_measure_in_metres_or_millimetres() -> None:
    assert [unit.name for unit in propose_sensor_units(CLOUD * 0.5)] == ["m"]
    assert [unit.name for unit in propose_sensor_units(CLOUD * 1000)] == ["mm"]
    assert propose_sensor_units(CLOUD * 10) == []
