# SPDX-License-Identifier: Apache-2.0
"""The golden bag and two replays of it, made once."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flowing_puppet_ros.bag.replay import ReplayOptions, replay

GOLDEN = Path(__file__).resolve().parents[2] / "bags" / "golden"
SETTINGS = {"visual_hull": {"every": 4}}


@dataclass(frozen=True)
class Golden:
    """The golden recording, what is true in it, what a replay is expected to say, and two replays."""

    source: Path
    truth: dict[str, dict[str, list[float]]]
    expected: dict[str, Any]
    replays: tuple[Path, Path]
    summary: dict[str, Any]


@pytest.fixture(scope="session")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Golden:
    folder = tmp_path_factory.mktemp("golden")
    replays = folder / "first" / "out.mcap", folder / "second" / "out.mcap"
    options = ReplayOptions(settings=SETTINGS, progress=False)
    summaries = [replay(GOLDEN / "golden.mcap", path, options) for path in replays]
    truth, expected = (json.loads((GOLDEN / f"{name}.json").read_text()) for name in ("truth", "expected"))
    return Golden(GOLDEN / "golden.mcap", truth, expected, replays, summaries[0])
