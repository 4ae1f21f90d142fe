# SPDX-License-Identifier: Apache-2.0
"""Trees of body parts, and the part and joint names that every module uses (left and right are the person's)."""

from __future__ import annotations

from dataclasses import dataclass

DS10_PARENTS = {
    "torso": None,
    "head": "torso",
    "right_upper_arm": "torso",
    "left_upper_arm": "torso",
    "right_lower_arm": "right_upper_arm",
    "left_lower_arm": "left_upper_arm",
    "right_upper_leg": "torso",
    "left_upper_leg": "torso",
    "right_lower_leg": "right_upper_leg",
    "left_lower_leg": "left_upper_leg",
}
DS14_PARENTS = DS10_PARENTS | {
    "right_hand": "right_lower_arm",
    "left_hand": "left_lower_arm",
    "right_foot": "right_lower_leg",
    "left_foot": "left_lower_leg",
}
SP_PARENTS = {
    "torso": None,
    "head": "torso",
    "right_shoulder": "torso",
    "left_shoulder": "torso",
    "right_upper_arm": "right_shoulder",
    "left_upper_arm": "left_shoulder",
    "right_lower_arm": "right_upper_arm",
    "left_lower_arm": "left_upper_arm",
    "right_hand": "right_lower_arm",
    "left_hand": "left_lower_arm",
    "right_upper_leg": "torso",
    "left_upper_leg": "torso",
    "right_lower_leg": "right_upper_leg",
    "left_lower_leg": "left_upper_leg",
    "right_foot": "right_lower_leg",
    "left_foot": "left_lower_leg",
}


def mirrored_name(name: str) -> str:
    """Return the name of the part or joint on the other side of the body; the same name on the midline."""
    if name.startswith("left_"):
        return "right_" + name[len("left_") :]
    if name.startswith("right_"):
        return "left_" + name[len("right_") :]
    return name


@dataclass(frozen=True, slots=True)
class PartTree:
    """A rooted tree; node 0 is the root and every parent comes before its children."""

    names: tuple[str, ...]
    parents: tuple[int, ...]

    @classmethod
    def from_parents(cls, parents: dict[str, str | None]) -> PartTree:
        """Build from {name: parent's name or None}, listed root first and parents before children."""
        names = tuple(parents)
        return cls(names, tuple(-1 if parent is None else names.index(parent) for parent in parents.values()))

    def __post_init__(self) -> None:
        """Refuse anything but one root at index 0 with parents before children."""
        if len(self.names) != len(self.parents) or not self.parents or self.parents[0] != -1:
            raise ValueError(f"a part tree needs the root first and one parent per name, got {self.parents}")
        for child, parent in enumerate(self.parents[1:], start=1):
            if not 0 <= parent < child:
                raise ValueError(f"parent {parent} of node {child} does not come before it")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """(parent, child) of every edge, in the order of the children: edge e leads to node e + 1."""
        return tuple((parent, child) for child, parent in enumerate(self.parents) if parent >= 0)

    def children(self, node: int) -> tuple[int, ...]:
        """Return the nodes whose parent is `node`."""
        return tuple(child for child, parent in enumerate(self.parents) if parent == node)

    def neighbours(self, node: int) -> tuple[int, ...]:
        """Return the parent of `node`, if it has one, then its children."""
        parent = self.parents[node]
        return (() if parent < 0 else (parent,)) + self.children(node)

    def index(self, name: str) -> int:
        """Return the index of the part called `name`; ValueError if there is none."""
        return self.names.index(name)

    @property
    def mirror(self) -> tuple[int, ...]:
        """Each node's counterpart on the other side of the body (itself on the midline)."""
        return tuple(self.names.index(mirrored_name(name)) for name in self.names)
