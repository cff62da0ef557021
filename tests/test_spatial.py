"""Spatial arms, noise-free and streamed: what the motion excites is found, what it does not is not claimed.

Excited is a parameter whose Cramér–Rao bound at grade A is below 1 % of its value, computed apart from the estimator.
"""

from __future__ import annotations

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.cramer_rao import cramer_rao_bound
from sms_online.description.schema import Tolerances
from sms_online.evaluation import identifiable
from sms_online.linearised import Motion
from sms_online.pipeline.estimator import Estimator
from sms_online.sensor_set import sensor_set
from sms_online.stream import Array
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, exact_states, sampled_blocks, simulate
from tests.campaigns.sessions import disguised, true_parameters
from tests.conftest import noise_free_block
from tests.evaluated import standard_deviation
from tests.sessions_of import session_of
from tests.simulations import simulated, until

GRADE = "A"
ACCURACY = 1e-3
EXCITED = 1e-2


def streamed(simulation: Simulation) -> tuple[Estimator, Array]:
    """A finished session on the noise-free samples of a simulation, and the true base parameters."""
    block = noise_free_block(simulation, simulation.plant.system)
    estimator = session_of(simulation.plant.system, [block])
    return estimator, estimator.base.values(simulation.plant.model.nominal)


@pytest.mark.long
def test_two_link_arm_gives_every_parameter_that_is_not_zero() -> None:
    estimator, truth = streamed(simulate(load_system("spatial-two-link")))
    estimate = estimator.estimate()
    error = np.abs(estimate.pi - truth)
    present = truth != 0.0
    assert present.sum() == 40
    assert (error[present] < ACCURACY * np.abs(truth[present])).all()
    assert identifiable(estimate.pi, standard_deviation(estimator, estimate))[present].all()
    # Three products of inertia of a stator are zero; its moments are 6e-3 kg m² and more.
    assert (error[~present] < ACCURACY * 6e-3).all()


def relative_bound(simulation: Simulation, step: float) -> Array:
    """Cramér–Rao bound over value (n,) with every position and torque measured at grade A; inf for zero values."""
    plant = simulation.plant
    t = np.arange(0.0, simulation.duration + 0.5 * step, step)
    exact = exact_states(simulation, np.minimum(t, simulation.duration))
    graded = Sensors(plant.system, plant.channels, GRADE, seed=0)
    base = Estimator(plant.system, plant.channels, "simulation").base
    sensors = sensor_set(plant.model, graded.channels, graded.noise, graded.rate)
    bound = cramer_rao_bound(plant.dynamics, base, [Motion(t, exact.x, exact.v)], sensors)
    truth = base.values(plant.model.nominal)
    return np.where(truth == 0.0, np.inf, bound / np.where(truth == 0.0, 1.0, np.abs(truth)))


@pytest.mark.long
def test_seven_joint_arm_gives_what_the_motion_excites() -> None:
    # Some parameters move the energy by parts in 1e9, so the simulation has to be exact beyond that.
    simulation = simulated(load_system("seven-joint"), position_tolerance=1e-13)
    estimator, truth = streamed(simulation)
    estimate, std = estimator.estimate(), standard_deviation(estimator)
    bound = relative_bound(simulation, 0.02)
    error = np.abs(estimate.pi - truth)
    excited = bound < EXCITED
    print(f"\nexcited, {excited.sum()} of {bound.size}: name, bound at grade A, error of the noise-free estimate")
    for k in np.flatnonzero(excited):
        name, relative = estimator.base.parameters[k].name, error[k] / abs(truth[k])
        print(f"{name:80s} {100.0 * bound[k]:8.4f} % {100.0 * relative:8.4f} %")
    assert excited.sum() >= 50
    assert (error[excited] < ACCURACY * np.abs(truth[excited])).all()
    # The others are flagged, or come with an error bar that holds.
    assert (~identifiable(estimate.pi, std) | (error < 5.0 * std))[~excited].all()


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 9])
def test_seven_joints_raise_no_alarm(seed: int) -> None:
    """Weights of a first fit of few windows, and those that noise attenuates, would predict a third of the noise."""
    system = load_system("seven-joint").model_copy(update={"tolerances": Tolerances.model_validate("none")})
    result = sms.estimate(system, sms.simulate(system, duration=20.0, grade="B", seed=seed))
    assert not result.trust.grave
    off = [(p.value - p.true) / p.std for p in result.parameters.values() if p.determined and p.true is not None]
    assert len(off) >= 50
    assert np.abs(off).max() < 5.0


@pytest.mark.long
def test_seven_joint_arm_at_250_hz_and_grade_b() -> None:
    """A first fit without weights cannot separate 91 parameters; values twice the true ones start it well enough."""
    system = load_system("seven-joint").model_copy(update={"sample_rate": 250.0})
    # The same motion, read less often.
    motion = until(simulated(load_system("seven-joint"), position_tolerance=1e-13), 20.0).solution
    estimator = session_of(disguised(system), sampled_blocks(Simulation(Plant(system), motion), "B", seed=1))
    truth = true_parameters(system)
    std, error = standard_deviation(estimator), np.abs(estimator.estimate().pi - truth)
    determined = (truth != 0.0) & (std < np.abs(truth) / 3.0)
    assert estimator.by_momentum
    assert determined.sum() >= 50
    assert np.median(error[determined] / np.abs(truth[determined])) < 0.01
    # The wrist's last spring bends by less than the encoders' noise: its stiffness is attenuated.
    names = [parameter.name for parameter in estimator.base.parameters]
    others = determined & ~np.array([name.startswith("joint_7.") for name in names])
    assert (error[others] < 4.0 * std[others]).all()
