# SPDX-License-Identifier: Apache-2.0
"""The manifests name what the installed code imports, and no more; what bloom and rosdep read is there."""

import ast
import re
import sys
from pathlib import Path

import pytest
from catkin_pkg.changelog import Changelog, populate_changelog_from_rst
from catkin_pkg.package import parse_package

from flowing_puppet_ros.extras import EXTRAS
from scripts.install_size import RECORDINGS, find_closure, measure, read_requirements
from scripts.write_changelog import PACKAGES, make_changelog

ROOT = Path(__file__).resolve().parent.parent
INSTALL_PAGE = (ROOT / "docs" / "howto" / "install.md").read_text()
ROSDEP_KEYS = {
    "cv2": "python3-opencv", "google": "python3-protobuf", "numba": "python3-numba", "numpy": "python3-numpy",
    "ruamel": "python3-ruamel.yaml", "scipy": "python3-scipy", "tqdm": "python3-tqdm",
}  # fmt: skip
"""Modules and their keys of rosdep, all of which Ubuntu 24.04 has."""
WITHOUT_KEY = {"lz4", "mcap", "rosbags", "threadpoolctl", "zstandard"}
"""Modules without a key that can be released: the page about installation has the command."""
OF_EXTRAS = {
    "ai_edge_litert", "anny", "av", "body_models", "dask", "distributed", "flask", "matplotlib", "open3d", "rerun",
    "sklearn", "waitress", "werkzeug",
}  # fmt: skip
OF_OTHERS = {"foxglove_msgs", "people_msgs", "tf", "vision_msgs", "yolo_msgs", "zed_msgs"}
"""Messages that are understood or sent where their package is installed, or read from bags without it."""
BUNDLED = {"benchmarks"}
"""Of the source tree only, behind a check."""


def installed_files() -> list[Path]:
    return [*(ROOT / "flowing_puppet_ros").rglob("*.py"), *(ROOT / "launch").glob("*.py")]


def used_packages() -> set[str]:
    """Return the top-level modules that installed code imports, and the packages whose messages it names."""
    found: set[str] = set()
    for path in installed_files():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                found.add(str(node.module).partition(".")[0])
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.update(re.findall(r"^([a-z][a-z0-9_]*)/(?:msg|srv|action)/\w+$", node.value))
    return found - set(sys.stdlib_module_names) - {"flowing_puppet_ros"} - BUNDLED


def test_the_manifest_names_what_installed_code_uses_and_nothing_else() -> None:
    package = parse_package(ROOT)
    named = {dependency.name for dependency in package.exec_depends}
    used = used_packages() - WITHOUT_KEY - OF_EXTRAS - OF_OTHERS
    assert {ROSDEP_KEYS.get(name, name) for name in used} == named


@pytest.mark.parametrize("name", sorted(WITHOUT_KEY))
def test_what_has_no_key_is_named_with_the_command_that_installs_it(name: str) -> None:
    assert name in used_packages()
    (command,) = re.findall(r"^pip install --user --break-system-packages (.+ .+)$", INSTALL_PAGE, flags=re.MULTILINE)
    brought = {"lz4": "mcap", "zstandard": "mcap"}  # mcap requires both
    assert brought.get(name, name) in command.split()


@pytest.mark.parametrize("extra", EXTRAS)
def test_extras_are_offered_and_explained(extra: str) -> None:
    assert (ROOT / "requirements" / f"{extra}.txt").is_file()
    assert re.search(rf'^EXTRAS = \(.*"{extra}"', (ROOT / "setup.py").read_text(), flags=re.MULTILINE)
    assert f"| `{extra}` |" in INSTALL_PAGE


@pytest.mark.parametrize("folder", PACKAGES.values(), ids=PACKAGES)
def test_manifests_have_what_bloom_reads(folder: Path) -> None:
    package = parse_package(folder)
    package.validate()
    assert {url.type for url in package.urls} >= {"repository", "bugtracker"}
    assert package.authors and package.maintainers
    licence = re.findall(r'<license file="(.+?)">', (folder / "package.xml").read_text())
    assert [(folder / name).read_bytes() for name in licence] == [(ROOT / "LICENSE").read_bytes()]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_release_has_the_changelog_in_the_form_of_bloom(name: str) -> None:
    released = "## 1.0.0 (2026-01-31)\n\n- `fit`s *all* a_b:\n  more.\n- B.\n"
    text = make_changelog(name, f"# Changelog\n\n## 1.1.0 (unreleased)\n\n- New.\n\n{released}")
    changelog = Changelog(name)
    populate_changelog_from_rst(changelog, text)
    ((version, date, (content,)),) = changelog.foreach_version()
    assert version == "1.0.0" and date.strftime("%Y-%m-%d") == "2026-01-31"
    assert "fit" in str(content) and len(content.bullets) == 2
    assert f"Changelog for package {name}" in text and "\n* ``fit``\\ s \\*all\\* a\\_b: more.\n" in text
    assert (PACKAGES[name] / "CHANGELOG.rst").is_file()


def test_installed_files_have_licence_and_read_me() -> None:
    setup = (ROOT / "setup.py").read_text()
    for name in ("LICENSE", "README.md", "CHANGELOG.rst"):
        assert f'"{name}"' in setup and (ROOT / name).is_file()
    cmake = (ROOT / "msg_defs" / "CMakeLists.txt").read_text()
    assert "install(FILES LICENSE CHANGELOG.rst DESTINATION share/${PROJECT_NAME})" in cmake


def test_the_requirements_of_nodes_bring_only_what_computes() -> None:
    """Nothing for pages, plots, scans or learning, and nothing for recordings."""
    brought = find_closure(read_requirements("runtime") - RECORDINGS)
    assert brought == {
        "llvmlite", "numba", "numpy", "opencv-python-headless", "ruamel-yaml", "scipy", "threadpoolctl", "tqdm",
    }  # fmt: skip
    extras = {name for extra in EXTRAS if extra != "rerun" for name in read_requirements(extra)}
    assert not find_closure(read_requirements("runtime")) & extras


def test_a_size_is_that_of_a_distributions_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    site = tmp_path / "site"
    for name, text in (("a_b/x.py", "1234"), ("a_b/x.pyc", "12345678"), ("a_b-1.2.dist-info/METADATA", "Name: a.b\n")):
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_text(text)
    (site / "a_b-1.2.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: a-b\nVersion: 1.2\n")
    listed = ("a_b/x.py,,", "a_b/x.pyc,,", "a_b/gone.py,,")
    (site / "a_b-1.2.dist-info" / "RECORD").write_text("\n".join(listed) + "\n")
    monkeypatch.syspath_prepend(str(site))
    assert (measure("a-b").version, measure("a-b").bytes) == ("1.2", 4)


def test_one_manifest_has_the_addresses_and_everything_else_repeats_them() -> None:
    own, messages = (parse_package(folder) for folder in PACKAGES.values())
    assert own.maintainers[0].email == messages.maintainers[0].email
    assert [url.url for url in own.urls] == [url.url for url in messages.urls]
    repository = next(url.url for url in own.urls if url.type == "repository")
    for page in (ROOT / "README.md", ROOT / "docs" / "howto" / "install.md"):
        assert re.findall(r"^git clone (\S+) ", page.read_text(), flags=re.MULTILINE) == [repository]
