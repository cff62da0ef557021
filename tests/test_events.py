"""Changes while a session runs: found in time, named, sized; the other parameters keep what is known of them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.description.bodies import Inertia, RigidBody
from sms_online.description.parse import parse_system
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import check_effect
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.event_hypotheses import everything
from sms_online.pipeline.events import Event
from sms_online.pipeline.momentum_balance import half_widths
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array, Block
from sms_online.trackers.factor import solve, triangular_factor
from sms_online.trackers.information import Information
from sms_sim.simulate import Simulation
from sms_tools.report import trust_lines
from tests.axis import AXIS, DAMPING, INERTIA
from tests.changed_session import changed_session, noisy
from tests.evaluated import judged, results_document, standard_deviation
from tests.model_systems import tree
from tests.saved import resumed

PLANAR = load_system("paper-planar")
CHANGE = 10.0  # s
DETECTED = 0.3  # s of data after a change, the whole lag of the pipeline counted


def stiffness_lost(i: int, share: float) -> System:
    """The planar example with a joint that has lost a share of its stiffness."""
    joints = list(PLANAR.joints)
    joints[i - 1] = joints[i - 1].model_copy(update={"stiffness": (1.0 - share) * joints[i - 1].stiffness})
    return PLANAR.model_copy(update={"joints": tuple(joints)})


def friction(name: str, joint: int, **coefficients: float) -> System:
    """The planar example with an effect at a joint."""
    effect = Effect(name=name, where=f"joint_{joint}", coefficients=coefficients)
    return PLANAR.model_copy(update={"effects": (effect,)})


def run(block: Block, size: int = 64, system: System = PLANAR) -> tuple[Estimator, float]:
    """The session's estimator, and when (s) the newest sample had come with which a change was noticed, inf if none."""
    estimator, noticed = Estimator(system, block.channels, "test"), np.inf
    for piece in block.pieces(size):
        estimator.push(piece)
        assert estimator.momentum is not None
        if estimator.momentum.changes.detector.alarm is not None:
            noticed = min(noticed, float(piece.t[-1]))
    estimator.finish()
    return estimator, noticed


def only_event(estimator: Estimator) -> Event:
    assert len(estimator.events) == 1
    return estimator.events[0]


def true_values() -> Array:
    model = build_model(PLANAR)
    return find_base_parameters(model).values(model.nominal)


@pytest.mark.long
def test_a_payload_at_the_tip_is_sized_and_disturbs_nothing(
    planar_session: Simulation,
) -> None:
    """5 kg at grade B: noticed within 0.3 s, within 0.5 % two seconds after that, all else within 4 σ."""
    loaded = PLANAR.model_copy(update={"payload": RigidBody(mass=5.0)})
    block = noisy(PLANAR, changed_session(planar_session, loaded, CHANGE, CHANGE + DETECTED + 2.0), "B", 1)
    estimator, noticed = run(block)
    assert CHANGE < noticed <= CHANGE + DETECTED
    event = only_event(estimator)
    assert (event.kind, event.parameters, event.units) == ("payload", ("payload.mass",), ("kg",))
    assert event.time == pytest.approx(CHANGE, abs=0.01)
    assert event.sizes[0] == pytest.approx(5.0, abs=4.0 * event.stds[0])
    estimate = estimator.estimate()
    assert estimator.base.parameters[-1].name == "payload.mass"
    assert estimate.pi[-1] == pytest.approx(5.0, rel=0.005)
    assert estimate.pi[-1] == pytest.approx(5.0, abs=4.0 * estimate.std[-1])
    assert (np.abs(estimate.pi[:-1] - true_values()) < 4.0 * estimate.std[:-1]).all()
    # Ten windows of 0.4 s reach across any instant, and four more the filter and the guard around it.
    assert 10 <= event.dropped_windows <= 14
    document = results_document(estimator, 0.0, [])
    assert document["parameters"][-1]["name"] == "payload.mass"
    assert document["events"][0]["parameters"][0]["size"] == event.sizes[0]
    line = f"event at {event.time:.3f} s: payload payload.mass {event.sizes[0]:+.4g} ±"
    assert any(each.startswith(line) for each in trust_lines(document))


@pytest.mark.long
def test_a_payload_is_noticed_anywhere_in_a_block(planar_session: Simulation) -> None:
    """The same 5 kg, in sessions that begin at 3 s and up to a block later."""
    loaded = PLANAR.model_copy(update={"payload": RigidBody(mass=5.0)})
    block = noisy(PLANAR, changed_session(planar_session, loaded, CHANGE, CHANGE + DETECTED), "B", 1)
    longest = round(PLANAR.windows.momentum * PLANAR.sample_rate / HOPS)
    for phase in range(0, longest, longest // 5):
        late = slice(round(3.0 * PLANAR.sample_rate) + phase, None)
        _, noticed = run(Block(block.t[late], block.channels, block.values[late]), size=1)
        assert CHANGE < noticed <= CHANGE + DETECTED


@pytest.mark.long
def test_a_body_at_the_tip_is_distinguished_from_a_point_mass(planar_session: Simulation) -> None:
    body = RigidBody(mass=5.0, center_of_mass=(0.15, 0.05, 0.0), inertia=Inertia(zz=0.3))
    loaded = PLANAR.model_copy(update={"payload": body})
    block = noisy(PLANAR, changed_session(planar_session, loaded, CHANGE, CHANGE + 2.0), "B", 1)
    estimator, _ = run(block)
    event = only_event(estimator)
    true = [0.3 + 5.0 * (0.15**2 + 0.05**2), 5.0 * 0.15, 5.0 * 0.05, 5.0]
    assert event.parameters == tuple(
        f"payload.{part}" for part in ("inertia", "first_moment_x", "first_moment_y", "mass")
    )
    assert (np.abs(np.array(event.sizes) - true) < 4.0 * np.array(event.stds)).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("after", "kind", "parameter", "size"),
    [
        (stiffness_lost(1, 0.1), "stiffness", "joint_1.stiffness", -100.0),
        (friction("viscous_friction", 1, damping=2.0), "friction", "viscous_friction@joint_1.damping", 2.0),
        (friction("coulomb_friction", 2, torque=2.0), "friction", "coulomb_friction@joint_2.torque", 2.0),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_changed_is_named_and_sized_and_nothing_else(
    planar_session: Simulation, after: System, kind: str, parameter: str, size: float
) -> None:
    block = noisy(PLANAR, changed_session(planar_session, after, CHANGE, CHANGE + 2.0), "B", 1)
    estimator, noticed = run(block)
    event = only_event(estimator)
    assert CHANGE < noticed < CHANGE + 0.6
    assert (event.kind, event.parameters) == (kind, (parameter,))
    assert event.time == pytest.approx(CHANGE, abs=0.01)
    assert event.sizes[0] == pytest.approx(size, abs=4.0 * event.stds[0])
    estimate, true = estimator.estimate(), true_values()
    names = [p.name for p in estimator.base.parameters]
    if parameter in names[: true.size]:
        true[names.index(parameter)] += size
    assert (np.abs(estimate.pi[: true.size] - true) < 4.0 * estimate.std[: true.size]).all()


@pytest.mark.long
@pytest.mark.parametrize("grade", ["A", "B", "C"])
def test_nothing_is_noticed_where_nothing_changes(planar_session: Simulation, grade: str) -> None:
    block = noisy(PLANAR, changed_session(planar_session, PLANAR, CHANGE, CHANGE + 2.0), grade, 3)
    estimator, noticed = run(block)
    assert estimator.events == []
    assert noticed == np.inf


# An axis that is measured by hand, for what needs no simulation.
SYSTEM = parse_system(AXIS, "axis.toml")
RATE = 200.0


@cache
def axis_session(damping: float, inertia: float, seconds: float = 16.0) -> Block:
    """A moved axis whose damping and inertia are other ones from 10 s on."""
    t = np.arange(round(seconds * RATE)) / RATE
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate, acceleration = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t), -4 * np.sin(2 * t) - 7.5 * np.sin(5 * t)
    late = t > CHANGE
    torque = np.where(late, inertia, INERTIA) * acceleration + np.where(late, damping, DAMPING) * rate
    noise = np.random.default_rng(5).standard_normal((t.size, 2)) * [0.05, 1e-4]
    return Block(t, ("force_1", "q_1"), np.stack((torque, q), axis=1) + noise)


@pytest.mark.slow
def test_a_small_change_is_noticed_once_it_has_lasted() -> None:
    """Damping three tenths higher shows in no two windows alone: the cumulative sum finds it."""
    estimator, noticed = run(axis_session(1.3 * DAMPING, INERTIA, 24.0), system=SYSTEM)
    event = only_event(estimator)
    assert event.parameters == ("viscous_friction@joint_1.damping",)
    assert CHANGE + DETECTED < noticed < CHANGE + 5.0
    assert event.sizes[0] == pytest.approx(0.3 * DAMPING, abs=4.0 * event.stds[0])


def test_a_payload_that_is_one_body_with_its_link_is_named() -> None:
    estimator, _ = run(axis_session(DAMPING, 1.1 * INERTIA), system=SYSTEM)
    event = only_event(estimator)
    assert event.parameters == ("payload.inertia",)
    assert event.sizes[0] == pytest.approx(0.1 * INERTIA, abs=4.0 * event.stds[0])
    errors = np.abs(estimator.estimate().pi - [INERTIA, DAMPING, 0.1 * INERTIA])
    assert (errors < 4.0 * standard_deviation(estimator)).all()


@pytest.mark.slow
def test_what_nothing_explains_starts_the_estimate_anew() -> None:
    """A sensor that begins to read four thirds of the torque and another angle is no change of one parameter."""
    block = axis_session(DAMPING, INERTIA)
    values = block.values.copy()
    late = block.t > CHANGE
    values[late, 0] += np.sin(9.0 * block.t[late]) + 0.4 * np.sin(3.1 * block.t[late])
    estimator, _ = run(Block(block.t, block.channels, values), system=SYSTEM)
    assert estimator.events[0].kind == "unexplained"
    assert estimator.events[0].parameters == ()
    # Ten windows reach across any instant, ten more across the widest filter; an alarm comes a few after the first.
    assert estimator.events[0].dropped_windows <= 24


def test_a_session_that_ends_upon_a_change_keeps_its_estimate() -> None:
    block = axis_session(2.0 * DAMPING, INERTIA)
    early = block.t < CHANGE + 0.9
    estimator, _ = run(Block(block.t[early], block.channels, block.values[early]), system=SYSTEM)
    assert only_event(estimator).kind == "undecided"
    assert "a change at 10.0 s came too late" in judged(estimator).sentence
    errors = np.abs(estimator.estimate().pi - [INERTIA, DAMPING])
    assert (errors < 4.0 * standard_deviation(estimator)).all()


@pytest.mark.long
@pytest.mark.parametrize("size", [1, 333])
def test_events_do_not_depend_on_how_samples_arrive(size: int) -> None:
    block = axis_session(2.0 * DAMPING, 1.1 * INERTIA)
    whole, parts = run(block, block.t.size, SYSTEM)[0], run(block, size, SYSTEM)[0]
    assert whole.events
    assert whole.events == parts.events
    assert np.array_equal(whole.estimate().pi, parts.estimate().pi)


@pytest.mark.long
@pytest.mark.parametrize("saved_at", [9.0, 11.0, 15.0])
def test_a_saved_session_goes_on_to_the_same_bits(saved_at: float) -> None:
    """Saved before a change, while rows are held back for it, and after it."""
    block = axis_session(DAMPING, 1.1 * INERTIA)
    split = int(saved_at * RATE)
    first, second = (Block(block.t[part], block.channels, block.values[part]) for part in np.s_[:split, split:])
    whole = Estimator(SYSTEM, block.channels, "test")
    whole.push(first)
    assert whole.momentum is not None
    assert (whole.momentum.changes.detector.alarm is not None) == (saved_at == 11.0)
    continued = resumed(Estimator(SYSTEM, block.channels, "test"), whole)
    for estimator in (whole, continued):
        estimator.push(second)
        estimator.finish()
    assert only_event(whole) == only_event(continued)
    assert np.array_equal(whole.estimate().pi, continued.estimate().pi)
    assert results_document(whole, 0.0, []) == results_document(continued, 0.0, [])


def test_an_opened_parameter_takes_nothing_from_the_others() -> None:
    """Opened information equals that of the same rows with a column of the parameter's own for the rows before."""
    rng = np.random.default_rng(8)
    before, after = rng.standard_normal((2, 40, 4))
    jumped = 1
    found = Information.none(3).with_rows(before).without([jumped]).with_rows(after).solution()
    apart = np.zeros((40, 5))
    apart[:, [0, 3, 2, 4]] = before
    batch = triangular_factor(apart, np.insert(after, 3, 0.0, axis=1))
    assert found.pi == pytest.approx(solve(batch).pi[:3], rel=1e-10)
    assert found.covariance() == pytest.approx(solve(batch).covariance()[:3, :3], rel=1e-9, abs=1e-12)


@pytest.mark.slow
def test_windows_are_smoothed_with_samples_of_their_side_only() -> None:
    """The first window after an event begins a filter's half width after the guard: no sample before has any part."""
    estimator, _ = run(axis_session(2.0 * DAMPING, INERTIA), system=SYSTEM)
    assert estimator.momentum is not None
    first = estimator.momentum.changes.detector.history[0]
    width = round(SYSTEM.windows.momentum * RATE)
    assert first.end - width - half_widths(width)[-1] >= CHANGE * RATE


def test_changes_are_looked_for_where_an_effect_can_act() -> None:
    """A passive joint has no torque whose zero could change."""
    system = tree()
    every = everything(system).effects
    for effect in every:
        check_effect(system, effect, effect.key, "tree")
    offsets = {effect.where for effect in every if effect.name == "torque_offset"}
    assert offsets == {f"joint_{i}" for i, joint in enumerate(system.joints, start=1) if not joint.passive}
