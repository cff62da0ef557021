"""The simulator: its integrator against closed forms, what it conserves, and what its sensors make of the motion."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sms_online.description.parse import parse_system, shipped_text
from sms_online.description.schema import Controller, Harmonic, Sensor, System, Trajectory
from sms_online.errors import InputError
from sms_online.stream import Array
from sms_sim.controller import JointPD
from sms_sim.integrate import Collocation, solve
from sms_sim.plant import Plant
from sms_sim.realtime import STEP, RealTimeStepper
from sms_sim.references import fourier_reference
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, exact_states, sampled_blocks, simulate

EIGHTH_ORDER = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])


def shipped(name: str) -> System:
    return parse_system(shipped_text(name), name)


@pytest.fixture(scope="module")
def short() -> Simulation:
    """Half a second of the paper's example: enough for the sensors."""
    return simulate(shipped("paper-planar"), 0.5)


def sampled(simulation: Simulation, grade: str | None = None, seed: int = 0) -> tuple[Array, tuple[str, ...], Array]:
    blocks = list(sampled_blocks(simulation, grade, seed))
    return (
        np.concatenate([block.t for block in blocks]),
        blocks[0].channels,
        np.concatenate([block.values for block in blocks]),
    )


# Integrator


FREQUENCY, DECAY = 40.0, 3.0  # rad/s, 1/s


def oscillator(t: Array, y: Array) -> Array:
    """ü + 2 δ u̇ + (ω² + δ²) u = 0."""
    return np.stack((y[:, 1], -2 * DECAY * y[:, 1] - (FREQUENCY**2 + DECAY**2) * y[:, 0]), axis=1)


def oscillation(t: Array) -> Array:
    """Its solution from u = 1, u̇ = -δ."""
    decay = np.exp(-DECAY * t)
    cos, sin = np.cos(FREQUENCY * t), np.sin(FREQUENCY * t)
    return np.stack((decay * cos, -decay * (DECAY * cos + FREQUENCY * sin)), axis=1)


def test_a_damped_oscillator_follows_its_closed_form() -> None:
    solution = solve(oscillator, oscillation(np.zeros(1))[0], 2.0, np.array([1e-12, 1e-10]))
    t = np.linspace(0.0, 2.0, 4001)
    assert_allclose(solution(t)[:, 0], oscillation(t)[:, 0], rtol=0, atol=1e-11)
    assert_allclose(solution(t)[:, 1], oscillation(t)[:, 1], rtol=0, atol=1e-9)
    assert solution.t[-1] == 2.0


def test_the_integral_of_a_dissipated_power_is_the_energy_lost() -> None:
    solution = solve(oscillator, oscillation(np.zeros(1))[0], 1.0, np.array([1e-12, 1e-10]))
    power = 2 * DECAY * solution.stages[:, :, 1:] ** 2
    t = np.linspace(0.0, 1.0, 777)
    y = solution(t)
    energy = 0.5 * y[:, 1] ** 2 + 0.5 * (FREQUENCY**2 + DECAY**2) * y[:, 0] ** 2
    assert_allclose(solution.integral(power, t)[:, 0], energy[0] - energy, rtol=0, atol=1e-10 * energy[0])


@pytest.mark.parametrize(("stages", "steps"), [(3, 64), (5, 24), (7, 12)])
def test_the_order_is_twice_the_stages_less_one(stages: int, steps: int) -> None:
    def error(n: int) -> float:
        collocation = Collocation(oscillator, 0.0, oscillation(np.zeros(1))[0], stages)
        for _ in range(n):
            solved = collocation.iterate(1.0 / n, np.full(2, 1e-12))
            assert solved is not None
            Z, F, _ = solved
            collocation.advance(1.0 / n, Z, F)
        u, u_dot = collocation.y - oscillation(np.ones(1))[0]
        return float(np.hypot(u, u_dot / FREQUENCY))  # whatever the phase

    order = np.log2(error(steps) / error(2 * steps))
    assert order == pytest.approx(2 * stages - 1, abs=0.3)


def test_a_fast_pole_costs_no_steps_once_it_has_decayed() -> None:
    """ẏ = λ (y - cos t) - sin t with the pole of the planar example (Prothero and Robinson)."""
    pole = -8500.0
    solution = solve(
        lambda t, y: pole * (y - np.cos(t)[:, None]) - np.sin(t)[:, None], np.array([0.0]), 10.0, np.full(1, 1e-10)
    )
    decayed = solution.t > 0.01
    assert_allclose(solution.y[decayed, 0], np.cos(solution.t[decayed]), rtol=0, atol=1e-9)
    assert solution.t.size < 50


def test_a_motion_without_continuation_is_refused() -> None:
    with pytest.raises(ArithmeticError, match="cannot be followed"):
        solve(lambda t, y: y**2, np.array([1.0]), 2.0, np.full(1, 1e-8))


# Reference and controller


def test_the_rate_of_a_reference_is_its_derivative() -> None:
    joints = (
        (Harmonic(frequency=1.5, sine=1.3), Harmonic(frequency=4.0, cosine=-0.2)),
        (Harmonic(frequency=3.0, sine=1.0),),
    )
    reference = fourier_reference(Trajectory(duration=1.0, joints=joints))
    t = np.linspace(0.0, 5.0, 50)
    q_d, q_d_dot = reference(t)
    assert_allclose(q_d[0], 0.0, atol=1e-15)
    assert_allclose(q_d[:, 0], 1.3 * np.sin(1.5 * t) - 0.2 * (np.cos(4.0 * t) - 1.0), atol=1e-14)
    assert_allclose(q_d_dot, (reference(t + 1e-5)[0] - reference(t - 1e-5)[0]) / 2e-5, atol=1e-8)


def test_the_controller_pulls_towards_the_reference() -> None:
    reference = fourier_reference(Trajectory(duration=1.0, joints=((Harmonic(frequency=2.0, sine=0.5),),)))
    controller = JointPD(Controller(stiffness=(500.0,), damping=(100.0,)), reference)
    # At t = 0: q_d = 0, q̇_d = 1 rad/s.
    assert_allclose(controller(np.zeros(1), np.array([[0.1]]), np.array([[0.4]])), [[500 * -0.1 + 100 * 0.6]])


# Conservation


def test_the_paper_example_conserves_energy_and_momentum(planar_session: Simulation) -> None:
    drift = planar_session.drift
    assert drift.energy < 1e-9
    assert drift.linear_momentum is not None
    assert drift.linear_momentum < 1e-10
    assert drift.angular_momentum is not None
    assert drift.angular_momentum < 1e-10


def test_motor_work_goes_into_energy_and_damping_at_any_instant(planar_session: Simulation) -> None:
    exact = exact_states(planar_session, np.linspace(0.0, 10.0, 101))
    energy = planar_session.plant.dynamics.energy(exact.x, exact.v)
    balance = exact.work.sum(axis=1) - exact.dissipated
    assert_allclose(balance, energy, rtol=0, atol=1e-9 * energy.max())
    assert energy.max() > 100.0  # J: the arm does move


def test_a_free_spatial_arm_keeps_energy_and_momenta() -> None:
    system = shipped("spatial-two-link").model_copy(update={"controller": None})
    model = Plant(system).model
    frictionless = np.where([p.name.endswith(".damping") for p in model.parameters], 0.0, model.nominal)
    random = np.random.default_rng(5)
    x = Plant(system).rest[: model.layout.n_x]
    v = 0.1 * random.standard_normal(model.layout.n_v)
    simulation = simulate(system, 0.2, frictionless, (x, v))
    exact = exact_states(simulation, simulation.solution.t)
    assert not exact.dissipated.any()
    energy = simulation.plant.dynamics.energy(exact.x, exact.v)
    assert_allclose(energy, energy[0], rtol=1e-9)
    assert simulation.drift.linear_momentum is not None
    assert simulation.drift.linear_momentum < 1e-9
    assert simulation.drift.angular_momentum is not None
    assert simulation.drift.angular_momentum < 1e-9
    attitude = exact.x[:, 3:7]
    assert np.abs(attitude[-1] - attitude[0]).max() > 1e-3
    assert_allclose(np.linalg.norm(attitude, axis=1), 1.0, rtol=0, atol=1e-12)


def test_gravity_and_a_fixed_base_leave_no_momentum_to_judge_by() -> None:
    drift = simulate(shipped("ak80-pendulum"), 1.0).drift
    assert drift.energy < 1e-9
    assert drift.linear_momentum is None
    assert drift.angular_momentum is None


@pytest.mark.long
def test_steps_of_one_millisecond_stay_with_the_exact_motion(planar_session: Simulation) -> None:
    stepper = RealTimeStepper(planar_session.plant)
    samples = [stepper.step() for _ in range(5000)]
    t = np.array([sample.t for sample in samples])
    assert_allclose(t, STEP * np.arange(1, 5001), rtol=0, atol=1e-12)
    exact = exact_states(planar_session, t)
    energy = planar_session.plant.dynamics.energy
    reached = energy(np.array([s.x for s in samples]), np.array([s.v for s in samples]))
    truth = energy(exact.x, exact.v)
    assert np.abs(reached - truth).max() < 1e-4 * truth.max()
    torque = np.array([s.torque for s in samples])
    assert_allclose(torque, exact.torque, rtol=0, atol=1e-3 * np.abs(exact.torque).max())


# Sensors


def test_noise_free_samples_can_be_differentiated(planar_session: Simulation) -> None:
    t, channels, values = sampled(planar_session, "0")
    layout = planar_session.plant.model.layout
    x = values[:, [channels.index(name) for name in layout.position_names]]
    rates = np.stack([np.convolve(column, EIGHTH_ORDER[::-1] * 1000.0, mode="valid") for column in x.T], axis=1)
    exact = exact_states(planar_session, t[4:-4])
    decayed = t[4:-4] > 2.0  # the step in torque at t = 0 rings beyond what 1 kHz resolves
    assert_allclose(rates[decayed], exact.v[decayed], rtol=0, atol=2e-8)


def test_without_sensor_errors_channels_are_the_exact_motion(short: Simulation) -> None:
    t, channels, values = sampled(short, "0")
    exact = exact_states(short, t)
    assert t[-1] == pytest.approx(0.5)
    assert t.size == 501
    assert_allclose(values[:, channels.index("tau_2")] * 50.0, exact.torque[:, 1], rtol=1e-12)
    assert_allclose(values[:, channels.index("q_1")], exact.x[:, 3], rtol=0, atol=0)
    assert not any(name.startswith(("v_S", "omega_0")) for name in channels)


@pytest.mark.parametrize(
    ("grade", "encoder", "marker", "torque"), [("A", 1e-5, 1e-5, 0.1), ("B", 1e-4, 1e-4, 0.5), ("C", 1e-4, 1e-3, 0.5)]
)
def test_grades_add_white_noise_of_their_size(
    short: Simulation, grade: str, encoder: float, marker: float, torque: float
) -> None:
    _, channels, clean = sampled(short, "0")
    _, _, noisy = sampled(short, grade, seed=3)
    noise = noisy - clean
    expected = {"tau_1": torque / 50.0, "q_2": encoder, "theta_m_1": encoder, "theta_0": encoder, "r_S_y": marker}
    expected |= {"link_1.marker_2.u_y": marker, "link_2.marker_1.theta_z": marker}
    for channel, sigma in expected.items():
        column = noise[:, channels.index(channel)]
        # Of 501 samples the standard deviation is known to 3 %, their lag-one correlation to 0.045: three of each.
        assert np.std(column) == pytest.approx(sigma, rel=0.1), channel
        assert abs(np.corrcoef(column[:-1], column[1:])[0, 1]) < 0.14, channel


def test_the_seed_alone_decides_the_noise(short: Simulation) -> None:
    _, _, first = sampled(short, "B", seed=1)
    _, _, again = sampled(short, "B", seed=1)
    _, _, other = sampled(short, "B", seed=2)
    assert np.array_equal(first, again)
    assert not np.any(first == other)


def with_sensors(simulation: Simulation, *sensors: Sensor) -> Simulation:
    system = simulation.plant.system.model_copy(update={"sensors": sensors})
    return Simulation(Plant(system), simulation.solution)


def test_a_resolution_puts_readings_on_its_grid(short: Simulation) -> None:
    simulation = with_sensors(short, Sensor(channels=("q_*",), resolution=1e-3))
    t, channels, values = sampled(simulation)
    steps = values[:, channels.index("q_1")] / 1e-3
    assert_allclose(steps, np.round(steps), rtol=0, atol=1e-9)
    assert np.abs(values[:, channels.index("q_1")] - exact_states(short, t).x[:, 3]).max() <= 0.5e-3 + 1e-12


def test_a_slow_sensor_fills_every_fourth_sample_of_its_own(short: Simulation) -> None:
    simulation = with_sensors(short, Sensor(channels=("r_S_*",), rate=250.0), Sensor(channels=("q_*",)))
    _, channels, values = sampled(simulation)
    assert channels == ("tau_1", "tau_2", "r_S_x", "r_S_y", "q_1", "q_2")
    filled = np.isfinite(values[:, channels.index("r_S_x")])
    assert np.array_equal(np.flatnonzero(filled), np.arange(0, 501, 4))
    assert np.isfinite(values[:, channels.index("q_1")]).all()


def test_a_latency_delivers_the_past(short: Simulation) -> None:
    late = Sensor(channels=("q_1", "tau_1"), latency=0.0105)
    t, channels, values = sampled(with_sensors(short, late))
    exact = exact_states(short, t[11:] - 0.0105)
    assert_allclose(values[11:, channels.index("q_1")], exact.x[:, 3], rtol=0, atol=1e-14)
    assert_allclose(values[11:, channels.index("tau_1")] * 50.0, exact.torque[:, 0], rtol=1e-12)
    assert not values[:11, [channels.index("q_1"), channels.index("tau_1")]].any()


def test_reading_in_other_portions_changes_no_bit() -> None:
    system = shipped("paper-planar").model_copy(
        update={"sensors": (Sensor(channels=("q_*",), noise=1e-3, rate=300.0, resolution=1e-4),)}
    )
    exact = np.random.default_rng(0).standard_normal((100, 4))
    channels = ("tau_1", "tau_2", "q_1", "q_2")
    whole = Sensors(system, channels, None, seed=7).read(0, exact)
    in_parts = Sensors(system, channels, None, seed=7)
    parts = [in_parts.read(first, exact[first : first + 13]) for first in range(0, 100, 13)]
    assert np.array_equal(whole, np.concatenate(parts), equal_nan=True)


# Bad input


def test_an_unknown_grade_is_named(short: Simulation) -> None:
    with pytest.raises(InputError, match="grade: 'D'; expected one of 0, A, B, C"):
        next(sampled_blocks(short, "D"))


def test_a_session_of_unknown_length_is_refused() -> None:
    with pytest.raises(InputError, match="trajectory"):
        simulate(shipped("paper-planar").model_copy(update={"trajectory": None}))
