"""Rows of the momentum balance are the equations of motion in weak form, of one window each, in one segment each."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline import momentum_fit
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum_balance import MomentumBalance
from sms_online.pipeline.momentum_windows import COPIES, EXPONENT, Window
from sms_online.pipeline.smoothing import stride
from sms_online.pipeline.weak_form import test_function as weak_test_function
from sms_online.stream import Array, Block
from sms_sim.simulate import Simulation, exact_states
from tests.axis import AXIS, DAMPING, INERTIA
from tests.evaluated import results_document
from tests.model_systems import FRICTION, paper, spatial
from tests.prescribed_motion import prescribed
from tests.saved import resumed
from tests.sessions_of import session_of

SPAN = 0.4  # s
# Of positions of some rad differenced at 1 kHz, over the sum of the sizes of a row's terms: 4e-13 found.
ROUNDING = 1e-11
# Of the simulated motion: positions to 1e-11 rad and m.
SIMULATED = 1e-8
KNOWN = {"joint_1.damping": 75.85, "link_2.mass_per_length": 31.42}
SYSTEMS = {
    "planar, friction": paper(effects=FRICTION),
    "planar, some known": paper(effects=FRICTION).model_copy(update={"known": KNOWN}),
    "planar, exact links": paper("exact"),
    "spatial two links": load_system("spatial-two-link"),
    "free, prismatic joint, gravity, payload": spatial("linear"),
    "fixed base, exact links": spatial("exact", free=False),
}
all_systems = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())


def windows_of(balance: MomentumBalance, x: Array, torque: Array, sigma: float) -> list[Window]:
    """Rows of positions x (B, n_x) and n τ (B, joints), samples 0 … B - 1."""
    motion = np.concatenate((x, torque), axis=1)
    windows, _ = balance.push(np.arange(len(x)), [motion] * COPIES, np.full(x.shape[1], sigma))
    return windows


def first_sample(balance: MomentumBalance, window: Window) -> int:
    """Sample at which a window of a segment that begins with sample 0 begins."""
    return balance.lead + window.start * balance.half_hop


def dense(balance: MomentumBalance, window: Window) -> Array:
    """Y (n_v, n) of the motion as measured."""
    Y = np.zeros((balance.model.layout.n_v, balance.base.n))
    Y[balance.rows, balance.columns] = window.Y[0]
    return Y


@all_systems
def test_rows_are_the_equations_of_motion_on_any_motion(system: System) -> None:
    """Y β = ∫ φ Q dt for the forces that H v̇ + C = Q asks for; the balance receives those of the motors."""
    model = build_model(system)
    balance = MomentumBalance(model, find_base_parameters(model), system.sample_rate, SPAN)
    motion = prescribed(model, balance.width + balance.lead + balance.margin + 2 * balance.hop + 1, seed=1)
    torque = motion.Q[:, list(model.layout.theta_m)]
    other = motion.Q - model.generalized_force(torque)
    beta = balance.base.values(model.nominal)
    phi, _, _ = weak_test_function(balance.width, balance.span, EXPONENT)
    windows = windows_of(balance, motion.x, torque, sigma=0.0)
    assert len(windows) == 3
    for window in windows:
        first = first_sample(balance, window)
        assert window.end == first + balance.width
        impulse = phi @ other[first : first + balance.width + 1] / system.sample_rate
        Y = dense(balance, window)
        size = np.abs(Y) @ np.abs(beta) + np.abs(window.b[0]) + np.abs(impulse)
        assert (np.abs(Y @ beta - window.b[0] - impulse) <= ROUNDING * size).all()


def test_rows_of_the_example_close_with_its_torque_alone(planar_session: Simulation) -> None:
    """A free-floater: base and links have no force of their own."""
    model = planar_session.plant.model
    balance = MomentumBalance(model, find_base_parameters(model), 1000.0, SPAN)
    exact = exact_states(planar_session, 4.0 + np.arange(1500) / 1000.0)
    beta = balance.base.values(model.nominal)
    for window in windows_of(balance, exact.x, exact.torque, sigma=0.0):
        Y = dense(balance, window)
        size = np.abs(Y) @ np.abs(beta) + np.abs(window.b[0])
        assert (np.abs(Y @ beta - window.b[0]) <= SIMULATED * size).all()


@all_systems
def test_what_is_stored_of_a_row_is_all_that_is_not_zero(system: System) -> None:
    model = build_model(system)
    balance = MomentumBalance(model, find_base_parameters(model), system.sample_rate, SPAN)
    motion = prescribed(model, balance.width + balance.lead + balance.margin + 1, seed=2)
    (window,) = windows_of(balance, motion.x, motion.Q[:, list(model.layout.theta_m)], sigma=0.0)
    phi, phi_dot, _ = weak_test_function(balance.width, balance.span, EXPONENT)
    first = first_sample(balance, window)
    inside = slice(first, first + balance.width + 1)
    P, G = model.momentum_columns(motion.x[inside], motion.v[inside])
    full = -(np.tensordot(phi_dot, P, 1) + np.tensordot(phi, G, 1)) / system.sample_rate
    full = balance.base.columns(full)
    size = np.abs(full).max(axis=0)
    np.testing.assert_allclose(dense(balance, window), full, rtol=0.0, atol=ROUNDING * size.max())
    # Terms that cancel leave their rounding.
    stored = np.zeros(full.shape, dtype=bool)
    stored[balance.rows, balance.columns] = True
    assert (np.abs(full) <= np.where(stored, np.inf, 1e-15) * size).all()


def test_a_force_aliased_by_thinning_is_summed_at_all_samples() -> None:
    """A cogging of 450 periods a turn, at 1.4 rad/s: one period for each thinned sample."""
    cogging = Effect(name="cogging", where="joint_2", coefficients={"amplitude": 6.0, "order": 9.0})
    model = build_model(paper(effects=(cogging,)))
    balance = MomentumBalance(model, find_base_parameters(model), 1000.0, SPAN)
    motion = prescribed(model, balance.width + balance.lead + balance.margin + 1, seed=1)
    (window,) = windows_of(balance, motion.x, motion.Q[:, list(model.layout.theta_m)], sigma=1e-4)
    thinned = stride(window.half_width, balance.hop)
    rate = motion.v[:, model.layout.theta_m[1]]
    assert rate.min() < 2.0 * np.pi / (450.0 * thinned * 1e-3) < rate.max()
    phi, _, _ = weak_test_function(balance.width, balance.span, EXPONENT)
    first = first_sample(balance, window)
    force = model.momentum_columns(motion.x, motion.v)[1][first : first + balance.width + 1]
    every = -balance.base.columns(np.tensordot(phi, force, 1)) / 1000.0
    folded = -balance.base.columns(np.tensordot(phi[::thinned], force[::thinned], 1)) * thinned / 1000.0
    own = [k for k, p in enumerate(balance.base.parameters) if p.name.startswith("cogging")]
    found = dense(balance, window)[:, own]
    assert np.abs(folded[:, own] - every[:, own]).max() > 0.01
    np.testing.assert_allclose(found, every[:, own], rtol=0.0, atol=1e-6)


def test_rows_of_a_free_base_hold_no_spring_damper_or_rotor() -> None:
    """Internal forces do not change the momentum of the whole system; these rows cost nothing there."""
    model = build_model(paper())
    balance = MomentumBalance(model, find_base_parameters(model), 1000.0, SPAN)
    names = [p.name for p in balance.base.parameters]
    in_base_rows = {names[k] for k in balance.columns[balance.rows < model.layout.n_base_speeds]}
    assert not any(name.endswith(("stiffness", "damping", "flexural_rigidity")) for name in in_base_rows)
    rotor_row = model.layout.theta_m[0]
    in_rotor_row = {names[k] for k in balance.columns[balance.rows == rotor_row]}
    assert "joint_1.stiffness" in in_rotor_row
    assert "joint_2.stiffness" not in in_rotor_row


def test_windows_are_gapless_and_stay_in_their_segment() -> None:
    system = paper()
    model = build_model(system)
    balance = MomentumBalance(model, find_base_parameters(model), system.sample_rate, SPAN)
    motion = prescribed(model, 3 * balance.width, seed=3)
    torque = motion.Q[:, list(model.layout.theta_m)]
    # What a segment of so many samples holds: windows a hop apart, with the filter's reach on either side.
    for begin in (0, 5017):
        balance.begin_segment()
        # Windows end at multiples of a hop.
        first = begin + balance.lead + balance.width
        first += -first % balance.hop
        expected = (begin + len(motion.t) - balance.margin - 1 - first) // balance.hop + 1
        windows = []
        for block in np.array_split(np.arange(len(motion.t)), 7):
            samples = np.concatenate((motion.x[block], torque[block]), axis=1)
            windows += balance.push(begin + block, [samples] * COPIES, np.zeros(model.layout.n_x))[0]
        assert len(windows) == expected
        ends = np.array([window.end for window in windows])
        np.testing.assert_array_equal(ends, first + balance.hop * np.arange(expected))


def axis_session(t: Array, noise: float = 0.0) -> Block:
    """The axis of `axis.py` along two sines at instants t, with white noise on its angle; seed 4."""
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    values = np.stack((INERTIA * acceleration + DAMPING * rate, q), axis=1)
    values[:, 1] += noise * np.random.default_rng(4).standard_normal(t.size)
    return Block(t, ("force_1", "q_1"), values)


def fitted(block: Block) -> Estimator:
    return session_of(parse_system(AXIS, "axis.toml"), [block])


@pytest.mark.slow
def test_no_window_spans_a_gap_and_none_beside_it_is_lost() -> None:
    """The motion goes on in the gap: a row across it would be off by its whole size."""
    t = np.arange(4000) / 200.0
    whole = axis_session(t)
    kept = np.concatenate((np.arange(1500), np.arange(1700, 2500), np.arange(2600, 4000)))
    estimator = fitted(Block(t[kept], whole.channels, whole.values[kept]))
    momentum = estimator.momentum
    assert momentum is not None
    # The sums over a window's samples that the filter for exact data leaves at 200 Hz: 4e-6 at the worst.
    np.testing.assert_allclose(estimator.estimate().pi, [INERTIA, DAMPING], rtol=1e-5)
    balance = MomentumBalance(estimator.model, estimator.base, 200.0, SPAN)
    expected = 0
    for begin, end in ((0, 1500), (1700, 2500), (2600, 4000)):
        first = begin + balance.lead + balance.width
        expected += (end - balance.margin - 1) // balance.hop - -(-first // balance.hop) + 1
    assert momentum.joint.grams.windows == expected
    assert momentum.state.dropped_windows == 0


@pytest.mark.slow
@pytest.mark.parametrize("cut", [0.2, 1.2, 1.6, 3.0], ids=lambda cut: f"at {cut} s")
def test_a_session_restored_at_any_time_gives_the_same_bits(cut: float) -> None:
    """Before the noise is known, while windows are held back for the first weights, and after."""
    block = axis_session(np.arange(800) / 200.0, noise=1e-4)
    split = int(np.searchsorted(block.t, cut))
    first = Estimator(parse_system(AXIS, "axis.toml"), block.channels, "axis")
    first.push(Block(block.t[:split], block.channels, block.values[:split]))
    second = Estimator(parse_system(AXIS, "axis.toml"), block.channels, "axis")
    resumed(second, first)
    second.push(Block(block.t[split:], block.channels, block.values[split:]))
    second.finish()
    assert results_document(second, 0.0, []) == results_document(fitted(block), 0.0, [])


@pytest.mark.long
def test_a_session_restored_during_warm_up_has_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(momentum_fit, "SAME_NOISE", 0.0)
    monkeypatch.setattr(momentum_fit, "WARM_UP", 0.8)
    block = axis_session(np.arange(1600) / 200.0, noise=1e-4)
    warm = []
    for cut in (2.5, 3.5, 4.5):
        split = int(np.searchsorted(block.t, cut))
        first = Estimator(parse_system(AXIS, "axis.toml"), block.channels, "axis")
        first.push(Block(block.t[:split], block.channels, block.values[:split]))
        assert first.momentum is not None
        warm.append(first.momentum.fit.state.warm is not None)
        second = Estimator(parse_system(AXIS, "axis.toml"), block.channels, "axis")
        resumed(second, first)
        second.push(Block(block.t[split:], block.channels, block.values[split:]))
        second.finish()
        assert results_document(second, 0.0, []) == results_document(fitted(block), 0.0, [])
    assert any(warm)
    assert not all(warm)


def test_nominal_values_never_enter_the_estimate() -> None:
    block = axis_session(np.arange(800) / 200.0, noise=1e-4)
    other = parse_system(AXIS.replace(f"zz = {INERTIA}", "zz = 7.0").replace(f"= {DAMPING} }}", "= 5.0 }"), "axis.toml")
    assert build_model(other).nominal.tolist() != build_model(parse_system(AXIS, "axis.toml")).nominal.tolist()
    estimator = session_of(other, [block])
    np.testing.assert_array_equal(estimator.estimate().pi, fitted(block).estimate().pi)
