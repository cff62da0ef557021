"""A URDF as a system file: bodies, joints and their names; what a URDF does not hold is marked to be completed.

Read by yourdfpy, which keeps every link and joint with its name, fixed ones included (Pinocchio's parser merges them).
Format: wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from sms_adapters.extras import installed
from sms_adapters.files import reading
from sms_adapters.raw import one_line
from sms_online.description.parse import parse_system
from sms_online.effects.friction import URDF_DYNAMICS
from sms_online.errors import InputError
from sms_online.model.parameters import SYMMETRIC
from sms_online.stream import Array

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
# Positions and directions are exact to what double precision leaves of sines and cosines of typed angles.
ROUNDING = 1e-15
HEADER = """\
# {name}: made of {file}. Masses, lengths and axes are the URDF's; its frame {{0}} is that of {root}.
#
# To be completed, since a URDF has no place for it:
#  - drives: gear_ratio of each joint, [motor_i] with its mass and rotor_inertia;
#  - flexible joints: transmission = "flexible", stiffness (N m/rad) and damping (N m s/rad) in place of "rigid";
#  - flexible links: in place of [link_i] a table like that at the end of this file;
#  - sensors, and for a simulation [controller] and [trajectory].
"""
FOOTER = """
# A flexible link in place of a rigid one, along x of its frame from root_position on:
# [link_i]
# name = "…"
# kind = "flexible"
# root_position = [0.0, 0.0, 0.0] # bracket between joint i and the link's root, m
# root_rotation = [0.0, 0.0, 0.0] # rotation vector that turns x along the link, rad
# length = …                      # m
# elements = 2                    # a marker at the end of each
# mass_per_length = …             # kg/m
# polar_inertia_per_length = …    # kg m
# flexural_rigidity_y = …         # N m²
# flexural_rigidity_z = …
# torsional_rigidity = …
# deformations = ["bending_y", "bending_z", "torsion"]
# A joint that was mounted at the rigid link's tip is mounted at the flexible link's end: see its mount_position.
"""


@dataclass(frozen=True)
class Body:
    """A link's inertial, in the link's axes: mass, kg; center (3,), m; inertia about it (3, 3), kg m²."""

    mass: float
    center: Array
    inertia: Array


@dataclass(frozen=True)
class Placed:
    """A joint of the system file with its link: what it is mounted on (None: the base), and where (4, 4)."""

    joint: Any
    parent: str | None
    origin: Array
    body: Body


def import_urdf(path: Path) -> str:
    """Text of a system file for a URDF, checked as any other.

    The base is fixed; its table [spacecraft] comes as a comment. Fixed links without mass, as tool frames, and those on
    the base become part of what they sit on. Raises InputError where the URDF cannot be read, where a joint mimics
    another or closes a chain, and where a body is impossible.
    """
    robot = _read(path)
    root, placed = _tree(robot, str(path))
    text = _text(robot.name, path.name, root, placed)
    parse_system(text, str(path))
    return text


def _read(path: Path) -> Any:
    yourdfpy = installed("yourdfpy", str(path), extra="urdf")
    read_xml(path)  # yourdfpy repairs what is no XML as it thinks best
    try:
        return yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # of many kinds, for numbers that are none and elements that are missing
        raise InputError(str(path), "", one_line(error), "a URDF") from None


def read_xml(path: Path) -> ElementTree.ElementTree[ElementTree.Element]:
    """A URDF's elements and comments; InputError where it is none."""
    try:
        builder = ElementTree.TreeBuilder(insert_comments=True)
        with reading(path, "a readable URDF"):
            document = ElementTree.parse(path, parser=ElementTree.XMLParser(target=builder))
    except ElementTree.ParseError as error:
        raise InputError(str(path), "", str(error), "a URDF") from None
    root = document.getroot()
    if root is None or root.tag != "robot":
        raise InputError(str(path), "", f"<{'' if root is None else root.tag}>", "a URDF, whose root is <robot>")
    return document


def _tree(robot: Any, source: str) -> tuple[Any, list[Placed]]:
    """The root link, and the joints that the system file has, parents first: those that move, then the fixed ones."""
    children: dict[str, list[Any]] = {}
    joint_above: dict[str, str] = {}
    for joint in robot.joints:
        place = f"joint {joint.name!r}"
        if joint.type not in (*MOVING, "fixed"):
            expected = "revolute, continuous, prismatic or fixed"
            raise InputError(source, place, f"type {joint.type!r}", expected)
        if joint.mimic is not None:
            found = f"mimics {joint.mimic.joint!r}"
            raise InputError(source, place, found, "a joint that moves by itself; make it fixed, or take the mimic out")
        if joint.child in joint_above:
            found = f"a closed chain: link {joint.child!r} is the child of {joint_above[joint.child]!r} too"
            raise InputError(source, place, found, "a tree: one joint above each link")
        joint_above[joint.child] = joint.name
        children.setdefault(joint.parent, []).append(joint)
    links = {link.name: link for link in robot.links}
    roots = [link for name, link in links.items() if name not in joint_above]
    if len(roots) != 1 or not any(joint.type in MOVING for joint in robot.joints):
        found = f"{len(roots)} links without a joint above" if len(roots) != 1 else "no joint that moves"
        raise InputError(source, "links", found, "one root link, and a joint that moves")
    out = list(_placed(roots[0].name, None, np.eye(4), children, links, source))
    return roots[0], [each for kind in (True, False) for each in out if (each.joint.type in MOVING) == kind]


def _placed(
    link: str, kept: str | None, pose: Array, children: dict[str, list[Any]], links: dict[str, Any], source: str
) -> Iterator[Placed]:
    """Joints above all that follows a link, which sits at `pose` (4, 4) in the frame of the link `kept`."""
    for joint in children.get(link, []):
        if joint.child not in links:
            raise InputError(source, f"joint {joint.name!r}", f"child {joint.child!r}", "a link of this URDF")
        origin = pose @ (np.eye(4) if joint.origin is None else joint.origin)
        body = body_of(links[joint.child])
        if joint.type in MOVING or (body.mass > 0.0 and kept is not None):
            yield Placed(joint, kept, origin, body)
            yield from _placed(joint.child, joint.child, np.eye(4), children, links, source)
        else:
            yield from _placed(joint.child, kept, origin, children, links, source)


def body_of(link: Any) -> Body:
    """Inertial of a URDF's link in the link's axes; none is no mass."""
    inertial = link.inertial
    if inertial is None:
        return Body(0.0, np.zeros(3), np.zeros((3, 3)))
    origin = np.eye(4) if inertial.origin is None else inertial.origin
    R = origin[:3, :3]
    inertia = np.zeros((3, 3)) if inertial.inertia is None else R @ inertial.inertia @ R.T
    mass, center = float(inertial.mass or 0.0), origin[:3, 3]
    # Rounding of a shift by m c² or of a rotation may leave a negative element, which is refused, in place of a zero.
    inertia[np.abs(inertia) <= 1e-12 * (np.trace(inertia) + mass * center @ center)] = 0.0
    return Body(mass, center, inertia)


def _text(name: str, file: str, root: Any, placed: Sequence[Placed]) -> str:
    number = {each.joint.child: i for i, each in enumerate(placed, start=1)}
    tips = _tips(placed)
    lines = [HEADER.format(name=name, file=file, root=root.name), f"name = {json.dumps(name or Path(file).stem)}"]
    lines += ['motion = "spatial"', "gravity = [0.0, 0.0, -9.81] # m/s², along -z of the root; 0 in orbit"]
    lines += ["sample_rate = 1000.0 # to be completed: samples/s of the log or the bus"]
    lines += ["", *_spacecraft(root)] if body_of(root).mass > 0.0 else []
    carrying = {each.parent for each in placed if each.joint.type in MOVING}
    for i, each in enumerate(placed, start=1):
        parent = "base" if each.parent is None else f"link_{number[each.parent]}"
        tip = np.zeros(3) if each.parent is None else tips[each.parent]
        lines += ["", *_joint(i, each, parent, each.origin[:3, 3] - tip), "", f"[link_{i}]"]
        lines += _link(each, tips[each.joint.child], carrying)
    lines += _friction(placed)
    return "\n".join(lines) + "\n" + FOOTER


def _tips(placed: Iterable[Placed]) -> dict[str, Array]:
    """Tip of each link: where the first joint that moves, or else the first fixed one, is mounted on it."""
    out: dict[str, Array] = {}
    for each in placed:
        out.setdefault(each.joint.child, np.zeros(3))
    mounted: set[str] = set()
    for each in placed:
        if each.parent is not None and each.parent not in mounted:
            mounted.add(each.parent)
            out[each.parent] = each.origin[:3, 3]
    return out


def _spacecraft(root: Any) -> list[str]:
    body = body_of(root)
    lines = ["[spacecraft]", f"mass = {body.mass!r}", f"center_of_mass = {_vector(body.center)}"]
    lines += [f"inertia = {_inertia(body.inertia)}", "tracked_point = [0.0, 0.0, 0.0]"]
    return ["# The base is fixed. For a free one:", *(f"# {line}" for line in lines)]


def _joint(i: int, each: Placed, parent: str, position: Array) -> list[str]:
    joint = each.joint
    lines = [f"[joint_{i}]", f"name = {json.dumps(joint.name)}", f'kind = "{MOVING.get(joint.type, "fixed")}"']
    lines += [f'parent = "{parent}"']
    if np.abs(position).max() > ROUNDING:
        lines.append(f"mount_position = {_vector(position)}")
    turn = Rotation.from_matrix(each.origin[:3, :3]).as_rotvec()
    if np.abs(turn).max() > ROUNDING:
        lines.append(f"mount_rotation = {_vector(turn)}")
    if joint.type in MOVING:
        axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=float)
        length = float(np.linalg.norm(axis))
        lines.append(f"axis = {_vector(axis / length if length > 0.0 else axis)}")
        lines.append('transmission = "rigid" # to be completed: "flexible", with stiffness and damping, if it is')
    return lines


def _link(each: Placed, tip: Array, carrying: set[str | None]) -> list[str]:
    body, name = each.body, f"name = {json.dumps(each.joint.child)}"
    if each.joint.type in MOVING and each.joint.child in carrying and body.mass == 0.0 and not tip.any():
        return [name, 'kind = "cross"']
    lines = [name, 'kind = "rigid"', f"mass = {body.mass!r}", f"center_of_mass = {_vector(body.center)}"]
    return [*lines, f"inertia = {_inertia(body.inertia)}", f"tip = {_vector(tip)}"]


def _friction(placed: Iterable[Placed]) -> list[str]:
    """What <dynamics> states of the joints, as effects."""
    lines: list[str] = []
    for i, each in enumerate(placed, start=1):
        dynamics = each.joint.dynamics
        if dynamics is None or each.joint.type not in MOVING:
            continue
        for attribute, (name, coefficient) in URDF_DYNAMICS.items():
            value = getattr(dynamics, attribute)
            if float(value or 0.0) > 0.0:
                lines += ["", "[[effect]]", f'name = "{name}"', f'where = "joint_{i}"']
                lines.append(f"coefficients = {{ {coefficient} = {float(value)!r} }}")
    return lines


def _vector(values: Array) -> str:
    return f"[{', '.join(repr(float(v) + 0.0) for v in values)}]"


def _inertia(inertia: Array) -> str:
    return f"{{ {', '.join(f'{key} = {float(inertia[at])!r}' for key, at in SYMMETRIC.items())} }}"
