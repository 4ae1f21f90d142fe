# SPDX-License-Identifier: Apache-2.0
"""Check whether this tree can be released (`make release-check`): versions, changelog, licences, tag, packages.

`--quick` skips the checks that build packages or read git's state. Every finding is one sentence; the exit status is
their number.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from scripts.write_changelog import PACKAGES, make_changelog

ROOT = Path(__file__).resolve().parent.parent
NAME = "flowing_puppet_ros"
MANIFESTS = ("package.xml", "msg_defs/package.xml")
LICENSE = "Apache-2.0"
SPDX = f"SPDX-License-Identifier: {LICENSE}"
SOURCES = (".py", ".sh", ".js", ".css", ".yaml", ".toml", "CMakeLists.txt", "package.xml", "Makefile", ".ci/run")
NOT_COPIED = (".*", "build", "install", "log", "out", "docs", "test", "bags", "*.egg-info", "__pycache__")
# Data files without which an installed package would not work.
DATA_FILES = ("weights/*.npz", "weights/*.md", "annotate/page/*", "interfaces/*/*/*.msg", "py.typed")


def read_version(root: Path) -> str:
    """Return the version in the package itself."""
    return re.findall(r'__version__ = "(.+)"', (root / NAME / "__init__.py").read_text())[0]


def check_versions(root: Path) -> Iterator[str]:
    """Check that the version has three parts and is the same in every manifest."""
    version = read_version(root)
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        yield f"the version {version!r} of {NAME}/__init__.py is not of the form 1.2.3"
    for manifest in MANIFESTS:
        found = re.findall(r"<version>(.*?)</version>", (root / manifest).read_text())
        if found != [version]:
            yield f"{manifest} has the version {', '.join(found) or 'none'}, {NAME}/__init__.py has {version}"


def check_changelog(root: Path, released: bool) -> Iterator[str]:
    """Check that the changelog has a section for the version, not empty and, for a release, not called unreleased."""
    version = read_version(root)
    sections = re.split(r"^## ", (root / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1:]
    mine = next((section for section in sections if section.split()[:1] == [version]), None)
    if mine is None:
        yield f"CHANGELOG.md has no section ## {version}"
    elif "\n- " not in mine:
        yield f"the section {version} of CHANGELOG.md names no change"
    elif released and "unreleased" in mine.splitlines()[0]:
        yield f"CHANGELOG.md still calls {version} unreleased"


def check_manifests(root: Path) -> Iterator[str]:
    """Check that the manifests name a real address, and that CHANGELOG.rst, which bloom reads, is CHANGELOG.md."""
    for package, folder in PACKAGES.items():
        place = root / folder.relative_to(ROOT)
        manifest = f"{(place / 'package.xml').relative_to(root)}"
        for placeholder in ("example.org", "noreply"):
            if placeholder in (place / "package.xml").read_text():
                yield f"{manifest} has a placeholder, {placeholder}, for an address"
        if (place / "CHANGELOG.rst").read_text() != make_changelog(package, (root / "CHANGELOG.md").read_text()):
            yield f"{(place / 'CHANGELOG.rst').relative_to(root)} is not what `make changelog` writes"


def check_licences(root: Path) -> Iterator[str]:
    """Check that sources have the licence line, and that LICENSE and the manifests agree with it."""
    if "Apache License" not in (root / "LICENSE").read_text():
        yield "LICENSE is not the Apache License"
    for manifest in MANIFESTS:
        if not re.search(rf"<license[^>]*>{LICENSE}</license>", (root / manifest).read_text()):
            yield f"{manifest} does not say {LICENSE}"
    for path in list_tracked(root):
        if path.name.endswith(SOURCES) and SPDX not in "\n".join(path.read_text().splitlines()[:3]):
            yield f"{path.relative_to(root)} has no line {SPDX}"


def check_tree(root: Path, tagged: bool = False) -> Iterator[str]:
    """Check that nothing is uncommitted and that the version's tag is free or, if `tagged`, on this commit."""
    if run_git(root, "status", "--porcelain"):
        yield "there are changes that are not committed"
    tag = f"v{read_version(root)}"
    if tagged and tag not in run_git(root, "tag", "--points-at", "HEAD").split():
        yield f"this commit has not the tag {tag} of its version"
    if not tagged and run_git(root, "tag", "--list", tag):
        yield f"the tag {tag} is taken; raise the version"


def check_packages(root: Path) -> Iterator[str]:
    """Check that source archive and wheel build and contain weights, page files and interface definitions."""
    with tempfile.TemporaryDirectory() as folder:
        # A copy, since a `build` folder of earlier packages would lend them its files.
        copy = shutil.copytree(root, Path(folder) / "copy", ignore=shutil.ignore_patterns(*NOT_COPIED))
        code = f"import setuptools.build_meta as b; b.build_sdist({folder!r}); b.build_wheel({folder!r})"
        done = subprocess.run([sys.executable, "-c", code], cwd=copy, capture_output=True, text=True)
        if done.returncode:
            yield f"the packages do not build: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}"
            return
        with tarfile.open(next(Path(folder).glob("*.tar.gz"))) as archive:
            source = {name.partition("/")[2] for name in archive.getnames()}
        with zipfile.ZipFile(next(Path(folder).glob("*.whl"))) as wheel:
            installed = set(wheel.namelist())
    for pattern in DATA_FILES:
        for path in sorted((root / NAME).glob(pattern)):
            name = str(path.relative_to(root))
            yield from (f"{kind} lacks {name}" for kind, names in (("sdist", source), ("wheel", installed))
                        if name not in names)  # fmt: skip


def list_tracked(root: Path) -> list[Path]:
    """Return the files under version control."""
    return [path for name in run_git(root, "ls-files", "-z").split("\0") if name and (path := root / name).is_file()]


def run_git(root: Path, *arguments: str) -> str:
    """Run git and return its output."""
    return subprocess.run(["git", *arguments], cwd=root, check=True, capture_output=True, text=True).stdout.strip()


def main(given: list[str]) -> int:
    """Print every finding; return how many there are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="neither build packages nor read git's state")
    parser.add_argument(
        "--tagged", action="store_true", help="the version's tag is set, as where a release is published"
    )
    options = parser.parse_args(given)
    quick = options.quick
    findings = [*check_versions(ROOT), *check_changelog(ROOT, released=not quick), *check_licences(ROOT)]
    if not quick:
        findings += [*check_manifests(ROOT), *check_tree(ROOT, options.tagged), *check_packages(ROOT)]
    for finding in findings:
        print(f"release check: {finding}", file=sys.stderr)
    if not findings:
        print(f"{NAME} {read_version(ROOT)}: nothing found")
    return min(len(findings), 99)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
