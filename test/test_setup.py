# SPDX-License-Identifier: Apache-2.0
"""The set-up: what it says when something is missing, and what it uses."""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def setup_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Return scripts/make_venv.py as a module whose environment is a temporary folder."""
    spec = importlib.util.spec_from_file_location("make_venv", ROOT / "scripts" / "make_venv.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "make_venv", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(module, "STATE", tmp_path / ".venv" / ".setup")
    yield module


def find_python(**variables: str) -> subprocess.CompletedProcess[str]:
    """Run the finder with nothing but `variables` in its environment."""
    command = ["/bin/sh", str(ROOT / "scripts" / "find_python.sh")]
    return subprocess.run(command, env=variables, capture_output=True, text=True)


def test_finder_passes_over_a_shim_that_refuses(tmp_path: Path) -> None:
    shim = tmp_path / "python3.12"
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    versions = tmp_path / "pyenv" / "versions" / "3.12.9" / "bin"
    versions.mkdir(parents=True)
    (versions / "python3.12").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (versions / "python3.12").chmod(0o755)
    found = find_python(PATH=f"{tmp_path}:/bin", HOME=str(tmp_path), PYENV_ROOT=str(tmp_path / "pyenv"))
    assert found.returncode == 0
    python = found.stdout.strip()
    assert python != str(shim)
    version = subprocess.run([python, "--version"], capture_output=True, text=True).stdout
    assert version.startswith("Python 3.12")


def test_finder_names_a_useless_choice(tmp_path: Path) -> None:
    found = find_python(PATH="/bin", HOME=str(tmp_path), PYTHON="/bin/false")
    assert found.returncode == 1
    assert "/bin/false" in found.stderr
    assert len(found.stderr.splitlines()) == 1


def test_steps_resume_and_skip(setup_script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """A failed run goes on at the failed step, an unchanged one does nothing, a changed input repeats what follows."""
    ran: list[str] = []
    broken = {"second"}
    inputs = {"first": "a", "second": "b", "third": "c"}

    def step(name: str) -> object:
        def work() -> None:
            ran.append(name)
            if name in broken:
                raise setup_script.SetupError(f"{name} failed")

        return setup_script.Step(name, name, [inputs[name]], work)

    monkeypatch.setattr(setup_script, "make_steps", lambda ros, environment: [step(name) for name in inputs])
    monkeypatch.setattr(setup_script, "ensure_system_packages", lambda: None)
    assert setup_script.main() == 1
    broken.clear()
    assert setup_script.main() == 0
    assert setup_script.main() == 0
    inputs["second"] = "changed"
    assert setup_script.main() == 0
    assert ran == ["first", "second", "second", "third", "second", "third"]


def test_missing_libraries_are_named_with_the_command(
    setup_script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(setup_script, "SHARED_LIBRARIES", {"libnowhere.so.7": "libnowhere7"})
    monkeypatch.setattr(setup_script.os, "geteuid", lambda: 1000)
    with pytest.raises(setup_script.SetupError, match=r"libnowhere\.so\.7.*sudo apt-get install.*libnowhere7"):
        setup_script.ensure_system_packages()


def test_no_network_is_one_sentence(setup_script: ModuleType) -> None:
    code = "import sys; print('NewConnectionError: refused'); sys.exit(1)"
    with pytest.raises(setup_script.SetupError, match="package index cannot be reached"):
        setup_script.run([sys.executable, "-c", code], dict(os.environ), "log", "Installing failed")


def test_failure_quotes_the_error_line(setup_script: ModuleType) -> None:
    code = "import sys; print('ERROR: no wheel for x'); print('bye'); sys.exit(1)"
    with pytest.raises(setup_script.SetupError, match=r"Installing failed \(ERROR: no wheel for x\)"):
        setup_script.run([sys.executable, "-c", code], dict(os.environ), "log", "Installing failed")


def test_networks_that_cannot_be_had_are_told_with_the_remedy_and_stop_nothing(
    setup_script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = setup_script.VENV / "bin" / "flowing-puppet"
    program.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\necho "$@" >&2\necho "flowing-puppet networks: ERROR: no wheel" >&2\nexit 2\n')
    program.chmod(0o755)
    step = setup_script.Step("networks", "networks", ["a"], lambda: setup_script.install_networks(dict(os.environ)))
    monkeypatch.setattr(setup_script, "make_steps", lambda ros, environment: [step])
    monkeypatch.setattr(setup_script, "ensure_system_packages", lambda: None)
    assert setup_script.main() == 0
    told = capsys.readouterr().err
    assert "The keypoint networks were not installed (flowing-puppet networks: ERROR: no wheel)" in told
    assert f"until you run `{program} networks --install`" in told
    assert (setup_script.STATE / "networks.log").read_text().startswith("networks --install")


def test_sourced_ros_is_used_only_when_it_is_jazzy(
    setup_script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prefix = tmp_path / "opt"
    (prefix / "share" / "rclpy").mkdir(parents=True)
    (prefix / "share" / "rclpy" / "package.xml").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/workspace:{prefix}")
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{prefix}/lib")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    ros = setup_script.sourced_ros()
    assert ros == (tmp_path / "workspace", prefix)
    assert setup_script.child_environment(ros)["LD_LIBRARY_PATH"] == f"{prefix}/lib"
    monkeypatch.setenv("ROS_DISTRO", "humble")
    assert setup_script.sourced_ros() == ()
    assert not {"LD_LIBRARY_PATH", "ROS_DISTRO"} & set(setup_script.child_environment(()))
