# SPDX-License-Identifier: Apache-2.0
"""Write config/*.yaml from the settings of the nodes (`make config`)."""

from pathlib import Path

from flowing_puppet_ros.stream.components.registry import COMPONENTS, parameter_yaml

if __name__ == "__main__":
    for name in COMPONENTS:
        path = Path(__file__).resolve().parent.parent / "config" / f"{name}.yaml"
        path.write_text(parameter_yaml(name))
