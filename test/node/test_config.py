# SPDX-License-Identifier: Apache-2.0
"""The parameter files are what the settings say, and read back as the same values with the same types."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings, parameter_yaml, published

CONFIG = Path(__file__).resolve().parents[2] / "config"


def test_every_node_has_a_file() -> None:
    assert {path.stem for path in CONFIG.glob("*.yaml")} == set(COMPONENTS)


@pytest.mark.parametrize("name", COMPONENTS)
def test_file_is_generated_from_the_settings(name: str) -> None:
    assert (CONFIG / f"{name}.yaml").read_text() == parameter_yaml(name), "run `make config`"


def flatten(part: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings under their dotted names."""
    for key, value in part.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


@pytest.mark.parametrize("name", COMPONENTS)
def test_values_survive_the_file(name: str) -> None:
    read = YAML(typ="safe").load(parameter_yaml(name))["/**"]["ros__parameters"]
    flat = dict(flatten(read))
    infos = [*COMPONENTS[name].settings_type.describe(), *node_settings(name).describe()]
    assert {key: (type(value), value) for key, value in flat.items()} == {
        info.name: (info.type, info.default) for info in infos if not info.advanced
    }


@pytest.mark.parametrize("name", COMPONENTS)
def test_a_stranger_is_offered_few_parameters(name: str) -> None:
    assert len(published(name)) <= 24
