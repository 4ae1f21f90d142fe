# SPDX-License-Identifier: Apache-2.0
"""Fit the Anny body to a cloud by gradients of a chamfer distance, with JAX; `flowing-puppet bench peers` runs this.

Runs in its own environment (jax, numpy, scipy). Reads an .npz with the body (rest vertices and joints as linear
functions of shape coefficients, skin weights, parents), the cloud and the true vertices; prints one JSON object with
the error of the best hypothesis, by its own chamfer distance, over processor time.

Adam optimises the rotations of all bones, position and shape from several headings at once. Closest points, both ways,
are updated by a cKDTree at every step; priors on bones and shape are weak. Compilation is not counted.
"""

import json
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

HEADINGS, PRIOR_POSE, PRIOR_SHAPE = 4, 1e-4, 1e-4  # start headings, and weights of the priors
LEARNING_RATES = 0.03, 0.003  # step size at the start and at the end, falling exponentially
ADAM_DECAY = (0.9, 0.999)


def rotation_matrices(vectors: Any) -> Any:
    """Return the rotation matrices (..., 3, 3) of axis-angle vectors (..., 3)."""
    angle = jnp.sqrt((vectors**2).sum(-1) + 1e-12)[..., None, None]
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape((*vectors.shape, 3))
    return jnp.eye(3) + jnp.sin(angle) / angle * cross + (1 - jnp.cos(angle)) / angle**2 * (cross @ cross)


def pose_body(unknowns: Any, body: Any) -> Any:
    """Return the vertices (V, 3) m of one hypothesis by linear blend skinning."""
    bones, place, shape = unknowns
    vertices = body["vertices"] + jnp.tensordot(body["vertex_basis"], shape, 1)
    heads = body["joints"] + jnp.tensordot(body["joint_basis"], shape, 1)
    local = rotation_matrices(bones)
    world, joints = [], []
    for bone, parent in enumerate(body["parents"]):
        if parent < 0:
            world.append(local[bone])
            joints.append(heads[bone] + place)
        else:
            world.append(world[parent] @ local[bone])
            joints.append(joints[parent] + world[parent] @ (heads[bone] - heads[parent]))
    rotations, offsets = jnp.stack(world), jnp.stack(joints)
    offsets = offsets - jnp.einsum("bij,bj->bi", rotations, heads)
    blended = jnp.einsum("vb,bij->vij", body["weights"], rotations)
    return jnp.einsum("vij,vj->vi", blended, vertices) + body["weights"] @ offsets


def loss(unknowns: Any, body: Any, cloud: Any, of_vertex: Any, of_point: Any) -> Any:
    """Return the two-way chamfer distance for given closest points, plus the priors."""
    vertices = pose_body(unknowns, body)
    there = ((vertices - cloud[of_vertex]) ** 2).sum(-1).mean()
    back = ((cloud - vertices[of_point]) ** 2).sum(-1).mean()
    return there + back + PRIOR_POSE * (unknowns[0][1:] ** 2).mean() + PRIOR_SHAPE * (unknowns[2] ** 2).mean()


def main(path: str, steps: int, every: int) -> None:
    """Fit and print the curve."""
    data = np.load(path)
    body = {key: jnp.asarray(data[key]) for key in ("vertices", "vertex_basis", "joints", "joint_basis", "weights")}
    body["parents"] = tuple(int(parent) for parent in data["parents"])
    cloud, truth, tree = data["cloud"], data["truth"], cKDTree(data["cloud"])
    bones = np.zeros((HEADINGS, len(body["parents"]), 3))
    bones[:, 0, 2] = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    place = np.tile(cloud.mean(axis=0) - data["vertices"].mean(axis=0), (HEADINGS, 1))
    unknowns = (jnp.asarray(bones), jnp.asarray(place), jnp.zeros((HEADINGS, data["vertex_basis"].shape[2])))
    pose = jax.jit(jax.vmap(lambda each: pose_body(each, body)))
    gradient_of = jax.jit(
        jax.vmap(jax.grad(lambda u, a, b: loss(u, body, jnp.asarray(cloud), a, b)), in_axes=(0, 0, 0))
    )
    nothing = np.zeros((HEADINGS, len(data["vertices"])), int), np.zeros((HEADINGS, len(cloud)), int)
    jax.block_until_ready((pose(unknowns), gradient_of(unknowns, *nothing)))
    first = second = jax.tree.map(jnp.zeros_like, unknowns)
    curve, started = [], time.process_time()
    for step in range(1, steps + 1):
        vertices = np.asarray(pose(unknowns))
        of_vertex = np.stack([tree.query(each)[1] for each in vertices])
        of_point = np.stack([cKDTree(each).query(cloud)[1] for each in vertices])
        if step % every == 1:
            there = np.stack([tree.query(each)[0] for each in vertices]).mean(axis=1)
            back = np.stack(
                [np.linalg.norm(cloud - v[i], axis=1) for v, i in zip(vertices, of_point, strict=True)]
            ).mean(axis=1)
            best = int(np.argmin(there + back))
            error = float(np.linalg.norm(vertices[best] - truth, axis=1).mean())
            curve.append([time.process_time() - started, error, float(there[best] + back[best]) / 2])
        slope = gradient_of(unknowns, of_vertex, of_point)
        first = jax.tree.map(lambda m, g: ADAM_DECAY[0] * m + (1 - ADAM_DECAY[0]) * g, first, slope)
        second = jax.tree.map(lambda v, g: ADAM_DECAY[1] * v + (1 - ADAM_DECAY[1]) * g * g, second, slope)
        rate = LEARNING_RATES[0] * (LEARNING_RATES[1] / LEARNING_RATES[0]) ** (step / steps)
        scale = rate * np.sqrt(1 - ADAM_DECAY[1] ** step) / (1 - ADAM_DECAY[0] ** step)
        moves = jax.tree.map(lambda m, v: m / (jnp.sqrt(v) + 1e-8), first, second)
        unknowns = tuple(old - scale * move for old, move in zip(unknowns, moves, strict=True))
    print(json.dumps({"curve": curve}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
