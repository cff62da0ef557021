"""URDFs of real arms in and out, against Pinocchio's own parser and inverse dynamics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from sms_adapters.urdf import import_urdf
from sms_adapters.urdf_export import export_urdf
from sms_online.description.parse import describe, parse_system
from sms_online.description.schema import System
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.model.base_parameters import find_base_parameters
from sms_online.stream import Array
from sms_tools.cli import main
from tests.model_systems import random_states

pin: Any = pytest.importorskip("pinocchio", reason="Pinocchio (pip package `pin`) is the yardstick of URDFs")
pytest.importorskip("yourdfpy", reason="URDFs are read by yourdfpy (the extra `urdf`)")

FOLDER = Path(__file__).parent / "urdf"
ARMS = ("ur10e", "tx40", "panda")
RELATIVE = 1e-9
all_arms = pytest.mark.parametrize("arm", ARMS)


def described(path: Path) -> System:
    """System of a URDF."""
    return parse_system(import_urdf(path), path.name)


def names_in(path: Path, tag: str) -> list[str]:
    """Names of a URDF's links or joints, in order."""
    return [str(element.get("name")) for element in ElementTree.parse(path).getroot().findall(tag)]


def torques(path: Path, names: list[str], q: Array, v: Array, a: Array) -> Array:
    """Pinocchio's inverse dynamics (B, joints) of a URDF, joints in the order of `names`."""
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_v for name in names]
    assert model.nv == len(names)
    out = np.zeros_like(q)
    for b in range(len(q)):
        there = np.zeros((3, model.nv))
        there[:, order] = q[b], v[b], a[b]
        out[b] = pin.rnea(model, data, *there)[order]
    return out


def without_friction(system: System) -> System:
    """Pinocchio's inverse dynamics leave friction out."""
    return system.model_copy(update={"effects": ()})


def assert_dynamics(system: System, path: Path, pi: Array | None = None) -> None:
    """Our inverse dynamics are Pinocchio's of a URDF, for parameters π, the nominal ones unless given."""
    model = build_model(without_friction(system))
    x, v = random_states(model.layout, 5, seed=40)
    a = np.random.default_rng(41).normal(size=v.shape)
    H, C = model.dynamics(model.nominal if pi is None else pi).mass_and_bias(x, v)
    ours = (H @ a[..., None])[..., 0] + C
    theirs = torques(path, [joint.name for joint in system.joints], x, v, a)
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=RELATIVE * np.abs(theirs).max())


@all_arms
def test_inverse_dynamics_are_pinocchios(arm: str) -> None:
    path = FOLDER / f"{arm}.urdf"
    assert_dynamics(described(path), path)


@all_arms
def test_names_and_friction_are_kept(arm: str) -> None:
    path = FOLDER / f"{arm}.urdf"
    system = described(path)
    elements = ElementTree.parse(path).getroot().findall("joint")
    moving = [str(element.get("name")) for element in elements if element.get("type") != "fixed"]
    assert [joint.name for joint in system.joints] == moving
    children = {str(e.get("name")): str(e.find("child").get("link")) for e in elements}  # type: ignore[union-attr]
    every = (*system.joints, *system.fixed_joints)
    assert [link.name for link in system.links] == [children[joint.name] for joint in every]
    if arm == "tx40":
        assert {e.name for e in system.effects} == {"viscous_friction", "coulomb_friction"}
        assert system.effects[0].coefficients == {"damping": 8.05}


@all_arms
def test_a_round_trip_keeps_dynamics_and_names(arm: str, tmp_path: Path) -> None:
    path, written = FOLDER / f"{arm}.urdf", tmp_path / "again.urdf"
    system = described(path)
    model = build_model(system)
    base = find_base_parameters(model)
    values = zip((p.name for p in base.parameters), base.values(model.nominal).tolist(), strict=True)
    exported = export_urdf(path, system, dict(values))
    written.write_text(exported.text)
    for tag in ("link", "joint"):
        assert names_in(written, tag) == names_in(path, tag)
    assert_dynamics(system, written)
    assert_dynamics(described(written), path)
    assert [e.coefficients for e in described(written).effects] == [e.coefficients for e in system.effects]


@all_arms
def test_estimates_become_the_dynamics_of_the_urdf(arm: str, tmp_path: Path) -> None:
    """What is estimated are combinations; the bodies that are written have them, within 1e-9 in every torque."""
    path, written = FOLDER / f"{arm}.urdf", tmp_path / "estimated.urdf"
    system = without_friction(described(path))
    model = build_model(system)
    base = find_base_parameters(model)
    pi = model.nominal * np.random.default_rng(42).uniform(0.97, 1.03, size=model.n_pi)
    estimates = zip((p.name for p in base.parameters), base.values(pi).tolist(), strict=True)
    written.write_text(export_urdf(path, system, dict(estimates)).text)
    assert_dynamics(system, written, pi)
    with pytest.raises(AssertionError):
        assert_dynamics(system, path, pi)


def test_the_command_line_imports_and_exports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, system, results = FOLDER / "tx40.urdf", tmp_path / "tx40.toml", tmp_path / "results.json"
    assert main(["import", "urdf", str(source), "--out", str(system)]) == 0
    assert main(["import", "urdf", str(source), "--out", str(system)]) == 2
    model = build_model(parse_system(system.read_text(), "tx40.toml"))
    base = find_base_parameters(model)
    estimate = 1.02 * base.values(model.nominal)[0]
    leading = {"name": base.parameters[0].name, "estimate": estimate, "identifiable": True}
    unknown = {"name": base.parameters[1].name, "estimate": 9.0, "identifiable": False}
    results.write_text(json.dumps({"system": describe(model.system), "parameters": [leading, unknown]}))
    out = tmp_path / "new.urdf"
    capsys.readouterr()
    assert main(["export", "urdf", str(source), "--results", str(results), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["links"] == [f"link_{i}" for i in range(1, 7)]
    again = build_model(parse_system(import_urdf(out), "new.urdf"))
    assert find_base_parameters(again).values(again.nominal)[0] == pytest.approx(estimate, rel=1e-9)
    assert main(["export", "urdf", str(FOLDER / "panda.urdf"), "--results", str(results), "--out", str(out)]) == 2
    capsys.readouterr()
    for verb in (["import", "urdf", str(source)], ["export", "urdf", str(source), "--results", str(results)]):
        assert main([*verb, "--out", "/proc/new.toml"]) == 2
        assert (
            "/proc/new.toml: No such file or directory; expected a file that can be written" in capsys.readouterr().err
        )


def test_an_inertial_that_no_body_has_is_named() -> None:
    path = FOLDER / "tx40.urdf"
    system = described(path)
    name = find_base_parameters(build_model(system)).parameters[0].name
    assert export_urdf(path, system, {name: 100.0}).impossible


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><mimic joint="joint_2"/>', "joint 'joint_1': mimics 'joint_2'"),
        ('<child link="link_6"/>', '<child link="link_2"/>', "joint 'joint_6': a closed chain: link 'link_2'"),
        ('"joint_6" type="revolute"', '"joint_6" type="floating"', "joint 'joint_6': type 'floating'"),
        ('<child link="link_6"/>', '<child link="link_9"/>', "one root link"),
        ("<robot", "<robt", "mismatched tag"),
        ("<!--", "<!-", "not well-formed"),
        ('ixx="0.055"', 'ixx="0.155"', "link_1.inertia: principal moments"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "joint_1.axis: [0.0, 0.0, 0.0] of length 0"),
    ],
)  # fmt: skip
def test_a_urdf_that_is_no_tree_of_bodies_is_refused(old: str, new: str, words: str, tmp_path: Path) -> None:
    text = (FOLDER / "tx40.urdf").read_text()
    assert old in text
    path = tmp_path / "arm.urdf"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        import_urdf(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
