"""A curve in place of a law: found where the law is struck from the catalogue, as good on held-out data, and bounded.

An elastic axis of 12 s, noise of grade B (seed 1), whose spring hardens; its description states another stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from numpy.testing import assert_allclose

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.diagnosed import Diagnosis
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.force_curves import force_curves
from sms_online.effects.base import Force
from sms_online.effects.build import build_model
from sms_tools.adopted_system import adopted_text
from sms_tools.cli import main
from tests.axis_effects import BARE, axis_block
from tests.campaigns.sessions import disguised
from tests.test_compare import ELASTIC_AXIS, STIFFNESS

HARDENING = "cubic_stiffness@joint_1:stiffness=4000"
# What is struck with it: what resembles it.
ALIKE = ("cubic_stiffness", "backlash", "torsional_hysteresis", "encoder_eccentricity", "encoder_offset")


def described(stiffness: float = 1.1 * STIFFNESS) -> System:
    return parse_system(ELASTIC_AXIS.format(stiffness=stiffness), "axis.toml")


@cache
def capture(text: str) -> sms.Capture:
    return sms.simulate(described(STIFFNESS), duration=12.0, grade="B", seed=1, effects=[text])


@contextmanager
def striking(*names: str) -> Iterator[None]:
    """These effects struck from the catalogue."""
    inner = CandidateColumns.effects

    def known(self: CandidateColumns, learned: bool = False) -> Iterator[Effect]:
        return (effect for effect in inner(self, learned) if effect.name not in names)

    with patch.object(CandidateColumns, "effects", known):
        yield


@cache
def learned(text: str) -> Diagnosis:
    with striking(*ALIKE):
        return sms.diagnose(described(), capture(text), learned=True)


@cache
def by_law(text: str) -> Diagnosis:
    return sms.diagnose(described(), capture(text), learned=True)


@pytest.mark.long
def test_a_curve_replaces_a_law_that_is_struck() -> None:
    found, true = learned(HARDENING), by_law(HARDENING)
    curve = found.system.effects[-1]
    assert (curve.name, curve.where, curve.over) == ("learned_force", "joint_1", "deflection")
    own, law = found.after.held_out["joint_1"], true.after.held_out["joint_1"]
    assert own.whitened < 1.3 * law.whitened
    assert own.relative < 1.3 * law.relative < 0.2 * true.before.held_out["joint_1"].relative
    for name, parameter in true.after.parameters.items():
        if "@" not in name:
            learnt = found.after.parameters[name]
            true_value = described(STIFFNESS).nominal[name]
            assert abs(learnt.value - true_value) < 1.5 * max(abs(parameter.value - true_value), 2.0 * parameter.std), (
                name
            )


@pytest.mark.long
def test_a_curve_over_the_rate_replaces_stribeck_friction() -> None:
    """On the planar example of 10 s, grade B (seed 4), nominal values off by up to 1.4 (seed 2)."""
    system = disguised(sms.load_system("paper-planar"), np.random.default_rng(2))
    slipping = "stribeck_friction@joint_2:torque=10,velocity=0.15"
    run = sms.simulate("paper-planar", duration=10.0, grade="B", seed=4, effects=[slipping])
    true = sms.diagnose(system, run, learned=True)
    assert [effect.effect for effect in true.effects] == ["stribeck_friction@joint_2"]
    with striking("stribeck_friction"):
        found = sms.diagnose(system, run, learned=True)
    (curve,) = (effect for effect in found.system.effects if effect.knots)
    assert (curve.where, curve.over) == ("joint_2", "rate")
    assert found.after.held_out["joint_2"].whitened < 1.3 * true.after.held_out["joint_2"].whitened
    for name, value in sms.load_system("paper-planar").nominal.items():
        if name in true.after.parameters and name in found.after.parameters:
            one, other = found.after.parameters[name], true.after.parameters[name]
            assert abs(one.value - value) < 1.5 * max(abs(other.value - value), 2.0 * other.std), name


@pytest.mark.slow
def test_a_law_of_the_catalogue_wins_where_it_is_as_good() -> None:
    assert [effect.effect for effect in by_law(HARDENING).effects] == ["cubic_stiffness@joint_1"]


@pytest.mark.slow
def test_the_verdict_says_what_the_curve_takes_of_unseen_data() -> None:
    found = learned(HARDENING)
    assert found.verdict == "named"
    (effect,) = found.document()["effects"]
    assert effect["sentence"].startswith("no known law; this curve over the deflection of joint_1 takes what is left")


@pytest.mark.slow
def test_the_curve_is_drawn_with_its_band() -> None:
    (curve,) = force_curves(learned(HARDENING).search)
    assert curve.variable == "deflection"
    true = -4000.0 * curve.at**3
    assert_allclose(curve.law, true, atol=0.02 * np.abs(true).max())
    assert np.all(np.abs(curve.force - curve.law) < 5.0 * curve.std + 0.01 * np.abs(true).max())


@pytest.mark.slow
def test_a_torque_over_the_angle_is_learned_without_a_law() -> None:
    """A cable that pulls the more, the further the axis is turned to one side."""
    pull = axis_block(lambda q, rate: 0.3 * np.exp(q) - 0.3)
    found = sms.diagnose(BARE, [pull], learned=True)
    keys = {effect.effect for effect in found.effects}
    assert "learned_force@joint_1" in keys
    (curve,) = (effect for effect in found.system.effects if effect.knots)
    assert curve.over == "angle"
    assert found.after.held_out["joint_1"].whitened < 1.1
    assert found.before.held_out["joint_1"].whitened > 5.0


@pytest.mark.slow
def test_without_being_allowed_no_curve_is_tried() -> None:
    found = sms.diagnose(described(), capture(HARDENING))
    assert not any(candidate.name == "learned_force" for candidate in found.candidates)


@pytest.mark.slow
def test_the_system_file_holds_the_curve(tmp_path: Path) -> None:
    (tmp_path / "axis.toml").write_text(ELASTIC_AXIS.format(stiffness=1.1 * STIFFNESS))
    found = learned(HARDENING).system
    (tmp_path / "found.toml").write_text(adopted_text(str(tmp_path / "axis.toml"), described(), found, {}))
    read = sms.load_system(tmp_path / "found.toml")
    assert read.effects[-1].knots == pytest.approx(found.effects[-1].knots, rel=1e-8)
    assert sms.validate(read, capture(HARDENING)).holds
    assert not sms.validate(read, capture(HARDENING)).warnings
    again = sms.simulate(read, duration=12.0, grade="0")
    true = sms.simulate(described(STIFFNESS), duration=12.0, grade="0", effects=[HARDENING])
    assert_allclose(again.values[:, 0], true.values[:, 0], atol=0.02 * np.abs(true.values[:, 0]).max())


@pytest.mark.slow
def test_beyond_what_it_saw_the_curve_is_held_and_said(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = learned(HARDENING).system
    model = build_model(found)
    (force,) = (effect for effect in model.effects if isinstance(effect, Force))
    low, high = found.effects[-1].knots[0], found.effects[-1].knots[-1]
    x = np.zeros((4, model.layout.n_x))
    x[:, model.layout.theta_m[0]] = [2.0 * low, low, high, 5.0 * high]
    v = np.zeros((4, model.layout.n_v))
    outside = force.force(model.layout, x, v, None)
    assert_allclose(outside[0], outside[1])
    assert_allclose(outside[2], outside[3])
    assert "held constant beyond, 50 % of the time" in force.beyond(model.layout, x, v)
    narrow = found.effects[-1].model_copy(update={"knots": tuple(0.5 * knot for knot in found.effects[-1].knots)})
    warned = sms.validate(found.model_copy(update={"effects": (narrow,)}), capture(HARDENING)).warnings
    assert any("held constant beyond" in warning for warning in warned)


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('name = "coulomb_friction"\nwhere = "joint_1"\nover = "rate"', "it is a law"),
        ('name = "learned_force"\nwhere = "joint_1"\nover = "rate"', "both, or neither"),
        ('name = "learned_force"\nwhere = "joint_1"\nover = "rate"\nknots = [0.0, 2.0, 1.0]', "ascending"),
    ],
)
def test_a_curve_that_cannot_be_is_refused(table: str, expected: str) -> None:
    with pytest.raises(sms.InputError, match=expected):
        build_model(parse_system(ELASTIC_AXIS.format(stiffness=STIFFNESS) + f"[[effect]]\n{table}\n", "axis.toml"))


@pytest.mark.slow
def test_the_verb_tries_curves_where_it_is_asked_to(tmp_path: Path) -> None:
    sms.write_capture(capture(HARDENING), tmp_path / "run.csv")
    (tmp_path / "axis.toml").write_text(ELASTIC_AXIS.format(stiffness=1.1 * STIFFNESS))
    arguments = [str(tmp_path / "run.csv"), "--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path), "--learn"]
    assert main(["diagnose", *arguments]) == 0
    assert "cubic_stiffness" in (tmp_path / "system.toml").read_text()
