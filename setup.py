# SPDX-License-Identifier: Apache-2.0
"""The ament_python package flowing_puppet_ros; pip and colcon both build it from here."""

import re
from pathlib import Path

from setuptools import find_packages, setup

NAME = "flowing_puppet_ros"
HERE = Path(__file__).resolve().parent
EXTRAS = ("annotate", "cluster", "learn", "neural", "report", "rerun", "scans", "video")
NODES = ("optical_flow", "puppet_tracker", "visual_hull", "body_fitter")


def requirements(name: str) -> list[str]:
    """Return the requirements in requirements/`name`.txt without its comments."""
    lines = (HERE / "requirements" / f"{name}.txt").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def files(pattern: str) -> list[str]:
    """Return the files that match `pattern`, relative to this folder as setuptools wants them."""
    return sorted(str(path.relative_to(HERE)) for path in HERE.glob(pattern))


def find_in_manifest(pattern: str) -> str:
    """Return what package.xml says, so that addresses stand in one place."""
    return str(re.findall(pattern, (HERE / "package.xml").read_text())[0])


setup(
    name=NAME,
    version=re.findall(r'__version__ = "(.+)"', (HERE / NAME / "__init__.py").read_text())[0],
    description="People's pose and body shape from images, clouds and bags, with puppets.",
    long_description="See README.md.",
    license="Apache-2.0",
    license_files=["LICENSE"],
    url=find_in_manifest(r'<url type="repository">(.+)</url>'),
    maintainer=find_in_manifest(r"<maintainer .+>(.+)</maintainer>"),
    maintainer_email=find_in_manifest(r'<maintainer email="(.+)">'),
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            "py.typed",
            "annotate/page/*",
            "report/web/*",
            "weights/*.npz",
            "weights/*.md",
            "interfaces/*/*/*.msg",
            "interfaces/*/*/*.action",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml", "LICENSE", "README.md", "CHANGELOG.rst"]),
        (f"share/{NAME}/launch", files("launch/*.launch.py")),
        (f"share/{NAME}/config", files("config/*.*")),
    ],
    python_requires=">=3.12",
    install_requires=requirements("runtime"),
    extras_require={name: requirements(name) for name in EXTRAS}
    | {"learn": requirements("learn") + requirements("learn-assets")},
    entry_points={
        "console_scripts": [
            "flowing-puppet = flowing_puppet_ros.cli:main",
            *(f"{node} = {NAME}.node.main:{node}" for node in NODES),
        ],
    },
    zip_safe=False,
)
