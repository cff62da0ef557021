"""What effects say of themselves, so that no other module asks for one by name."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sms_online.description.schema import Effect
from sms_online.diagnosis.constants import is_constant
from sms_online.effects import catalogue
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import BEGINNING, CLASSES, ENTRIES, NAMES, candidates
from tests.model_systems import paper

ROOT = Path(__file__).parent.parent
OUTSIDE = sorted(
    path
    for folder in ("sms_online", "adapters/sms_adapters", "sim/sms_sim", "tools/sms_tools")
    for path in (ROOT / folder).rglob("*.py")
    if path.parent.name != "effects"
)


def plausible(name: str, coefficient: float, sample_rate: float = 1000.0) -> bool:
    return ENTRIES[name].traits.plausible(np.array([coefficient]), sample_rate)


def test_what_takes_power_out_has_no_negative_coefficient() -> None:
    for name in ("coulomb_friction", "link_damping", "air_drag", "tip_payload", "backlash"):
        assert plausible(name, 0.1)
        assert not plausible(name, -0.1)
    assert plausible("cubic_stiffness", -100.0)


def test_a_gain_is_between_an_error_and_all_of_a_torque() -> None:
    assert plausible("torque_gain", -0.02)
    assert not plausible("torque_gain", -1.0)
    # No torque is known to this.
    assert not plausible("torque_gain", 2e-4)


def test_a_zero_is_off_by_less_than_a_turn() -> None:
    # A coordinate that nothing depends on fits any size.
    assert plausible("encoder_offset", -3.0)
    assert not plausible("encoder_offset", -2e6)


def test_what_a_held_command_does_is_no_sensor_s_lag() -> None:
    assert not plausible("sensor_lag", 4e-4)
    assert plausible("sensor_lag", 4e-4, sample_rate=2000.0)
    assert not plausible("actuator_delay", 4e-4)


def test_a_force_reverses_where_it_follows_its_rate_s_sign() -> None:
    """What differs at opposite rates jumps, or its slope does, unless it follows the rate; what is dry lasts."""
    joints = [each for each in candidates(paper()) if each.where == "joint_1" and ENTRIES[each.name].kind == "force"]
    for declared in joints:
        model = build_model(paper(effects=(declared,)))
        effect, layout = model.effects[0], model.layout
        if effect.needs_torque or effect.n_states:
            continue
        x, v = np.full((2, layout.n_x), 0.1), np.zeros((2, layout.n_v))
        x[:, layout.theta_m[0] + layout.offset] = 0.2
        axis = effect.axis(layout)
        v[:, axis] = 0.01, -0.01
        up, down = effect.force(layout, x, v, None)[:, axis]
        v[:, axis] = 0.02, 0.0
        forwards, rest = effect.force(layout, x, v, None)[:, axis]
        odd_and_smooth = np.allclose(forwards - rest, 2.0 * (up - rest), rtol=0.1) and np.allclose(
            up + down, 2.0 * rest
        )
        jumps = not np.allclose(up, down) and not odd_and_smooth
        assert jumps == effect.reversing, effect.name
        assert effect.dry == (effect.reversing and bool(np.all(np.abs(up) > 0.05))), effect.name


def test_constants_are_channels_and_what_multiplies_the_masses() -> None:
    model = build_model(paper(effects=(Effect(name="table_tilt", where="base"),)))
    assert model.effects[0].needs_masses
    for name, entry in ENTRIES.items():
        constant = entry.kind == "channel" or name == "table_tilt"
        assert is_constant(Effect(name=name, where="")) == constant, name


def test_what_an_effect_extends_is_one_at_the_same_place() -> None:
    for entry in ENTRIES.values():
        simpler = entry.traits.extends
        assert simpler is None or ENTRIES[simpler].at == entry.at


def test_a_session_is_searched_for_what_may_begin_at_any_joint() -> None:
    assert BEGINNING == ("coulomb_friction", "torque_offset", "viscous_friction")
    assert {ENTRIES[name].at for name in BEGINNING} == {"joint", "driven joint"}


# Who names whom


def _named(tree: ast.Module) -> Iterator[str]:
    """Names and texts in code, docstrings left out."""
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value
        elif isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.alias):
            yield node.name


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_module_outside_effects_names_an_effect(path: Path) -> None:
    classes = {each.__name__ for each in CLASSES}
    for text in _named(ast.parse(path.read_text(encoding="utf-8"))):
        assert text not in classes
        assert not any(name in text for name in NAMES), text


def test_the_model_imports_no_effect() -> None:
    for path in (ROOT / "sms_online" / "model").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(module.startswith("sms_online.effects") for module in modules), path.name


def test_every_effect_of_the_package_is_listed() -> None:
    folder = inspect.getfile(catalogue)
    defined = {
        name
        for path in Path(folder).parent.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Entry"
        for name in [ast.literal_eval(node.args[0])]
    }
    assert defined == set(NAMES)


def test_an_offset_names_the_friction_that_looks_the_same() -> None:
    said = ENTRIES["torque_offset"].said
    assert said is not None
    words = said("joint_1", {"torque": -0.002})
    assert words.startswith(
        "the torque of joint_1 reads 0.002 too little at the shaft, or its Coulomb friction differs"
    )
