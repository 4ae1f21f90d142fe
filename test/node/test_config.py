# SPDX-License-Identifier: Apache-2.0
"""The parameter files are what the settings say, and read back as the same values with the same types."""

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings, parameter_yaml, published

CONFIG = Path(__file__).resolve().parents[2] / "config"


def test_every_node_has_a_file() -> None:
    assert {path.stem for path in CONFIG.glob("*.yaml")} == set(COMPONENTS)


@pytest.mark.parametrize("name", COMPONENTS)
def test_file_is_generated_from_the_settings(name: str) -> None:
    assert (CONFIG / f"{name}.yaml").read_text() == parameter_yaml(name), "run `make config`"


@pytest.mark.parametrize("name", COMPONENTS)
def test_values_survive_the_file(name: str) -> None:
    read = YAML(typ="safe").load(parameter_yaml(name))[f"/**/{name}"]["ros__parameters"]
    flat = {key: value for key, value in read.items() if not isinstance(value, dict)}
    flat |= {
        f"{key}.{leaf}": value for key, part in read.items() if isinstance(part, dict) for leaf, value in part.items()
    }
    infos = [*COMPONENTS[name].settings_type.describe(), *node_settings(name).describe()]
    assert {key: (type(value), value) for key, value in flat.items()} == {
        info.name: (info.type, info.default) for info in infos if not info.advanced
    }


@pytest.mark.parametrize("name", COMPONENTS)
def test_a_stranger_is_offered_few_parameters(name: str) -> None:
    assert len(published(name)) <= 24
