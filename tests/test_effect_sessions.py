"""Effects in simulated sessions: what they take out of the motion, what they do to channels, that they are found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_adapters.truth import read_truth
from sms_online.cramer_rao import cramer_rao_bound
from sms_online.description.parse import shipped_text
from sms_online.description.schema import System, Tolerances
from sms_online.effects.base import report
from sms_online.effects.build import build_model
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.sensor_set import sensor_set
from sms_sim.plant import Plant
from sms_sim.realtime import RealTimeStepper
from sms_sim.simulate import Simulation, exact_states, sampled_blocks, simulate
from sms_tools.cli import main
from tests.declared import declaring
from tests.effect_laws import FORCES
from tests.saved import resumed
from tests.sessions_of import session_of
from tests.simulations import planar

# Of those that act on the example's second joint and base, with what is declared of each to the estimator.
FOUND = {
    "cogging@joint_2:amplitude=2,phase=0.3,order=1": "cogging@joint_2:order=1",
    "cubic_stiffness@joint_1:stiffness=5000": "cubic_stiffness@joint_1",
    "link_damping@link_2:time=0.001": "link_damping@link_2",
    "reaction_wheel@base:torque=0.5": "reaction_wheel@base",
    "air_drag@base:damping=5": "air_drag@base",
    "rotational_drag@base:damping=5": "rotational_drag@base",
    "tip_payload@tip:mass=1": "tip_payload@tip",
    "torque_gain@joint_2:ratio=0.03": "torque_gain@joint_2",
    "kinematic_error@joint_1:amplitude=0.0005,phase=0.5": "kinematic_error@joint_1",
}


@pytest.fixture(scope="module")
def clean_motion() -> Simulation:
    """Two and a half seconds without effects."""
    return planar(2.5)


# Motion


@pytest.mark.slow
def test_the_power_of_all_effects_is_the_change_of_energy() -> None:
    """Half a second with every force effect at once: motor work, energy and what is taken out close to rounding."""
    simulation = simulate(declaring(*FORCES), 0.5)
    assert simulation.drift.energy < 1e-9
    assert simulation.drift.linear_momentum is None
    clean = planar(0.5)
    assert np.abs(exact_states(simulation, np.array([0.5])).dissipated).item() > 0.01
    moved = exact_states(simulation, np.array([0.5])).x - exact_states(clean, np.array([0.5])).x
    assert np.abs(moved).max() > 0.01


def test_in_space_too() -> None:
    texts = (
        "reaction_wheel@base:torque_x=0.5,torque_z=-1", "thruster_leak@base:force_x=0.5,force_z=0.4",
        "table_tilt@base:gravity_x=0.01,gravity_y=0.02", "cable_spring@base:stiffness=20,rest_z=0.1",
        "slosh@base:mass=20,stiffness=500", "link_damping@link_1:time=0.001", "link_mass_damping@link_2:rate=1",
        "tip_payload@tip:mass=1,inertia=0.1",
    )  # fmt: skip
    assert simulate(declaring(*texts, name="spatial-two-link"), 0.2).drift.energy < 1e-9


def test_internal_states_are_integrated_in_real_time_too() -> None:
    system = declaring("torsional_hysteresis@joint_1:torque=5,width=0.01", "slosh@base:mass=20,stiffness=500")
    exact = simulate(system, 0.3)
    stepper = RealTimeStepper(exact.plant)
    samples = [stepper.step() for _ in range(300)]
    expected = exact_states(exact, np.array([sample.t for sample in samples]))
    assert_allclose(np.array([sample.x for sample in samples]), expected.x, rtol=0, atol=1e-5)
    z = exact.solution.y[:, -exact.plant.model.n_states :]
    assert np.abs(z[:, 0]).max() <= 0.01  # hysteresis saturates at its width
    assert np.abs(z[:, 1:3] - exact.solution.y[:, :2]).max() > 1e-4  # slosh lags behind the base


def test_geometric_stiffening_is_a_system_with_exact_links() -> None:
    stiffened, exact = (
        Plant(declaring("geometric_stiffening@link_1", "geometric_stiffening@link_2")),
        Plant(declaring(name="paper-planar-exact")),
    )
    states = 0.1 * np.random.default_rng(4).normal(size=(5, exact.rest.size))
    assert np.array_equal(stiffened.rate(np.zeros(5), states), exact.rate(np.zeros(5), states))


def test_geometric_stiffening_of_one_link_is_estimated() -> None:
    """The model's own system has that link exact already, where the effect could not be declared."""
    system = declaring("geometric_stiffening@link_1")
    blocks = list(sampled_blocks(simulate(system, 0.05), "A", seed=1))
    estimator = Estimator(build_model(system).system, blocks[0].channels, "one link")
    for block in blocks:
        estimator.push(block)
    assert estimator.samples == sum(block.t.size for block in blocks)


# Identification


@pytest.fixture(scope="module")
def session() -> tuple[System, Estimator]:
    """Three seconds of grade A with the effects of FOUND, and an estimator that knows their names and the geometry."""
    true = declaring(*FOUND)
    exactly = {"tolerances": Tolerances.model_validate("none")}
    stated = declaring(*FOUND.values()).model_copy(update=exactly)
    return true, session_of(stated, sampled_blocks(simulate(true, 3.0), "A", seed=1))


@pytest.mark.slow
def test_declared_effects_are_identified_together_with_the_arm(session: tuple[System, Estimator]) -> None:
    """Within four deviations (seed 1, 26 parameters), and the effects within 1 %."""
    true, estimator = session
    estimate = estimator.estimate()
    truth = estimator.base.values(build_model(true).nominal)
    assert estimator.by_momentum
    assert estimate.determined.all()
    assert np.abs((estimate.pi - truth) / estimate.std).max() < 4.0
    own = ["@" in p.name for p in estimator.base.parameters]
    assert_allclose(estimate.pi[own], truth[own], rtol=0.01)


@pytest.mark.slow
def test_reported_coefficients_are_those_that_were_injected(session: tuple[System, Estimator]) -> None:
    true, estimator = session
    estimate = estimator.estimate()
    names = [p.name for p in estimator.base.parameters]
    declared = {effect.key: effect.coefficients for effect in true.effects}
    for effect in estimator.model.effects:
        for name, (value, std) in report(effect, names, estimate.pi, estimate.covariance).items():
            injected = declared[effect.key].get(name)
            if name in effect.shapes:
                assert std == 0.0
            elif injected is not None:
                assert value == pytest.approx(injected, rel=0.01), (effect.name, name)
                # Rows of a torque of unknown gain are weighted by what they leave, windows counted as they overlap.
                assert 0.0 < std < 0.02 * abs(value)


@pytest.mark.long
def test_friction_by_direction_and_speed_is_found_noise_free() -> None:
    """Within 1 %: reversals are resolved to a sample only."""
    names = "direction_friction@joint_2", "stribeck_friction@joint_1:velocity=0.3"
    true = declaring("direction_friction@joint_2:plus=2,minus=1.5", "stribeck_friction@joint_1:torque=1,velocity=0.3")
    estimator = session_of(declaring(*names), sampled_blocks(simulate(true, 2.5), "0"))
    assert_allclose(estimator.estimate().pi[-3:], [2.0, 1.5, 1.0], rtol=0.01)


@pytest.mark.long
def test_effects_with_internal_states_survive_a_restart() -> None:
    """Within 1 % at grade A (seed 1); saved and restored in the middle, the session ends with the same bits."""
    true = declaring("torsional_hysteresis@joint_1:torque=5,width=0.01", "slosh@base:mass=20,stiffness=500")
    stated = declaring("torsional_hysteresis@joint_1:width=0.01", "slosh@base:frequency=5")
    blocks = list(sampled_blocks(simulate(true, 2.5), "A", seed=1))
    whole, parted = (Estimator(stated, blocks[0].channels, "session") for _ in range(2))
    for k, block in enumerate(blocks):
        whole.push(block)
        parted.push(block)
        if k == 0:
            parted = resumed(Estimator(stated, blocks[0].channels, "session"), parted)
    whole.finish()
    parted.finish()
    assert whole.by_momentum
    assert np.array_equal(whole.estimate().pi, parted.estimate().pi)
    found = dict(zip([p.name for p in whole.base.parameters], whole.estimate().pi, strict=True))
    assert found["torsional_hysteresis@joint_1.torque"] == pytest.approx(5.0, rel=0.01)
    assert found["slosh@base.stiffness"] == pytest.approx(500.0, rel=0.01)


@pytest.mark.long
def test_a_tilt_is_found_with_masses_from_elsewhere() -> None:
    """Of 1 mm/s² within 1 % at grade A (seed 3), with every mass 0.1 % too large, by as much too small."""
    true = declaring("table_tilt@base:gravity_x=0.001,gravity_y=-0.002")
    blocks = list(sampled_blocks(simulate(true, 2.5), "A", seed=3))
    reference = 1.001 * build_model(true).nominal
    estimator = Estimator(declaring("table_tilt@base"), blocks[0].channels, "session", reference)
    for block in blocks:
        estimator.push(block)
    estimator.finish()
    assert_allclose(estimator.estimate().pi[-2:], [0.001, -0.002], rtol=0.01)


def test_a_tilt_is_refused_where_masses_are_unknown(clean_motion: Simulation) -> None:
    with pytest.raises(InputError, match="effect table_tilt@base"):
        Estimator(declaring("table_tilt@base"), clean_motion.plant.channels, "session")


@pytest.mark.parametrize("text", ["torque_gain@joint_2:ratio=0.1", "slosh@base:mass=20"])
def test_a_bound_knows_no_torques_and_no_internal_states(text: str) -> None:
    plant = Plant(declaring(text))
    base, rest = find_base_parameters(plant.model), np.zeros((3, plant.model.layout.n_x))
    motion = Motion(np.arange(3) * 1e-3, rest, rest)
    sensors = sensor_set(
        plant.model, plant.channels, np.full(len(plant.channels), 1e-4), np.full(len(plant.channels), 1e3)
    )
    with pytest.raises(InputError, match=text.split(":")[0]):
        cramer_rao_bound(plant.dynamics, base, [motion], sensors)


# Command line


def test_simulate_injects_effects_and_writes_their_true_values(tmp_path: Path) -> None:
    capture = tmp_path / "session.csv"
    command = ["simulate", "--system", "paper-planar", "--capture", str(capture), "--duration", "0.1", "--grade", "0"]
    effects = ["--effect", "cubic_stiffness@joint_1:stiffness=2000", "--effect", "tip_payload@tip:mass=1"]
    assert main([*command, *effects]) == 0
    truth = read_truth(capture)
    assert truth is not None
    assert truth["effects"] == [
        {"name": "cubic_stiffness", "where": "joint_1", "coefficients": {"stiffness": 2000.0}},
        {"name": "tip_payload", "where": "tip", "coefficients": {"mass": 1.0}},
    ]
    assert not any("@" in name for name in truth["parameters"])
    assert json.dumps(truth["parameters"]["joint_1.stiffness"]) == "1000.0"


def test_a_wrong_effect_on_the_command_line_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = str(tmp_path / "session.csv")
    command = ["simulate", "--system", "paper-planar", "--capture", capture, "--effect", "cubic_stiffness@joint_9"]
    assert main(command) == 2
    message = capsys.readouterr().err
    assert "cubic_stiffness at 'joint_9'; expected one of joint_1, joint_2" in message
    assert len(message.strip().splitlines()) == 1


def test_an_effect_without_a_size_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As diagnosis writes them, for an estimator to find their size."""
    file = tmp_path / "found.toml"
    effects = '[[effect]]\nname = "coulomb_friction"\nwhere = "joint_2"\n'
    effects += '[[effect]]\nname = "viscous_friction"\nwhere = "joint_1"\ncoefficients = { damping = 2.0 }\n'
    file.write_text(f"{shipped_text('paper-planar')}\n{effects}", encoding="utf-8")
    capture = str(tmp_path / "run.csv")
    assert main(["simulate", "--system", str(file), "--capture", capture, "--duration", "0.05"]) == 0
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(warnings) == 1
    assert "coulomb_friction@joint_2 has no effect" in warnings[0]
