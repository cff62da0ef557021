"""Whether joints and links make a tree, and links have a length where something is mounted on them."""

from __future__ import annotations

import math

import numpy as np

from sms_online.description.bodies import Inertia, Mount, RigidLink
from sms_online.description.schema import System
from sms_online.description.tree import PARENT, mounts, parent_of, tree_of
from sms_online.errors import InputError
from sms_online.model.so3 import RotationVector

# Sine of the angle between two axes below which they are one.
SAME_AXIS = 1e-6


def check_tree(system: System, source: str) -> None:
    """Parents that are there, and no closed chain: from every link a way leads to the base."""
    last, planar = len(system.links), system.motion == "planar"
    for i, mount in enumerate(mounts(system), start=1):
        if mount.parent is None and i > len(system.joints):
            raise InputError(source, f"joint_{i}.parent", "missing", "'base' or 'link_i', what it attaches to")
        if mount.parent is not None and (PARENT.fullmatch(mount.parent) is None or parent_of(mount, i - 1) >= last):
            raise InputError(source, f"joint_{i}.parent", repr(mount.parent), f"'base' or one of link_1 to link_{last}")
        if planar:
            _check_planar(f"joint_{i}", mount, source)
    tree = tree_of(system)
    for i in range(last):
        if i not in tree.outwards:
            way = [i]
            while way[-1] not in way[:-1]:
                way.append(tree.parents[way[-1]])
            closed = way[way.index(way[-1]) :]
            found = f"a closed chain, {' on '.join(f'link_{k + 1}' for k in closed)}"
            expected = "a tree: every joint on the base, or on a link that is mounted nearer to it"
            raise InputError(source, f"joint_{closed[0] + 1}.parent", found, expected)


def _check_planar(place: str, mount: Mount, source: str) -> None:
    if mount.mount_position[2] != 0.0:
        expected = "a point in the x-y plane in planar motion"
        raise InputError(source, f"{place}.mount_position", f"{list(mount.mount_position)}", expected)
    if mount.mount_rotation[:2] != (0.0, 0.0):
        expected = "a turn about z alone in planar motion"
        raise InputError(source, f"{place}.mount_rotation", f"{list(mount.mount_rotation)}", expected)


def check_tips(system: System, source: str) -> None:
    """Rigid links that a moving joint is mounted on end elsewhere than they begin, unless two axes meet there."""
    for i, link in enumerate(system.links):
        if not isinstance(link, RigidLink):
            continue
        if link.kind == "cross":
            _check_cross(i, link, system, source)
        if any(link.tip) or i >= len(system.joints):
            continue
        for k, parent in enumerate(tree_of(system).parents[: len(system.joints)]):
            if parent == i and not any(system.joints[k].mount_position):
                _check_meeting(system, i, k, source)


def _check_cross(i: int, link: RigidLink, system: System, source: str) -> None:
    if link.mass or any(link.tip) or any(link.center_of_mass) or link.inertia != Inertia():
        raise InputError(source, f"link_{i + 1}", "a cross with mass or length", "neither, or kind = 'rigid'")
    if i >= len(system.joints) or i not in tree_of(system).parents:
        raise InputError(source, f"link_{i + 1}.kind", "'cross'", "a cross between two joints that move")


def _check_meeting(system: System, i: int, k: int, source: str) -> None:
    """Joint k on link i (both from 0), which has no length."""
    link, own, other = system.links[i], system.joints[i], system.joints[k]
    place = f"link_{i + 1}.tip"
    if link.kind == "rigid" and "tip" not in link.model_fields_set:
        expected = f"where joint_{k + 1} is mounted, m; [0, 0, 0] only where its axis meets that of joint_{i + 1}"
        raise InputError(source, place, "missing, so the link's tip is its origin", expected)
    turned = RotationVector(np.array(other.mount_rotation)).matrix @ other.axis
    if own.kind == other.kind and math.hypot(*np.cross(own.axis, turned)) < SAME_AXIS:
        found = f"the link's origin, which gives joint_{i + 1} and joint_{k + 1} one axis"
        raise InputError(source, place, found, f"where joint_{k + 1} is mounted, m")
