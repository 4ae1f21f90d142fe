# SPDX-License-Identifier: Apache-2.0
"""The rules that keep the package easy to see and to change: who imports whom, file sizes, licence lines."""

import ast
import importlib.metadata
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from room_imports import MAY_IMPORT  # type: ignore[import-not-found]

import flowing_puppet_ros
from flowing_puppet_ros.stream.components.registry import COMPONENTS, node_settings

PACKAGE = Path(flowing_puppet_ros.__file__).parent
ROOT = PACKAGE.parent
NAME = PACKAGE.name
MODULES = sorted(path for path in PACKAGE.rglob("*.py"))
ROS_PACKAGES = {
    "ament_index_python",
    "rclpy",
    "launch",
    "launch_ros",
    "rcl_interfaces",
    "builtin_interfaces",
    "std_srvs",
}
FOUNDATION = {
    "arrays", "assignment", "errors", "extras", "ids", "images", "process", "reporting", "settings", "units",
}  # fmt: skip
"""Modules beside the rooms, and a room, which everything may import."""
OPTIONAL_PACKAGES = {
    "ai_edge_litert", "anny", "av", "body_models", "dask", "distributed", "flask", "matplotlib", "open3d", "rerun",
    "waitress", "werkzeug",
}  # fmt: skip
ONLY_WITH_EXTRA = "flowing_puppet_ros.annotate.server"
"""Nothing but an extra's own module imports what the extra brings at its top."""
OPTIONAL = {
    "annotate.server": "annotate",
    "cli.annotate": "annotate",
    "learn": "learn",
    "cli.batch.cluster": "cluster",
    "image.networks.runtime": "neural",
    "report.rerun_file": "rerun",
    "bag.foreign.video": "video",
    "evaluate.output": "report",
}
"""Where what a requirements file other than runtime.txt lists may be imported."""
HEAVY_PACKAGES = {"cv2", "matplotlib", "mcap", "numba", "open3d", "rclpy", "rosbags", "scipy", "sklearn"}
"""What takes a tenth of a second or more to import."""
MAX_FILES = 10
"""The other rooms (folders of modules) that each room imports; the layers in docs/architecture.md are made from it."""


def module_name(path: Path) -> str:
    """Return the dotted name of a module of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the dotted names that a module imports, as written and with the names taken from them."""
    found: set[str] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            found.add(str(node.module))
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


def room_of(dotted: str) -> str:
    """Return the room of a module, class or function of the package; empty for the package itself."""
    parts = dotted.split(".")[1:]
    while parts and not (PACKAGE.joinpath(*parts) / "__init__.py").is_file():
        if len(parts) == 1 and (PACKAGE / f"{parts[0]}.py").is_file():
            break
        parts.pop()
    return ".".join(parts)


def layers() -> list[list[str]]:
    """Return the rooms from the lowest layer up: those of one layer import only from the layers before it."""
    sorter = TopologicalSorter(MAY_IMPORT)
    sorter.prepare()
    found: list[list[str]] = []
    while sorter.is_active():
        ready = sorter.get_ready()
        sorter.done(*ready)
        found.append(sorted(room for room in ready if files_in(room)))
    return [layer for layer in found if layer]


def files_in(room: str) -> list[Path]:
    """Return the modules that stand in a room itself."""
    return [path for path in PACKAGE.joinpath(*room.split(".")).glob("*.py") if path.name != "__init__.py"]


def package_of(room: str) -> str:
    """Return the outermost folder that a room is in."""
    return room.partition(".")[0]


def test_rooms_import_exactly_what_is_listed() -> None:
    found: dict[str, set[str]] = {room: set() for room in MAY_IMPORT}
    for path in MODULES:
        own = room_of(module_name(path))
        if own in FOUNDATION | {"", "__main__"}:
            continue
        used = {room_of(name) for name in imports(path) if name.split(".")[0] == NAME}
        found.setdefault(own, set()).update(used - FOUNDATION - {own, ""})
    assert found == MAY_IMPORT


def test_no_circle_of_rooms_or_of_packages() -> None:
    list(TopologicalSorter(MAY_IMPORT).static_order())
    packages: dict[str, set[str]] = {}
    for room, used in MAY_IMPORT.items():
        above = packages.setdefault(package_of(room), set())
        above.update({package_of(other) for other in used} - {package_of(room)})
    list(TopologicalSorter(packages).static_order())


def test_images_and_bodies_do_not_know_each_other() -> None:
    for room, used in MAY_IMPORT.items():
        packages = {package_of(other) for other in used}
        assert not (package_of(room) == "image" and packages & {"body", "multiview", "stream"})
        assert not (package_of(room) == "body" and packages & {"image", "multiview", "stream"})


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_rooms_are_small_and_say_what_they_are_for(room: str) -> None:
    assert len(files_in(room)) <= MAX_FILES
    said = ast.get_docstring(ast.parse((PACKAGE.joinpath(*room.split(".")) / "__init__.py").read_text())) or ""
    assert "\n\n" in said, "a summary, then what comes in, what goes out and what to read first"


def test_no_import_cycles() -> None:
    names = {module_name(path): path for path in MODULES}
    graph = {name: {used for used in imports(path) if used in names and used != name} for name, path in names.items()}
    list(TopologicalSorter(graph).static_order())


@pytest.mark.slow
def test_all_but_node_imports_without_ros() -> None:
    """Every other module imports where rclpy, the message packages and what is optional are absent."""
    names = [
        module_name(path) for path in MODULES if package_of(room_of(module_name(path))) not in ("node", "__main__")
    ]
    names.remove(ONLY_WITH_EXTRA)
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


def test_help_of_a_verb_loads_nothing_heavy() -> None:
    """The parser of every verb is made where what takes long to import is absent."""
    code = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(HEAVY_PACKAGES)}:
            raise ModuleNotFoundError(f"the help of {{verb}} loads {{name}}", name=name)
sys.meta_path.insert(0, Absent())
from flowing_puppet_ros.cli import VERBS, make_verb_parser
for verb in VERBS:
    make_verb_parser(verb, ["--help"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_third_party_imports_are_required() -> None:
    """What the package imports stands in requirements/runtime.txt, or in another file where only a part imports it."""
    distributions = {"rerun": ["rerun-sdk"]} | dict(importlib.metadata.packages_distributions())
    listed = {
        name: {
            re.split(r"[=<>\[;]", line)[0].lower()
            for line in (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
            if not line.startswith("#")
        }
        for name in ("runtime", *OPTIONAL.values())
    }
    for path in MODULES:
        own = room_of(module_name(path))
        dotted = module_name(path).removeprefix(f"{NAME}.")
        optional = next((name for place, name in OPTIONAL.items() if f"{dotted}.".startswith(f"{place}.")), "runtime")
        allowed = listed["runtime"] | listed[optional]
        for top in {name.split(".")[0] for name in imports(path)} - set(sys.stdlib_module_names) - {NAME}:
            if package_of(own) == "node" and (top in ROS_PACKAGES or top.endswith("_msgs")):
                continue
            providers = {name.lower() for name in distributions.get(top, [top.replace("_", "-")])}
            assert providers & allowed, f"{module_name(path)} imports {top}, which no requirements file names"


def test_locked_versions_cover_the_requirements() -> None:
    folder = ROOT / "requirements"
    locked = {line.split("==")[0] for line in (folder / "lock.txt").read_text().splitlines()}
    for name in ("runtime", *(set(OPTIONAL.values()) - {"rerun"}), "dev", "docs", "build", "ros"):
        for line in (folder / f"{name}.txt").read_text().splitlines():
            if not line.startswith("#") and "aarch64" not in line:
                assert re.split(r"[=<>\[;]", line)[0].lower().replace("_", "-") in {
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


def test_no_class_name_stands_twice() -> None:
    seen: dict[str, str] = {}
    for path in MODULES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef):
                assert node.name not in seen, f"{node.name} is in {module_name(path)} and in {seen[node.name]}"
                seen[node.name] = module_name(path)


def test_limits_are_called_min_and_max() -> None:
    other = re.compile(r"(?:^|_)(least|most|fewest|farthest|longest|shortest|largest|smallest)(?:_|$)", re.IGNORECASE)
    for path in MODULES:
        for node in parsed(path).body:
            sides = getattr(node, "targets", [getattr(node, "target", None)])
            for target in (item for each in sides if each for item in ast.walk(each) if isinstance(item, ast.Name)):
                assert not other.search(target.id), f"{module_name(path)}.{target.id}: say MIN_ or MAX_"
    for settings in (kind for name in COMPONENTS for kind in (COMPONENTS[name].settings_type, node_settings(name))):
        assert not [info.name for info in settings.describe() if other.search(info.name.replace(".", "_"))]
