"""A running session goes on with effects that act before the balances: on channels, with states, beside masses."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

import sms_online as sms
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.online import OnlineDiagnosis, refusal
from sms_online.diagnosis.online_search import Immediate
from sms_online.effects.base import dahl_rate
from sms_online.effects.build import build_model, declaring
from sms_online.effects.catalogue import channel_effects
from sms_online.model.base_parameters import find_base_parameters
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Array, Block
from tests.axis import DAMPING, INERTIA
from tests.axis_effects import COGGING, RATE, SYSTEM, axis_block, cogging, nothing
from tests.evaluated import results_document
from tests.saved import resumed

BEGIN = 8.0  # s
LAG = Effect(name="sensor_lag", where="q_1", coefficients={"corner": 8.0})
ECCENTRIC = Effect(name="encoder_eccentricity", where="q_1", coefficients={"amplitude": 0.02, "phase": 0.5})
FRICTION, WIDTH = 0.2, 0.05  # N m, rad
SUBSTEPS = 20


def distorted(effect: Effect, begin: float = BEGIN, seconds: float = 16.0) -> Block:
    """The axis, whose encoder an effect distorts from an instant on, s."""
    block = axis_block(nothing, seconds=seconds)
    (distorting,) = channel_effects(declaring(SYSTEM, [effect]))
    angle = np.sin(2 * block.t) + 0.3 * np.sin(5 * block.t)
    values = block.values.copy()
    values[:, 1] += np.where(block.t >= begin, distorting.distort(angle, RATE) - angle, 0.0)
    return Block(block.t, block.channels, values)


def sticking() -> Block:
    """The axis, with friction that slides only after a way of some degrees: Dahl's law, by Euler's small steps."""

    def friction(q: Array, rate: Array) -> Array:
        z, out = np.zeros(1), np.zeros(q.size)
        for k in range(round(BEGIN * RATE), q.size):
            out[k] = FRICTION * z[0] / WIDTH
            for step in range(SUBSTEPS if k + 1 < q.size else 0):
                between = rate[k] + (rate[k + 1] - rate[k]) * step / SUBSTEPS
                z = z + dahl_rate(np.array([between]), z[None], WIDTH)[0] / (RATE * SUBSTEPS)
        return out

    return axis_block(friction, BEGIN)


def watched(block: Block, system: System = SYSTEM, size: int = 64) -> tuple[Estimator, OnlineDiagnosis]:
    estimator = Estimator(system, block.channels, "test")
    online = OnlineDiagnosis(estimator, Immediate(), adopt=True)
    for piece in block.pieces(size):
        estimator.push(piece)
    estimator.finish()
    return estimator, online


def assert_true(estimator: Estimator, true: dict[str, float]) -> None:
    """Estimates are within four deviations of the truth, and rows leave no more than noise."""
    estimate = estimator.estimate()
    names = [p.name for p in estimator.base.parameters]
    for name, value in true.items():
        k = names.index(name)
        assert estimate.pi[k] == pytest.approx(value, abs=4.0 * estimate.std[k]), name
    assert estimator.momentum is not None
    assert not estimator.momentum.misfit


AXIS = {"link_1.inertia": INERTIA, "viscous_friction@joint_1.damping": DAMPING}


@pytest.mark.parametrize("effect", [LAG, pytest.param(ECCENTRIC, marks=pytest.mark.slow)], ids=lambda e: e.name)
def test_what_begins_on_a_channel_is_corrected(effect: Effect) -> None:
    estimator, online = watched(distorted(effect))
    (episode,), (event,) = online.episodes, estimator.events
    assert (episode.verdict, episode.refused) == ("named", None)
    assert episode.adopted is not None
    assert event.kind == "effect"
    assert event.time == pytest.approx(BEGIN, abs=0.4)
    for name, size, std in zip(event.parameters, event.sizes, event.stds, strict=True):
        key, _, coefficient = name.rpartition(".")
        assert key == effect.key
        assert size == pytest.approx(effect.coefficients[coefficient], abs=4.0 * std)
    # Its constants are no parameters.
    assert [p.name for p in estimator.base.parameters] == list(AXIS)
    assert_true(estimator, AXIS)


@pytest.mark.slow
def test_friction_with_a_state_that_begins_is_estimated() -> None:
    estimator, online = watched(sticking())
    (episode,) = online.episodes
    assert [named.key for named in episode.named] == ["presliding_friction@joint_1"]
    assert episode.adopted is not None
    assert_true(estimator, AXIS | {"presliding_friction@joint_1.torque": FRICTION})


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: distorted(LAG), sticking], ids=["channel", "state"])
def test_it_is_the_same_sample_by_sample_and_resumed(make: Callable[[], Block]) -> None:
    block = make()
    split = 13 * 200
    estimator, online = watched(block)
    single, other = watched(block, size=1)
    assert json.dumps([results_document(single, 0.0, []), other.document()]) == json.dumps(
        [results_document(estimator, 0.0, []), online.document()]
    )
    first, second = (Block(block.t[part], block.channels, block.values[part]) for part in np.s_[:split, split:])
    running = Estimator(SYSTEM, block.channels, "test")
    OnlineDiagnosis(running, Immediate(), adopt=True)
    running.push(first)
    assert running.events
    continued = resumed(Estimator(SYSTEM, block.channels, "test"), running)
    continued.push(second)
    continued.finish()
    assert results_document(continued, 0.0, []) == results_document(estimator, 0.0, [])


def part(block: Block, kept: NDArray[np.bool_]) -> Block:
    return Block(block.t[kept], block.channels, block.values[kept])


@pytest.mark.long
def test_two_updates_with_a_gap_behind_them_are_resumed() -> None:
    """A lag from 6 s on, cogging from 14 s on, no samples from 20 to 20.6 s; saved between, and after both."""
    lagged, cogged = distorted(LAG, begin=6.0, seconds=26.0), axis_block(cogging, 14.0, seconds=26.0)
    values = np.stack((cogged.values[:, 0], lagged.values[:, 1]), axis=1)
    block = part(Block(cogged.t, cogged.channels, values), (cogged.t < 20.0) | (cogged.t > 20.6))
    estimator, online = watched(block)
    assert [episode.named[0].key for episode in online.episodes] == ["sensor_lag@q_1", "cogging@joint_1"]
    assert_true(estimator, AXIS | {"cogging@joint_1.cosine": COGGING * np.cos(0.5)})
    for time in (11.0, 17.0):
        running = Estimator(SYSTEM, block.channels, "test")
        OnlineDiagnosis(running, Immediate(), adopt=True)
        running.push(part(block, block.t < time))
        continued = resumed(Estimator(SYSTEM, block.channels, "test"), running)
        OnlineDiagnosis(continued, Immediate(), adopt=True)
        for each in (running, continued):
            each.push(part(block, block.t >= time))
            each.finish()
        assert results_document(running, 0.0, []) == results_document(estimator, 0.0, [])
        assert [event.kind for event in continued.events] == ["effect", "effect"]
        assert_true(continued, AXIS)


@pytest.mark.slow
@pytest.mark.parametrize("behind", [0.02, 0.14, 0.3])
def test_an_update_just_behind_a_gap_loses_nothing(behind: float) -> None:
    """The segment at the update, which comes at 10.2 s, is shorter than what takes the lag off."""
    block = distorted(LAG)
    estimator, online = watched(part(block, (block.t < 9.7 - behind) | (block.t > 10.2 - behind)))
    (episode,) = online.episodes
    assert episode.adopted is not None
    assert_true(estimator, AXIS)


@pytest.mark.slow
def test_samples_behind_an_update_are_corrected_by_the_point() -> None:
    """An encoder half a millisecond late, which moves the point that rows are linear about; then cogging, from 12 s."""
    clean, t = axis_block(cogging, 12.0, seconds=20.0), np.arange(round(20.0 * RATE)) / RATE

    def angle(t: Array) -> Array:
        return np.asarray(np.sin(2 * t) + 0.3 * np.sin(5 * t))

    late = clean.values[:, 1] + angle(t - 5e-4) - angle(t)
    estimator, _ = watched(Block(t, clean.channels, np.stack((clean.values[:, 0], late), axis=1)), size=8)
    assert estimator.momentum is not None
    assert estimator.momentum.point()[0] == pytest.approx(5e-4, rel=0.1)
    assert [event.kind for event in estimator.events] == ["effect"]
    assert (np.diff(estimator.momentum.changes.state.index) == 1).all()
    assert_true(estimator, AXIS)


@pytest.mark.slow
def test_a_parameter_that_an_event_has_added_is_resumed() -> None:
    block = axis_block(lambda q, rate: 0.3 * np.sign(rate), BEGIN)
    running = Estimator(SYSTEM, block.channels, "test")
    running.push(part(block, block.t < 13.0))
    assert running.momentum is not None
    assert running.momentum.changes.added == ("coulomb_friction@joint_1.torque",)
    continued = resumed(Estimator(SYSTEM, block.channels, "test"), running)
    for each in (running, continued):
        each.push(part(block, block.t >= 13.0))
        each.finish()
    assert results_document(continued, 0.0, []) == results_document(running, 0.0, [])


@pytest.mark.slow
def test_a_declared_correction_is_made_once_in_a_search() -> None:
    """An encoder whose lag is known, and cogging that nobody knows of, are no second lag."""
    clean, lagged = axis_block(cogging, BEGIN), distorted(LAG, begin=0.0)
    block = Block(clean.t, clean.channels, np.stack((clean.values[:, 0], lagged.values[:, 1]), axis=1))
    estimator, online = watched(block, declaring(SYSTEM, [LAG]))
    (episode,) = online.episodes
    assert [named.key for named in episode.named] == ["cogging@joint_1"]
    assert episode.adopted is not None
    assert_true(estimator, AXIS | {"cogging@joint_1.cosine": COGGING * np.cos(0.5)})


def test_a_model_with_states_is_not_updated() -> None:
    with_state = declaring(SYSTEM, [Effect(name="presliding_friction", where="joint_1")])
    assert refusal(build_model(SYSTEM)) is None
    assert "internal states" in (refusal(build_model(with_state)) or "")


@pytest.mark.long
def test_a_tilt_that_is_found_while_running_is_estimated() -> None:
    """Nothing else is known of it: its search is made with masses that it has moved by a sixth. Seed 3."""
    planar = sms.load_system("paper-planar")
    tilted = ["table_tilt@base:gravity_x=0.003,gravity_y=-0.002"]
    data = sms.simulate(planar, duration=16.0, grade="B", seed=3, effects=tilted)
    result = sms.estimate(planar, data, adopt=True)
    model = build_model(planar)
    true = find_base_parameters(model).values(model.nominal)
    for parameter, value in zip(result.parameters.values(), [*true, 0.003, -0.002], strict=True):
        assert parameter.value == pytest.approx(value, abs=4.0 * parameter.std), parameter.name
    assert result.trust.level == "trust"
