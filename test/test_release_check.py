# SPDX-License-Identifier: Apache-2.0
"""The release check finds what is wrong, and nothing in this tree (in its quick part)."""

import shutil
import subprocess
from pathlib import Path

import pytest

from scripts import release_check
from scripts.release_check import (
    check_changelog,
    check_licences,
    check_manifests,
    check_packages,
    check_tree,
    check_versions,
)
from scripts.write_changelog import make_changelog

FILES = (
    "LICENSE", "CHANGELOG.md", "CHANGELOG.rst", "package.xml", "msg_defs/package.xml", "msg_defs/CHANGELOG.rst",
    "flowing_puppet_ros/__init__.py",
)  # fmt: skip


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A repository with the files that are looked at, committed."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        shutil.copy(release_check.ROOT / name, tmp_path / name)
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    return tmp_path


def changed(path: Path, old: str, new: str) -> None:
    """Replace a text in a file that has it."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_this_tree_has_no_findings(capsys: pytest.CaptureFixture[str]) -> None:
    assert release_check.main(["--quick"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("manifest", release_check.MANIFESTS)
def test_a_version_that_differs_is_named(tree: Path, manifest: str) -> None:
    changed(tree / manifest, f"<version>{release_check.read_version(tree)}<", "<version>9.9.9<")
    (finding,) = check_versions(tree)
    assert manifest in finding
    assert "9.9.9" in finding


def test_a_changelog_needs_the_version_and_for_a_release_its_end(tree: Path) -> None:
    version = release_check.read_version(tree)
    log = tree / "CHANGELOG.md"
    log.write_text(f"# Changelog\n\n## {version} (unreleased)\n\n- A change.\n")
    assert not list(check_changelog(tree, released=False))
    assert "unreleased" in next(check_changelog(tree, released=True))
    log.write_text(f"# Changelog\n\n## {version}\n\nWords.\n")
    assert "no change" in next(check_changelog(tree, released=True))
    log.write_text("# Changelog\n\n## 0.0.1\n\n- A change.\n")
    assert f"## {version}" in next(check_changelog(tree, released=True))


def test_placeholders_and_an_old_changelog_are_named(tree: Path) -> None:
    for folder in (tree, tree / "msg_defs"):
        text = (folder / "package.xml").read_text()
        (folder / "package.xml").write_text(text.replace("example.org", "a.org").replace("noreply.github", "a"))
    for package, place in (("flowing_puppet_ros", tree), ("flowing_puppet_msgs", tree / "msg_defs")):
        (place / "CHANGELOG.rst").write_text(make_changelog(package, (tree / "CHANGELOG.md").read_text()))
    assert not list(check_manifests(tree))
    changed(tree / "package.xml", "https://a.org", "https://example.org")
    (tree / "msg_defs" / "CHANGELOG.rst").write_text("Old.\n")
    placeholder, old = check_manifests(tree)
    assert placeholder == "package.xml has a placeholder, example.org, for an address"
    assert old == "msg_defs/CHANGELOG.rst is not what `make changelog` writes"


def test_a_source_without_its_licence_line_is_named(tree: Path) -> None:
    assert not list(check_licences(tree))
    (tree / "new.py").write_text('"""A module."""\n')
    subprocess.run(["git", "add", "new.py"], cwd=tree, check=True)
    assert "new.py" in next(check_licences(tree))
    changed(tree / "package.xml", "Apache-2.0</license>", "MIT</license>")
    assert "package.xml" in next(check_licences(tree))


def test_a_taken_tag_and_uncommitted_changes_are_named(tree: Path) -> None:
    assert not list(check_tree(tree))
    subprocess.run(["git", "tag", f"v{release_check.read_version(tree)}"], cwd=tree, check=True)
    (tree / "left").write_text("over")
    assert len(list(check_tree(tree))) == 2


def test_where_a_release_is_published_the_tag_must_be_on_the_commit(tree: Path) -> None:
    tag = f"v{release_check.read_version(tree)}"
    subprocess.run(["git", "tag", tag], cwd=tree, check=True)
    assert not list(check_tree(tree, tagged=True))
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    subprocess.run(["git", *who, "commit", "-q", "--allow-empty", "-m", "later"], cwd=tree, check=True)
    assert list(check_tree(tree, tagged=True)) == [f"this commit has not the tag {tag} of its version"]


@pytest.mark.slow
def test_packages_that_lack_a_file_are_named(tmp_path: Path) -> None:
    package = tmp_path / release_check.NAME
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text('__version__ = "1.2.3"\n')
    (package / "weights" / "left_out.npz").write_bytes(b"x")
    setup = "from setuptools import setup\nsetup(name='flowing_puppet_ros', version='1.2.3', packages=['{}'])\n"
    (tmp_path / "setup.py").write_text(setup.format(release_check.NAME))
    assert sorted(check_packages(tmp_path)) == [
        f"{kind} lacks {release_check.NAME}/weights/left_out.npz" for kind in ("sdist", "wheel")
    ]
    (tmp_path / "setup.py").write_text("raise SystemExit('nothing works')")
    assert "do not build" in next(check_packages(tmp_path))
