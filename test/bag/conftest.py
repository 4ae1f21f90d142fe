# SPDX-License-Identifier: Apache-2.0
"""The golden bag and a replay of it, made once."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.bag.replay.replay import ReplayOptions, replay

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden"
SETTINGS = {"visual_hull": {"hull_every": 4}}


@dataclass(frozen=True)
class Golden:
    """The golden recording, what is true in it, what a replay should say, and a replay with its options."""

    source: Path
    truth: dict[str, dict[str, list[float]]]
    expected: dict[str, Any]
    replay: Path
    options: ReplayOptions
    summary: dict[str, Any]


@pytest.fixture(scope="session")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Golden:
    path = tmp_path_factory.mktemp("golden") / "out.mcap"
    options = ReplayOptions(settings=SETTINGS, progress=False, jobs=3)
    summary = replay(GOLDEN / "golden.mcap", path, options)
    truth, expected = (json.loads((GOLDEN / f"{name}.json").read_text()) for name in ("truth", "expected"))
    return Golden(GOLDEN / "golden.mcap", truth, expected, path, options, summary)
