# SPDX-License-Identifier: Apache-2.0
"""`flowing-puppet learn sp`: learn a 3D Stitched Puppet and write it with its model card."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from flowing_puppet_ros.learn.anny.body import GENDERS
from flowing_puppet_ros.learn.sp.pose_spaces import TREE
from flowing_puppet_ros.learn.sp.training import LearnedPuppet, LearnSettings, learn_puppet
from flowing_puppet_ros.model.sp import StitchedPuppet
from flowing_puppet_ros.process.threads import one_blas_thread
from flowing_puppet_ros.settings import make_out_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `learn sp`."""
    parser.add_argument("--gender", choices=GENDERS, default="neutral", help="whose body [%(default)s]")
    parser.add_argument("--out", type=Path, required=True, help="folder for sp_GENDER.npz and its model card")
    parser.add_argument("--mocap", type=Path, help="motion capture, expmap_20hz.npz; without it joint limits alone")
    LearnSettings.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Learn one model, write it with its card and print its path; progress on stderr."""
    settings = LearnSettings.from_arguments(arguments)
    make_out_folder(arguments.out)
    # Sums depend on the number of BLAS threads; with one thread the weights are the same on every machine.
    with one_blas_thread():
        learned = learn_puppet(arguments.gender, settings, arguments.mocap, lambda step: print(step, file=sys.stderr))
    path = arguments.out / f"sp_{arguments.gender}.npz"
    np.savez_compressed(path, **learned.arrays)  # type: ignore[arg-type]
    card = format_card(arguments.gender, settings, arguments.mocap is not None, learned)
    path.with_suffix(".md").write_text(card, encoding="utf-8")
    print(path)
    return 0


def format_card(gender: str, settings: LearnSettings, mocap: bool, learned: LearnedPuppet) -> str:
    """Describe the model, its training data and licence, and what its spaces leave out."""
    rows = [
        f"| {name} | {len(space.mean)} | {space.basis.shape[2]} "
        f"| {100 * space.share:.1f} | {1000 * space.residual:.1f} |"
        for name, space in zip(TREE.names, learned.pose_spaces, strict=True)
    ]
    joints = ", ".join(f"{name} {1000 * error:.0f}" for name, error in learned.joint_error.items())
    poses = (
        "frames of the CMU motion capture with noise, a quarter from joint limits alone" if mocap else "joint limits"
    )
    return _CARD.format(
        name=gender,
        people="adults" if gender == "neutral" else f"{gender} adults",
        vertices=len(learned.arrays["part_of_vertex"]),
        faces=len(learned.arrays["faces"]),
        settings=settings,
        command=f"flowing-puppet learn sp --gender {gender} --shapes {settings.shapes} --poses {settings.poses} "
        f"--shape-count {settings.shape_count} --seed {settings.seed}"
        f"{' --mocap expmap_20hz.npz' if mocap else ''} --out flowing_puppet_ros/weights",
        poses=poses,
        shape_share=100 * learned.shape_space.share,
        shape_residual=1000 * learned.shape_space.residual,
        rows="\n".join(rows),
        joints=joints,
        samples=describe_samples(StitchedPuppet.from_arrays(gender, learned.arrays)),
    )


def describe_samples(model: StitchedPuppet, count: int = 200) -> str:
    """Describe `count` random bodies of a model: statures, volumes, and the gaps where parts meet."""
    rng = np.random.default_rng(0)
    statures, volumes, gaps = [], [], []
    for _ in range(count):
        standing = model.vertices(model.sample(rng, pose_scale=0.0))
        statures.append(np.ptp(standing[:, 2]))
        a, b, c = standing[model.faces].transpose(1, 0, 2)
        volumes.append((a * np.cross(b, c)).sum() / 6 * 1000)
        parts = model.parts(model.sample(rng))
        pairs = zip(model.interfaces, model.tree.edges, strict=True)
        apart = [parts[i][own.parent_index] - parts[j][own.child_index] for own, (i, j) in pairs]
        gaps.append(np.linalg.norm(np.concatenate(apart), axis=1).mean() * 1000)
    tall, large = (np.percentile(values, [5, 50, 95]) for values in (statures, volumes))
    return (
        f"{count} random bodies of the model (5th, 50th and 95th percentile): stature {tall[0]:.2f}, {tall[1]:.2f} and"
        f" {tall[2]:.2f} m, volume {large[0]:.0f}, {large[1]:.0f} and {large[2]:.0f} litres;\nposed ones have gaps of"
        f" {np.mean(gaps):.1f} mm between the copies of a border vertex (the worst of them {np.max(gaps):.1f} mm)."
    )


_CARD = """# Stitched Puppet {name}

A 3D model of the shape and pose of {people} in 16 parts (S. Zuffi, thesis, chapter "Stitched Puppet Model"; S. Zuffi
and M. J. Black, CVPR 2015). Template: {vertices} vertices, {faces} triangles, closed, the same for all three models and
exactly symmetric; A-pose; x forward, y to the person's left, z up, metres.

- Learned from {settings.shapes} shapes and {settings.poses} poses (each also mirrored) with the command
  `{command}`
- Body: Anny 0.6.2 (code Apache-2.0, assets CC0, made from MakeHuman): adults of 1.45 to 2.0 m, thin to very heavy,
  minimal clothing, no hair. It stands in for the SCAPE model of the thesis.
- Poses: {poses}. The motion capture is from mocap.cs.cmu.edu, created with
  funding from NSF EIA-0196217; only statistics of it are in this file.
- Hands: from flat to a fist, every finger with three joints of its own (the finger bones of MakeHuman's default rig).
- Differences from the thesis: {settings.shape_count} shape coefficients instead of 4, 8 pose coefficients instead of 5
  for shoulders and upper arms and 12 for hands, vertices weighted by their area and part borders by 4 more, left and
  right learned together.
- Limits: the poses are those of Anny's linear blend skinning, without muscle bulging; faces have no expression; people
  in thick clothes, children and missing limbs are outside of what was learned.
- Licence: Apache-2.0, as the package.

Intrinsic shape: {settings.shape_count} components keep {shape_share:.1f} % of the variance; what is left over is
{shape_residual:.1f} mm (root mean square).

Pose deformations, by part (border vertices count 4 times):

| part | vertices | components | variance kept, % | left over, mm RMS |
|---|---|---|---|---|
{rows}

Joints, mean distance in mm from Anny's on bodies that were not used to learn them: {joints}.

{samples}
"""
