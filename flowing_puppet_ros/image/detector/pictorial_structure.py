# SPDX-License-Identifier: Apache-2.0
"""Exact max-product on a tree of part filters over a grid: distance transforms up and down the tree, best placements.

Y. Yang and D. Ramanan: Articulated Human Detection with Flexible Mixtures of Parts, PAMI 2013, and P. F. Felzenszwalb
and D. P. Huttenlocher: Distance Transforms of Sampled Functions, 2012. A part has a type and a cell (x, y); a
placement scores the filter responses plus, for every child, `bias[child type, parent type]` less its spring.
All layers (types of parts) are stacked: layers first[i] to first[i + 1] are the types of part i. Parents come before
their children.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from flowing_puppet_ros.arrays import F32, I64

LOWEST_SCORE = np.float32(-1e9)  # of a message before any layer is considered


@dataclass(frozen=True, slots=True, eq=False)
class FilterTree:
    """P parts with L layers in all.

    Attributes:
        parents: (P,), -1 for the root, which is part 0.
        first: (P + 1,) first layer of each part.
        anchor: (L, 2) offset of a part of this type from its parent, in cells (x, y).
        spring: (L, 2) cost of a squared cell of deviation along x and y.
        bias: (L, T) of a layer and the type of its parent, T being the maximum number of types of a part; the first
            column holds the bias of the root's layers.
    """

    parents: I64
    first: I64
    anchor: F32
    spring: F32
    bias: F32


@dataclass(frozen=True, slots=True, eq=False)
class MaxMarginals:
    """The result of the passes; `up + down` are the max-marginals.

    Attributes:
        up: (L, H, W) unary scores plus the messages of the children.
        message: (P, T, H, W) of each part to its parent's types.
        down: (L, H, W) messages from the parents; None before the downward pass.
    """

    up: F32
    message: F32
    down: F32 | None


def pass_up(tree: FilterTree, unary: F32) -> MaxMarginals:
    """Pass messages from the leaves to the root for the layers' scores `unary` (L, H, W)."""
    up = unary.copy()
    types = tree.bias.shape[1]
    message = np.full((len(tree.parents), types, *unary.shape[1:]), LOWEST_SCORE, np.float32)
    _send_up(tree.parents, tree.first, tree.anchor, tree.spring, tree.bias, up, message)
    return MaxMarginals(up, message, None)


def pass_down(tree: FilterTree, beliefs: MaxMarginals) -> MaxMarginals:
    """Add the messages from the root to the leaves; `up + down` are then the max-marginals of every layer."""
    down = np.zeros_like(beliefs.up)
    _send_down(tree.parents, tree.first, tree.anchor, tree.spring, tree.bias, beliefs.up, beliefs.message, down)
    return MaxMarginals(beliefs.up, beliefs.message, down)


def find_best_placement(tree: FilterTree, beliefs: MaxMarginals, fixed: tuple[int, int, int, int] | None = None) -> I64:
    """Return the best placement (P, 3): layer, x, y of every part.

    With `fixed` (part, layer, x, y) return the best one with that part there; this needs the downward pass.
    """
    placement = np.full((len(tree.parents), 3), -1, np.int64)
    down = np.zeros((0, 0, 0), np.float32) if beliefs.down is None else beliefs.down
    if fixed is None:
        root = beliefs.up[: tree.first[1]]
        layer, y, x = np.unravel_index(int(root.argmax()), root.shape)
        placement[0] = layer, x, y
    else:
        placement[fixed[0]] = fixed[1:]
        _trace_up(
            fixed[0],
            tree.parents,
            tree.first,
            tree.anchor,
            tree.spring,
            tree.bias,
            beliefs.up,
            beliefs.message,
            down,
            placement,
        )
    _trace_down(tree.parents, tree.first, tree.anchor, tree.spring, tree.bias, beliefs.up, placement)
    return placement


def score_placement(tree: FilterTree, unary: F32, placement: I64) -> float:
    """Return the score of a placement (P, 3)."""
    layer, x, y = placement.T
    total = float(unary[layer, y, x].sum())
    total += float(tree.bias[layer[0], 0])
    for part in range(1, len(layer)):
        parent = tree.parents[part]
        off = placement[part, 1:] - placement[parent, 1:] - tree.anchor[layer[part]]
        total += float(tree.bias[layer[part], layer[parent] - tree.first[parent]])
        total -= float(tree.spring[layer[part]] @ (off * off))
    return total


@njit(cache=True, nogil=True)
def distance_transform(scores: F32, anchor: F32, spring: F32, out: F32) -> None:
    """Set out[y, x] to the maximum over (v, u) of scores[v, u] - sx (u - x - ax)^2 - sy (v - y - ay)^2.

    `scores` and `out` (H, W); `anchor` a and `spring` s (2,), along x and y. All shifts are tried, whole images at a
    time: on grids of a few thousand cells this is many times faster than the envelope of parabolas.
    """
    height, width = scores.shape
    transposed, moved = np.empty((width, height), np.float32), np.empty((width, height), np.float32)
    for y in range(height):
        for x in range(width):
            transposed[x, y] = scores[y, x]
    _transform_rows(transposed, anchor[0], spring[0], moved)
    along_x = np.empty((height, width), np.float32)
    for x in range(width):
        for y in range(height):
            along_x[y, x] = moved[x, y]
    _transform_rows(along_x, anchor[1], spring[1], out)


@njit(cache=True, nogil=True)
def _transform_rows(values: F32, anchor: float, spring: float, out: F32) -> None:
    """Set out[y] to the maximum over v of values[v] - spring (v - y - anchor)^2, for whole rows."""
    height, width = values.shape
    flat, target = values.reshape(-1), out.reshape(-1)
    lowest = highest = flat[0]
    for value in flat:
        lowest, highest = min(lowest, value), max(highest, value)
    target[:] = np.float32(-np.inf)
    # A row whose anchor lies inside the grid can do with this cost, so costlier shifts cannot win there.
    max_cost = highest - lowest + np.float32(0.25) * spring
    for shift in range(1 - height, height):
        off = anchor - np.float32(shift)
        cost = np.float32(spring * off * off)
        begin, end = max(0, -shift), min(height, height - shift)
        if cost > max_cost:
            if anchor < 0:
                end = min(end, int(np.ceil(-anchor)))
            else:
                begin = max(begin, int(np.floor(height - 1 - anchor)) + 1)
        if begin < end:
            first = (begin + shift) * width
            _keep_larger(target[begin * width : end * width], flat[first : first + (end - begin) * width], -cost)


@njit(cache=True, nogil=True)
def _send_up(parents: I64, first: I64, anchor: F32, spring: F32, bias: F32, up: F32, message: F32) -> None:
    height, width = up.shape[1:]
    moved = np.empty((height, width), np.float32)
    for layer in range(first[1]):
        up[layer] += bias[layer, 0]
    for part in range(len(parents) - 1, 0, -1):
        parent = parents[part]
        for layer in range(first[part], first[part + 1]):
            distance_transform(up[layer], anchor[layer], spring[layer], moved)
            for type_ in range(first[parent + 1] - first[parent]):
                _keep_larger(message[part, type_].reshape(-1), moved.reshape(-1), bias[layer, type_])
        for type_ in range(first[parent + 1] - first[parent]):
            up[first[parent] + type_] += message[part, type_]


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _keep_larger(target: F32, values: F32, add: float) -> None:
    more = np.float32(add)
    for i in range(target.size):
        value, kept = values[i] + more, target[i]
        target[i] = value if value > kept else kept


@njit(cache=True, nogil=True)
def _send_down(
    parents: I64,
    first: I64,
    anchor: F32,
    spring: F32,
    bias: F32,
    up: F32,
    message: F32,
    down: F32,
) -> None:
    height, width = up.shape[1:]
    for part in range(1, len(parents)):
        parent = parents[part]
        start, count = first[parent], first[parent + 1] - first[parent]
        rest = up[start : start + count] + down[start : start + count] - message[part, :count]
        best = np.empty((height, width), np.float32)
        for layer in range(first[part], first[part + 1]):
            best[:] = LOWEST_SCORE
            for type_ in range(count):
                _keep_larger(best.reshape(-1), rest[type_].reshape(-1), bias[layer, type_])
            distance_transform(best, -anchor[layer], spring[layer], down[layer])


@njit(cache=True, nogil=True)
def _trace_up(
    start: int,
    parents: I64,
    first: I64,
    anchor: F32,
    spring: F32,
    bias: F32,
    up: F32,
    message: F32,
    down: F32,
    placement: I64,
) -> None:
    """Place the ancestors of a placed part, each the best given its placed child."""
    part = start
    while parents[part] >= 0:
        parent = parents[part]
        layer, x, y = placement[part]
        best = np.float32(-np.inf)
        for type_ in range(first[parent + 1] - first[parent]):
            above = first[parent] + type_
            rest = up[above] + down[above] - message[part, type_]
            found, v, u = _find_best_cell(rest, x - anchor[layer, 0], y - anchor[layer, 1], spring[layer])
            found += bias[layer, type_]
            if found > best:
                best = found
                placement[parent, 0], placement[parent, 1], placement[parent, 2] = above, u, v
        part = parent


@njit(cache=True, nogil=True)
def _trace_down(parents: I64, first: I64, anchor: F32, spring: F32, bias: F32, up: F32, placement: I64) -> None:
    """Place every part that is not placed yet, each the best given its parent."""
    for part in range(1, len(parents)):
        if placement[part, 0] >= 0:
            continue
        parent = parents[part]
        above, x, y = placement[parent]
        type_ = above - first[parent]
        best = np.float32(-np.inf)
        for layer in range(first[part], first[part + 1]):
            found, v, u = _find_best_cell(up[layer], x + anchor[layer, 0], y + anchor[layer, 1], spring[layer])
            found += bias[layer, type_]
            if found > best:
                best = found
                placement[part, 0], placement[part, 1], placement[part, 2] = layer, u, v


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _find_best_cell(scores: F32, x: float, y: float, spring: F32) -> tuple[np.float32, int, int]:
    """Return the maximum of scores[v, u] - sx (u - x)^2 - sy (v - y)^2, and its v and u."""
    height, width = scores.shape
    line, along = np.empty(width, np.float32), np.empty(width, np.float32)
    for u in range(width):
        off = np.float32(u) - np.float32(x)
        along[u] = spring[0] * off * off
    best, best_v, best_u = np.float32(-np.inf), 0, 0
    for v in range(height):
        off = np.float32(v) - np.float32(y)
        penalty = spring[1] * off * off
        row = scores[v]
        highest = np.float32(-np.inf)
        for u in range(width):
            line[u] = row[u] - along[u] - penalty
            highest = line[u] if line[u] > highest else highest
        if highest > best:
            best, best_v, best_u = highest, v, int(np.argmax(line))
    return best, best_v, best_u
