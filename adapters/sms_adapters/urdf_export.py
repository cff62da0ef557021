"""Estimates back into the URDF that a system file was made of: inertials, friction and damping, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sms_adapters.urdf import read_xml
from sms_online.description.bodies import RigidLink
from sms_online.description.schema import System
from sms_online.description.tree import mounts
from sms_online.effects.build import build_model
from sms_online.effects.friction import URDF_DYNAMICS
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_online.model.model import Model
from sms_online.model.parameters import SYMMETRIC
from sms_online.model.so3 import skew
from sms_online.stream import Array

# Where <dynamics> of a joint has a place for a parameter of joint_i.
DYNAMICS = {f"{name}@joint_{{}}.{part}": attribute for attribute, (name, part) in URDF_DYNAMICS.items()}


@dataclass(frozen=True)
class Exported:
    """A URDF with estimates.

    text: of it. links, joints: names of those changed. impossible: links whose inertial no body has."""

    text: str
    links: tuple[str, ...]
    joints: tuple[str, ...]
    impossible: tuple[str, ...]


def export_urdf(path: Path, system: System, estimates: Mapping[str, float]) -> Exported:
    """The URDF at `path` with estimates of the parameters of a system, by the names of results.json, SI units.

    A motion determines combinations of masses and inertias alone. Of all bodies that have the estimated ones, those are
    written that are nearest to the described ones, so that the URDF's dynamics are the estimated. Links and joints are
    found by their names. Raises InputError where the URDF has none of them, or an estimate is of no parameter.
    """
    document = read_xml(path)
    model = build_model(system)
    values = dict(zip((p.name for p in model.parameters), nearest(model, estimates), strict=True))
    links = {str(element.get("name")): element for element in document.getroot().iter("link")}
    joints = {str(element.get("name")): element for element in document.getroot().findall("joint")}
    changed, impossible = [], []
    for i, link in enumerate(system.links, start=1):
        if isinstance(link, RigidLink) and link.kind == "rigid":
            mass, center, inertia = _body(f"link_{i}", values)
            _write_inertial(_named(links, link.name, f"link_{i}", path), mass, center, inertia)
            changed.append(link.name)
            moments = np.linalg.eigvalsh(inertia)
            if mass < 0.0 or moments[0] < 0.0 or moments[2] > moments[0] + moments[1]:
                impossible.append(link.name)
    for i, mount in enumerate(mounts(system)[: len(system.joints)], start=1):
        stated = {place: values[name.format(i)] for name, place in DYNAMICS.items() if name.format(i) in values}
        if system.joints[i - 1].passive and f"joint_{i}.damping" in values:
            stated["damping"] = values[f"joint_{i}.damping"]
        if stated:
            _write_dynamics(_named(joints, mount.name, f"joint_{i}", path), stated)
    ElementTree.indent(document)
    text = ElementTree.tostring(document.getroot(), encoding="unicode", xml_declaration=True) + "\n"
    names = tuple(mount.name for mount in mounts(system)[: len(system.joints)])
    return Exported(text, tuple(changed), names, tuple(impossible))


def nearest(model: Model, estimates: Mapping[str, float]) -> Array:
    """The nearest π (n_pi,) to the nominal one that has the estimates. Distances are relative to nominal sizes."""
    base = find_base_parameters(model)
    names = [p.name for p in base.parameters]
    for name in estimates:
        if name not in names:
            raise InputError("results", name, "an estimate", "one of the parameters of this system")
    T = np.zeros((base.n, model.n_pi))
    T[np.arange(base.n), list(base.independent)] = 1.0
    T[:, list(base.dependent)] = base.mixture
    rows = [names.index(name) for name in estimates]
    wanted = np.array(list(estimates.values())) - T[rows] @ model.nominal
    scale = _sizes(model)
    return np.asarray(model.nominal + scale * (np.linalg.pinv(T[rows] * scale) @ wanted))


def _sizes(model: Model) -> Array:
    """Usual size (n_pi,) of each parameter: the largest nominal one of its unit, or 1 in SI units."""
    units = [p.unit for p in model.parameters]
    largest = {unit: max(abs(p.nominal) for p in model.parameters if p.unit == unit) for unit in units}
    return np.array([largest[unit] or 1.0 for unit in units])


def _body(owner: str, values: Mapping[str, float]) -> tuple[float, Array, Array]:
    """Mass, centre of mass (3,) and inertia about it (3, 3) of a link."""
    mass = values[f"{owner}.mass"]
    moment = np.array([values[f"{owner}.first_moment_{axis}"] for axis in "xyz"])
    inertia = np.zeros((3, 3))
    for key, (a, b) in SYMMETRIC.items():
        inertia[a, b] = inertia[b, a] = values[f"{owner}.inertia_{key}"]
    center = moment / mass if mass != 0.0 else np.zeros(3)
    return mass, center, inertia + mass * skew(center) @ skew(center)


def _named(elements: Mapping[str, Any], name: str, place: str, path: Path) -> Any:
    if name not in elements:
        raise InputError(str(path), place, f"nothing named {name!r}", "the URDF that the system file was made of")
    return elements[name]


def _write_inertial(link: Any, mass: float, center: Array, inertia: Array) -> None:
    old = link.find("inertial")
    if old is not None:
        link.remove(old)
    inertial = ElementTree.Element("inertial")
    link.insert(0, inertial)
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    ElementTree.SubElement(inertial, "origin", xyz=" ".join(repr(float(c)) for c in center), rpy="0 0 0")
    attributes = {f"i{key}": repr(float(inertia[at])) for key, at in SYMMETRIC.items()}
    ElementTree.SubElement(inertial, "inertia", attributes)


def _write_dynamics(joint: Any, stated: Mapping[str, float]) -> None:
    dynamics = joint.find("dynamics")
    if dynamics is None:
        dynamics = ElementTree.SubElement(joint, "dynamics")
    for place, value in stated.items():
        dynamics.set(place, repr(float(value)))
