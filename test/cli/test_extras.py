# SPDX-License-Identifier: Apache-2.0
"""Where an extra is not installed, what needs it says so in one sentence, and everything else works."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "bags" / "golden"
PACKAGES = {
    "annotate": ("flask", "waitress", "werkzeug"),
    "cluster": ("dask", "distributed"),
    "learn": ("body_models", "sklearn"),
    "neural": ("ai_edge_litert",),
    "report": ("matplotlib",),
    "rerun": ("rerun",),
    "scans": ("open3d",),
    "video": ("av",),
}
EVERY = ",".join(name for names in PACKAGES.values() for name in names)


def run(packages: str, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a verb where packages (a,b,c) are not installed."""
    helper = [sys.executable, str(ROOT / "test" / "helpers" / "without_packages.py"), packages]
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run([*helper, *arguments], cwd=folder, env=variables, capture_output=True, text=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with inputs for every verb."""
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).normal(size=(500, 3)))
    (tmp_path / "network.tflite").write_bytes(b"TFL3" * 10)
    (tmp_path / "image.png").write_bytes(b"no image")
    frames = [{"index": 0, "puppets": [{"id": "a1", "joints": [[1.0, 2.0, 1.0]]}]}]
    (tmp_path / "truth.json").write_text(json.dumps({"joint_names": ["neck"], "frames": {"0": [[[1, 2, 1]]]}}))
    (tmp_path / "tracks.json").write_text(json.dumps({"joint_names": ["neck"], "fps": 30.0, "frames": frames}))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "said", "arguments"),
    [
        ("annotate", "annotate needs waitress", ["annotate", "."]),
        ("cluster", "--scheduler needs distributed", ["fit", "cloud.npy", "--out", "o", "--scheduler", "tcp://localhost:9"]),
        ("learn", "learn needs sklearn", ["learn", "detector", ".", "--out", "o"]),
        ("learn", "the Anny body needs body_models", ["evaluate", "bodies", "--kind", "whole", "--count", "1"]),
        ("rerun", "--rerun needs rerun", ["replay", str(GOLDEN), "--out", "o.mcap", "--rerun", "o.rrd"]),
    ],
)  # fmt: skip
def test_what_is_missing_is_one_sentence(extra: str, said: str, arguments: list[str], folder: Path) -> None:
    done = run(",".join(PACKAGES[extra]), *arguments, folder=folder)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    sentence = f"flowing-puppet {arguments[0]}: "
    (line,) = (line for line in done.stderr.splitlines() if line.startswith(sentence))
    assert f"{said}: pip install 'flowing_puppet_ros[{extra}]'" in line


@pytest.mark.slow
def test_no_verb_needs_an_extra_to_explain_itself(folder: Path) -> None:
    for verb in ("annotate", "evaluate", "fit", "replay"):
        done = run(EVERY, verb, "--help", folder=folder)
        assert done.returncode == 0 and "usage:" in done.stdout, f"{verb}: {done.stderr}"


@pytest.mark.slow
def test_nodes_and_replay_import_no_page_plot_scan_or_learning_package(folder: Path) -> None:
    """What the nodes import is what replay does: it runs their components over a recording here, from end to end."""
    done = run(EVERY, "replay", str(GOLDEN), "--out", "o.mcap", "--report", "o.html", folder=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "o.mcap").stat().st_size > 10_000 and (folder / "o.html").is_file()
    (imported,) = re.findall(r"^imported (.*)$", done.stderr, flags=re.MULTILINE)
    found = set(imported.split())
    assert {"numpy", "scipy", "cv2", "numba", "mcap", "rosbags"} <= found
    others = {"PIL", "pandas", "torch", "plotly", "dash", "jinja2", "IPython", "requests"}
    assert not found & (set(EVERY.split(",")) | others)


@pytest.mark.slow
@pytest.mark.ros
def test_node_programs_import_no_page_plot_scan_or_learning_package(folder: Path) -> None:
    code = (
        "import sys; import flowing_puppet_ros.node.main, flowing_puppet_ros.node.component_node,"
        " flowing_puppet_ros.node.body_fitter_node; print(*{name.partition('.')[0] for name in sys.modules})"
    )
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True)
    found = set(done.stdout.split())
    assert {"rclpy", "numpy", "cv2", "numba"} <= found
    recordings = {"mcap", "rosbags", "lz4", "zstandard"}
    assert not found & (set(EVERY.split(",")) | recordings), "nodes need nothing that Ubuntu does not have"
