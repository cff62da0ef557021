"""The tree that links and joints make: what each is mounted on, and an order from the base outwards."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from sms_online.description.bodies import Mount
from sms_online.description.schema import System
from sms_online.grouping import grouped

BASE = -1
PARENT = re.compile(r"base|link_(?P<number>[1-9]\d*)")


def mounts(system: System) -> tuple[Mount, ...]:
    """Joints in the order of their numbers, the fixed ones included: one for each link."""
    return (*system.joints, *system.fixed_joints)


def index_of(place: str) -> int:
    """Number from 0 of the joint or link that a place names: 2 of `joint_3`."""
    return int(place.rpartition("_")[2]) - 1


def parent_of(mount: Mount, i: int) -> int:
    """Number from 0 of the link that joint i (from 0) is mounted on, or BASE."""
    if mount.parent is None:
        return i - 1
    number = PARENT.fullmatch(mount.parent)
    assert number is not None
    return BASE if number["number"] is None else int(number["number"]) - 1


@dataclass(frozen=True)
class Tree:
    """Links by their numbers from 0; BASE denotes the base.

    parents: of each link. last: the link of the last joint that moves, which a payload is mounted on.
    """

    parents: tuple[int, ...]
    last: int

    @cached_property
    def outwards(self) -> tuple[int, ...]:
        """All links but those on a closed chain, each after its parent, with all that follow it in one run."""
        children = grouped((parent, i) for i, parent in enumerate(self.parents))
        out: list[int] = []
        waiting = children.get(BASE, [])[::-1]
        while waiting:
            out.append(waiting.pop())
            waiting += children.get(out[-1], [])[::-1]
        return tuple(out)

    @cached_property
    def ending(self) -> tuple[int, ...]:
        """Links that nothing is mounted on."""
        return tuple(i for i in range(len(self.parents)) if i not in self.parents)

    def inwards(self, i: int) -> tuple[int, ...]:
        """Links between link i and the base, the nearest to it first."""
        out: list[int] = []
        while (i := self.parents[i]) != BASE:
            out.append(i)
        return tuple(out)


def tree_of(system: System) -> Tree:
    """Tree of a system whose joints all have a parent."""
    parents = tuple(parent_of(mount, i) for i, mount in enumerate(mounts(system)))
    return Tree(parents, len(system.joints) - 1)
