# SPDX-License-Identifier: Apache-2.0
"""The rules that keep the package easy to see and to change: who imports whom, file sizes, licence lines."""

import ast
import importlib.metadata
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import flowing_puppet_ros

PACKAGE = Path(flowing_puppet_ros.__file__).parent
ROOT = PACKAGE.parent
NAME = PACKAGE.name
MODULES = sorted(path for path in PACKAGE.rglob("*.py"))
ROS_PACKAGES = {"rclpy", "launch", "launch_ros", "rcl_interfaces", "builtin_interfaces", "std_srvs"}
FOUNDATION = {"blas", "errors", "settings"}
OPTIONAL_PACKAGES = {"anny", "body_models", "dask", "distributed", "rerun"}
OPTIONAL = {"learn": "learn", "cli.cluster": "cluster", "view.rerun_file": "rerun"}
"""Where what a requirements file other than runtime.txt lists may be imported."""
BELOW_STREAM = {"model", "evidence", "inference", "flow", "image", "body"}
MAY_IMPORT = {
    "model": set(),
    "evidence": {"model"},
    "inference": {"model", "evidence"},
    "flow": {"model"},
    "image": {"model", "evidence", "inference", "flow"},
    "body": {"model", "evidence", "inference", "flow", "image"},
    "stream": BELOW_STREAM | {"view"},
    "bag": BELOW_STREAM | {"stream", "view"},
    "node": BELOW_STREAM | {"stream", "view"},
    "view": BELOW_STREAM | {"evaluate", "stream", "bag"},
    "learn": BELOW_STREAM,
    "evaluate": BELOW_STREAM | {"stream", "bag", "learn"},
    "annotate": BELOW_STREAM | {"view"},
    "cli": BELOW_STREAM | {"stream", "bag", "view", "evaluate", "learn", "annotate"},
}


def module_name(path: Path) -> str:
    """Return the dotted name of a module of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path: Path) -> set[str]:
    """Return the dotted names that a module imports, as written and with the names taken from them."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            found.add(str(node.module))
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def subpackage(dotted: str) -> str:
    """Return the part of the package that a dotted name belongs to, empty for the package itself."""
    return [*dotted.split("."), ""][1]


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_arrows_point_down(path: Path) -> None:
    own = subpackage(module_name(path))
    allowed = MAY_IMPORT.get(own, {"cli"} if own == "__main__" else set()) | FOUNDATION | {own, "__version__", ""}
    used = {subpackage(name) for name in imports(path) if name.split(".")[0] == NAME}
    assert used <= allowed, f"{module_name(path)} imports {sorted(used - allowed)}"


def test_every_part_has_its_rule() -> None:
    parts = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert parts == set(MAY_IMPORT)


def test_no_import_cycles() -> None:
    names = {module_name(path): path for path in MODULES}
    graph = {name: {used for used in imports(path) if used in names and used != name} for name, path in names.items()}
    list(TopologicalSorter(graph).static_order())


def test_all_but_node_imports_without_ros() -> None:
    """Every other module imports where rclpy, the message packages and what is optional are absent."""
    names = [module_name(path) for path in MODULES if subpackage(module_name(path)) not in ("node", "__main__")]
    code = f"""
import importlib, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top in {sorted(ROS_PACKAGES | OPTIONAL_PACKAGES)} or top.endswith("_msgs") and name == top:
            raise ModuleNotFoundError(f"{{name}} is absent in this test", name=name)
sys.meta_path.insert(0, Absent())
for name in {names}:
    importlib.import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_third_party_imports_are_required() -> None:
    """What the package imports stands in requirements/runtime.txt, or in another file where only a part imports it."""
    distributions = {"rerun": ["rerun-sdk"]} | dict(importlib.metadata.packages_distributions())
    listed = {
        name: {
            re.split(r"[=<>\[]", line)[0].lower()
            for line in (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
            if not line.startswith("#")
        }
        for name in ("runtime", *OPTIONAL.values())
    }
    for path in MODULES:
        own = subpackage(module_name(path))
        dotted = module_name(path).removeprefix(f"{NAME}.")
        optional = next((name for place, name in OPTIONAL.items() if f"{dotted}.".startswith(f"{place}.")), "runtime")
        allowed = listed["runtime"] | listed[optional]
        for top in {name.split(".")[0] for name in imports(path)} - set(sys.stdlib_module_names) - {NAME}:
            if own == "node" and (top in ROS_PACKAGES or top.endswith("_msgs")):
                continue
            providers = {name.lower() for name in distributions.get(top, [top.replace("_", "-")])}
            assert providers & allowed, f"{module_name(path)} imports {top}, which no requirements file names"


def test_locked_versions_cover_the_requirements() -> None:
    folder = ROOT / "requirements"
    locked = {line.split("==")[0] for line in (folder / "lock.txt").read_text().splitlines()}
    for name in ("runtime", "learn", "cluster", "dev", "docs", "build", "ros"):
        for line in (folder / f"{name}.txt").read_text().splitlines():
            if not line.startswith("#"):
                assert re.split(r"[=<>\[]", line)[0].lower().replace("_", "-") in {
                    pin.replace("_", "-") for pin in locked
                }


def source_files() -> list[Path]:
    """Return the files that carry a licence line."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True).stdout
    endings = (".py", ".sh", ".yaml", ".toml", "CMakeLists.txt", "package.xml", "Makefile", ".ci/run")
    return [ROOT / name for name in tracked.split("\0") if name.endswith(endings) and (ROOT / name).is_file()]


@pytest.mark.parametrize("path", source_files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_are_short_documented_and_licensed(path: Path) -> None:
    text = path.read_text()
    assert "SPDX-License-Identifier: Apache-2.0" in "\n".join(text.splitlines()[:2])
    if path.suffix == ".py":
        assert text.startswith("# SPDX-License-Identifier: Apache-2.0\n")
        assert ast.get_docstring(ast.parse(text)), "the module says what it is for"
        assert len(text.splitlines()) <= 400


def test_versions_agree() -> None:
    for manifest in ("package.xml", "msg_defs/package.xml"):
        assert f"<version>{flowing_puppet_ros.__version__}</version>" in (ROOT / manifest).read_text()
