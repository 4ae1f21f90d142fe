# SPDX-License-Identifier: Apache-2.0
"""A colcon workspace made as docs/howto/install.md says: both packages are found and built, and every node starts."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from catkin_pkg.topological_order import topological_order

from flowing_puppet_ros.stream.components.registry import COMPONENTS

ROOT = Path(__file__).resolve().parent.parent
LINK = "ln -s flowing_puppet_ros/msg_defs src/flowing_puppet_msgs"
OUTPUTS = ("build", "install", "log", "out", ".*", "cache", "__pycache__", "*.egg-info", "docs", "test", "benchmarks")


def environment() -> dict[str, str]:
    """Return the environment in which a ROS is sourced; with the ROS wheels it is the virtual environment."""
    variables = dict(os.environ)
    variables["AMENT_PREFIX_PATH"] = os.pathsep.join(filter(None, [sys.prefix, variables.get("AMENT_PREFIX_PATH")]))
    variables["PATH"] = os.pathsep.join([f"{sys.prefix}/bin", variables["PATH"]])
    # This tree must not be imported instead of what is installed.
    variables.pop("PYTHONPATH", None)
    return variables


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace with the repository and the link below src/."""
    folder = tmp_path_factory.mktemp("workspace")
    ignored = shutil.ignore_patterns(*OUTPUTS)
    shutil.copytree(ROOT, folder / "src" / "flowing_puppet_ros", symlinks=True, ignore=ignored)
    assert LINK in (ROOT / "docs" / "howto" / "install.md").read_text().splitlines()
    subprocess.run(LINK.split(), cwd=folder, check=True)
    return folder


def test_colcon_rosdep_and_bloom_find_both_packages(workspace: Path) -> None:
    found = [package.name for _, package in topological_order(str(workspace / "src"))]
    assert found == ["flowing_puppet_msgs", "flowing_puppet_ros"]


@pytest.fixture(scope="module")
def install(workspace: Path) -> Path:
    """Return the install folder of the workspace, built with `colcon build`."""
    command = ["colcon", "build", "--cmake-args", "-DBUILD_TESTING=OFF"]
    built = subprocess.run(command, cwd=workspace, env=environment(), capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / "install"


def run_sourced(install: Path, command: str) -> subprocess.CompletedProcess[str]:
    """Run a shell command where the workspace is sourced."""
    variables = environment()
    # Without the guard the start-up hook of the ROS wheels sets LD_LIBRARY_PATH again, on top of what setup.sh set.
    variables.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    shell = f". {install}/setup.sh && {command}"
    return subprocess.run(["sh", "-c", shell], cwd=install.parent, env=variables, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.ros
def test_what_colcon_installs_is_complete(install: Path) -> None:
    code = (
        "import flowing_puppet_msgs.msg as m, flowing_puppet_ros as p; from importlib.resources import files;"
        "from ament_index_python.packages import get_package_share_directory as share;"
        "print(m.__file__, p.__file__, share(p.__name__));"
        "assert (files(p) / 'interfaces' / 'flowing_puppet_msgs' / 'msg' / 'Puppet.msg').is_file()"
    )
    ran = run_sourced(install, f'{sys.executable} -c "{code}"')
    assert ran.returncode == 0, ran.stderr
    assert all(str(install) in path for path in ran.stdout.split())
    share = install / "flowing_puppet_ros" / "share" / "flowing_puppet_ros"
    assert {path.name for path in (share / "launch").iterdir()} == {
        path.name for path in (ROOT / "launch").glob("*.py")
    }
    assert {path.stem for path in (share / "config").glob("*.yaml")} == set(COMPONENTS)
    for name in ("LICENSE", "README.md", "CHANGELOG.rst", "package.xml"):
        assert (share / name).read_bytes() == (ROOT / name).read_bytes()
    assert (install / "flowing_puppet_msgs" / "share" / "flowing_puppet_msgs" / "LICENSE").is_file()


@contextmanager
def running(install: Path) -> Iterator[list[subprocess.Popen[str]]]:
    """Start every node, unconfigured, as `ros2 run` starts it; interrupt them at the end."""
    programs = install / "flowing_puppet_ros" / "lib" / "flowing_puppet_ros"
    variables = environment()
    variables.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    nodes = []
    for name in COMPONENTS:
        shell = f". {install}/setup.sh && exec {programs / name} --ros-args -p autostart:=false -r __ns:=/workspace"
        nodes.append(subprocess.Popen(["sh", "-c", shell], env=variables, stderr=subprocess.PIPE, text=True))
    try:
        yield nodes
    finally:
        for node in nodes:
            node.send_signal(signal.SIGINT)


@pytest.mark.slow
@pytest.mark.ros
def test_every_installed_node_starts_and_ends(install: Path) -> None:
    import rclpy

    context = rclpy.context.Context()
    rclpy.init(context=context)
    watcher = rclpy.create_node("watcher", context=context)
    try:
        with running(install) as nodes:
            missing = set(COMPONENTS)
            end = time.monotonic() + 120
            while missing and time.monotonic() < end and not any(node.poll() for node in nodes):
                missing -= {name for name, space in watcher.get_node_names_and_namespaces() if space == "/workspace"}
                time.sleep(0.2)
            assert not missing, [node.stderr.read() for node in nodes if node.poll() and node.stderr]
        for node in nodes:
            assert node.wait(timeout=60) == 0, node.stderr and node.stderr.read()
    finally:
        watcher.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.slow
@pytest.mark.ros
def test_the_installed_command_line_runs(install: Path) -> None:
    program = install / "flowing_puppet_ros" / "lib" / "flowing_puppet_ros" / "flowing-puppet"
    ran = run_sourced(install, f"{program} --version")
    assert ran.returncode == 0 and re.fullmatch(r"flowing-puppet \d+\.\d+\.\d+\n", ran.stdout), ran.stderr
