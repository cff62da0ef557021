"""Gains of torques as unknowns of the model, what fixes the scale of all parameters, and gains on another run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sms_online as sms
from sms_online.calibration.found import Calibration
from sms_online.description.schema import Effect, System

GAIN = 0.04
# A rigid arm on a table. What its second joint's torque says of link 2 is little beside friction: with a free gain all
# of it may shrink, as long as joint 1's rows hold link 2 loosely.
ARM = """
name = "arm"
motion = "planar"
sample_rate = 1000.0
[joint_1]
gear_ratio = 50.0
transmission = "rigid"
[motor_1]
rotor_inertia = 4.2e-5
[link_1]
kind = "rigid"
mass = 2.8
center_of_mass = [0.18, 0.0, 0.0]
inertia = { zz = 0.035 }
tip = [0.35, 0.0, 0.0]
[joint_2]
gear_ratio = 30.0
transmission = "rigid"
[motor_2]
mass = 1.3
rotor_inertia = 2.4e-5
[link_2]
kind = "rigid"
mass = 1.0
center_of_mass = [0.14, 0.0, 0.0]
inertia = { zz = 0.012 }
tip = [0.3, 0.0, 0.0]
[[effect]]
name = "viscous_friction"
where = "joint_1"
coefficients = { damping = 1.2 }
[[effect]]
name = "coulomb_friction"
where = "joint_1"
coefficients = { torque = 1.8 }
[[effect]]
name = "viscous_friction"
where = "joint_2"
coefficients = { damping = 0.6 }
[[effect]]
name = "coulomb_friction"
where = "joint_2"
coefficients = { torque = 0.7 }
[controller]
stiffness = [400.0, 150.0]
damping = [40.0, 10.0]
[trajectory]
duration = 8.0
joint_1 = [{ frequency = 0.7, sine = 0.5 }, { frequency = 1.9, cosine = 0.2 }]
joint_2 = [{ frequency = 1.1, sine = 0.6 }, { frequency = 2.7, cosine = 0.2 }]
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> System:
    file = tmp_path_factory.mktemp("arm") / "arm.toml"
    file.write_text(ARM)
    return sms.load_system(file)


def with_unknown_gain(system: System) -> System:
    return system.model_copy(update={"effects": (*system.effects, Effect(name="torque_gain", where="joint_2"))})


@pytest.mark.slow
@pytest.mark.parametrize("ripple", [pytest.param(0.0, marks=pytest.mark.long), 0.05])
def test_an_unknown_gain_makes_no_torque_vanish(arm: System, ripple: float) -> None:
    """8 s at grade B, seed 1; a ripple of both torques that nobody describes, a share of them."""
    effects = [f"torque_gain@joint_2:ratio={GAIN}"]
    if ripple:
        effects += [f"torque_ripple@joint_{i}:amplitude={ripple},order={order}" for i, order in ((1, 3), (2, 5))]
    result = sms.estimate(with_unknown_gain(arm), sms.simulate(arm, grade="B", seed=1, effects=effects))
    gain = result.parameters["torque_gain@joint_2.ratio"]
    assert abs(gain.value - GAIN) < 3.0 * gain.std
    assert gain.std < 0.3
    if not ripple:
        off = [(p.value - p.true) / p.std for p in result.parameters.values() if p.true is not None and p.std]
        assert np.abs(off).max() < 4.0


def scale_is_open(system: System, **known: float) -> bool:
    named = {name.replace("__", "."): value for name, value in known.items()}
    return system.model_copy(update={"known": named}).scale_tolerance is not None


def test_a_known_value_fixes_the_scale_only_where_nothing_acts_alike(arm: System) -> None:
    planar = sms.load_system("paper-planar")
    assert scale_is_open(planar)
    assert not scale_is_open(planar, link_2__mass_per_length=31.42)
    assert not scale_is_open(planar, joint_1__stiffness=1000.0)
    # Lumped with the first motor's; and masses about fixed axes with what they carry.
    assert scale_is_open(planar, spacecraft__mass=400.0)
    assert scale_is_open(arm, link_2__mass=1.0)
    assert not scale_is_open(arm, motor_2__rotor_inertia=2.4e-5)


@pytest.mark.long
def test_what_cannot_fix_the_scale_changes_no_estimate(arm: System) -> None:
    """A link's mass that acts as its inertia does: joint 1's gain stays the unit of all others, and results say so."""
    data = sms.simulate(arm, grade="B", seed=2)
    free, weighed = (
        sms.estimate(arm.model_copy(update={"known": known}), data) for known in ({}, {"link_2.mass": 1.0})
    )
    assert weighed.document()["scale_tolerance"] == free.document()["scale_tolerance"] == 0.01
    assert any("does not fix the scale" in warning for warning in weighed.warnings)
    for name in ("motor_2.rotor_inertia", "link_2.inertia", "link_2.first_moment_x"):
        of_one, of_other = (result.parameters[name] for result in (weighed, free))
        assert abs(of_one.value - of_other.value) < 0.01 * of_other.std


@pytest.mark.long
def test_gains_that_a_session_finds_hold_on_another_run(arm: System) -> None:
    """True parameters, without the gain and with it, on a run without noise; a result hands its own on."""
    run = sms.simulate(arm, effects=[f"torque_gain@joint_2:ratio={GAIN}"])
    result = sms.estimate(arm, run)
    values = {name: parameter.true or 0.0 for name, parameter in result.parameters.items()}
    without = sms.validate(arm, run, values).joints["joint_2"].left
    held = sms.validate(arm, run, values, {"joint_2": -GAIN})
    assert held.holds
    assert held.joints["joint_2"].left < 0.1 * without
    found = Calibration("drive_gain", "joint_2", "against joint_1", "", -GAIN, 1e-3, 1e-2)
    handed_on = sms.validate(arm, run, replace(result, calibration=(found,)))
    plain = sms.validate(arm, run, replace(result, calibration=()))
    assert handed_on.joints["joint_2"].left != plain.joints["joint_2"].left


@pytest.mark.long
def test_the_gain_of_joint_1_is_held_where_the_scale_is_fixed(arm: System) -> None:
    """A torque of joint 1 that reads 4 % too large, and a result that says so."""
    system = arm.model_copy(update={"known": {"motor_2.rotor_inertia": 2.4e-5}})
    run = sms.simulate(arm)
    columns = dict(zip(run.channels, run.values.T.copy(), strict=True))
    columns["tau_1"] *= 1.0 / (1.0 - GAIN)
    read = sms.Capture.from_arrays(run.t, columns)
    result = sms.estimate(system, run)
    found = Calibration("drive_gain", "joint_1", "", "", GAIN, 1e-3, 1e-2)
    held = sms.validate(system, read, replace(result, calibration=(found,))).joints["joint_1"]
    plain = sms.validate(system, read, replace(result, calibration=())).joints["joint_1"]
    assert held.left < 0.1 * plain.left
