"""The search among candidates, on rows that are made up: noise is white, and a candidate is a column of numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_online.description.schema import Effect
from sms_online.diagnosis.candidate import Candidate, Unmodelled
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.trace import Tracing
from sms_online.diagnosis.weak_rows import WeakRows
from sms_online.effects import catalogue
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import ENTRIES
from sms_online.model.parameters import Parameter
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.stream import Array
from tests.guide import windage
from tests.model_systems import paper

WINDOWS, SPEEDS = 300, 2
FOLDS = Folds.of(np.zeros(WINDOWS, dtype=np.int64), np.arange(WINDOWS, dtype=float))


def made_up_rows(Y: Array, b: Array) -> WeakRows:
    """Rows that are independent of each other, with unit noise."""
    rows = WeakRows(Y, b, 1000.0)
    rows.have_noise([[np.eye(SPEEDS)]] * WINDOWS)
    return rows


@dataclass
class Sticking:
    """Stiction's covariance where an axis is stuck, in a share of the session: so many times its law."""

    stuck: NDArray[np.bool_]
    share: float
    times: float

    def unmodelled(self, candidate: Candidate, coefficients: Array) -> Unmodelled:
        free = np.zeros((WINDOWS, HOPS, SPEEDS))
        if ENTRIES[candidate.effect.name].traits.dry:
            free[:, 0, 0] = np.where(self.stuck, self.times * coefficients[0], 0.0) ** 2
        return Unmodelled(np.zeros((WINDOWS, SPEEDS)), free)

    def at_rest(self, candidate: Candidate) -> float:
        return self.share

    def reported(self, effect: Effect, beta: Array, coefficients: Array) -> dict[str, float]:
        raise AssertionError("no law here has a limit")


def _candidate(name: str, column: Array) -> Candidate:
    columns = np.zeros((WINDOWS, SPEEDS, 1))
    columns[:, 0, 0] = column
    return Candidate(
        Effect(name=name, where="joint_1"), (Parameter(name, "", "N m", 0.0),), columns, ENTRIES[name].traits
    )


def _found(candidates: list[Candidate], force: Array, seed: int) -> list[str]:
    rng = np.random.default_rng(seed)
    Y = rng.standard_normal((WINDOWS, SPEEDS, 3))
    b = Y @ np.array([1.0, -2.0, 0.5]) + rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += force
    tracing = Tracing(made_up_rows(Y, b), candidates, FOLDS)
    return [tracing.candidates[k].effect.name for k in tracing.run(lambda chosen, k: None)]


@pytest.mark.parametrize("seed", range(5))
def test_what_does_not_hold_on_other_windows_takes_no_place(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    lasting, early = rng.standard_normal((2, WINDOWS))
    late = rng.standard_normal(WINDOWS)
    # Something of one stretch alone, which gains more than what is there all the time.
    stretch = np.arange(WINDOWS) < 90
    passing = np.where(stretch, early, 0.0)
    column = np.where(stretch, early, late)
    found = _found(
        [_candidate("torque_offset", column), _candidate("cogging", lasting)], 3.0 * passing + 1.5 * lasting, seed
    )
    assert found == ["cogging"]


@pytest.mark.parametrize(("drag", "found"), [(0.3, ["windage_friction"]), (-0.3, [])])
def test_the_guide_s_drag_is_named_unless_it_is_negative(
    drag: float, found: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The effect of CONTRIBUTING.md in the catalogue, by its class alone, at rates of a swinging joint (seed 3)."""
    effect = windage()
    monkeypatch.setitem(catalogue.ENTRIES, effect.entry.name, effect.entry)
    monkeypatch.setitem(catalogue.FORCE_CLASSES, effect.entry.name, effect)
    declared = next(each for each in catalogue.candidates(paper()) if each.name == effect.entry.name)
    model = build_model(paper(effects=(declared,)))
    x, v = np.zeros((WINDOWS, model.layout.n_x)), np.zeros((WINDOWS, model.layout.n_v))
    motor = model.layout.theta_m[0]
    v[:, motor] = 10.0 * np.sin(np.linspace(0.0, 60.0, WINDOWS))
    column = model.effects[0].force(model.layout, x, v, None)[:, motor, 0]
    assert _found([_candidate(declared.name, column)], drag * column, seed=3) == found


@pytest.mark.parametrize(("share", "second"), [(0.02, []), (0.1, ["cogging"])])
def test_the_error_of_a_friction_law_is_no_second_effect(share: float, second: list[str]) -> None:
    t = np.linspace(0.0, 20.0, WINDOWS)
    sign, other = np.sign(np.sin(2.0 * t)), np.sqrt(2.0) * np.sin(7.3 * t)
    candidates = [_candidate("coulomb_friction", sign), _candidate("cogging", other)]
    assert _found(candidates, 150.0 * (sign + share * other), 1) == ["coulomb_friction", *second]


@pytest.mark.parametrize(("size", "found"), [(30.0, ["cogging", "torque_offset"]), (2.5, [])])
def test_rows_may_rise_on_the_way_beside_what_falls(size: float, found: list[str]) -> None:
    """The first effect raises rows of another speed to thrice their noise, which the second one mends."""
    own, other = np.random.default_rng(11).standard_normal((2, WINDOWS))
    first, second = _candidate("cogging", own), _candidate("torque_offset", np.zeros(WINDOWS))
    first.columns[:, 1, 0], second.columns[:, 1, 0] = 3.0 * other / size, other
    assert _found([first, second], size * own, 1) == found


def test_an_effect_hidden_by_its_noise_replaces_its_substitute() -> None:
    """An axis that sticks in a tenth of the windows: there friction takes any value, and a ripple fits it better."""
    rng = np.random.default_rng(7)
    stuck = rng.random(WINDOWS) < 0.1
    held = np.where(stuck, 30.0 * rng.uniform(0.2, 1.0, WINDOWS), 0.0)
    friction, ripple = (
        _candidate("stribeck_friction", np.where(stuck, 1.0, 0.0)),
        _candidate("cogging", held + 8.0 * stuck * rng.standard_normal(WINDOWS)),
    )
    Y = rng.standard_normal((WINDOWS, SPEEDS, 3))
    b = Y @ np.array([1.0, -2.0, 0.5]) + rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += held

    rows = made_up_rows(Y, b)
    tracing = Tracing(rows, [friction, ripple], FOLDS, laws=Sticking(stuck, 0.0, 10.0))
    found = tracing.run(lambda chosen, k: None)
    assert [taken for taken, _ in tracing.path] == [1, 0]
    assert found == [0]


@pytest.mark.parametrize("ripples", [False, True])
def test_stiction_is_found_beside_columns_that_fit_it_better(ripples: bool) -> None:
    """It takes any value there, and moves nothing elsewhere; where a ripple explains all of it, there is none."""
    rng = np.random.default_rng(8)
    stuck = rng.random(WINDOWS) < 0.6
    held = np.where(stuck, rng.uniform(-3e3, 3e3, WINDOWS), 0.0)
    offset = rng.standard_normal(WINDOWS)
    b = rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += held + 2.0 * offset
    other = held if ripples else held + np.where(stuck, 800.0 * rng.standard_normal(WINDOWS), 0.0)
    candidates = [
        _candidate("stribeck_friction", np.sign(held)),
        _candidate("cogging", other),
        _candidate("torque_offset", offset),
    ]
    rows = made_up_rows(rng.standard_normal((WINDOWS, SPEEDS, 3)), b)

    def steps(share: float) -> list[list[int]]:
        tracing = Tracing(rows, candidates, FOLDS, laws=Sticking(stuck, share, 2.0))
        tracing.run(lambda chosen, k: None)
        return [chosen for _, chosen in tracing.path]

    assert steps(0.0)[0] == [1]
    assert steps(0.6) == ([[1]] if ripples else [[0], [0, 2]])


@pytest.mark.parametrize("seed", range(3))
def test_a_slow_force_is_found_in_rows_whose_noise_is_fast(seed: int) -> None:
    """Noise of neighbouring rows nearly cancels: of their variance the force makes 4 %, and of whitened rows most."""
    rng = np.random.default_rng(seed)
    x, y, torque_noise = rng.standard_normal((3, WINDOWS))
    white, size = rng.standard_normal(WINDOWS + 1), np.sqrt(1.0 + 0.95**2)
    noise = (white[1:] - 0.95 * white[:-1]) / size
    slow = np.sin(np.arange(WINDOWS) / 15.0)
    true = np.array([1.0, 1.0])
    Y = np.stack((50.0 * np.stack((x, y), axis=1), 50.0 * np.stack((x, -x), axis=1)), axis=1)
    Y[:, 1, 0] += noise - 0.3 * slow
    b = np.zeros((WINDOWS, SPEEDS))
    b[:, 0] = Y[:, 0] @ true + torque_noise
    drag, other = _candidate("air_drag", np.zeros(WINDOWS)), _candidate("cogging", rng.standard_normal(WINDOWS))
    drag.columns[:, 1, 0] = slow
    rows = WeakRows(Y, b, 1000.0)
    own, before = np.eye(SPEEDS), np.diag([0.0, -0.95 / size**2])
    rows.have_noise([[own], *([[before, own]] * (WINDOWS - 1))])
    rows.weights = true
    assert Tracing(rows, [drag, other], FOLDS).run(lambda chosen, k: None) == [0]


@pytest.mark.parametrize("seed", range(3))
def test_a_weak_torque_does_not_shrink_parameters(seed: int) -> None:
    """A torque of which most is unknown gives the scale alone: without the spring's law all else would vanish."""
    rng = np.random.default_rng(seed)
    x, y, u, v, rubbing, unknown, error = rng.standard_normal((7, WINDOWS))
    true = np.array([1.0, 1.0])
    Y = np.stack((50.0 * np.stack((x, y), axis=1), 600.0 * np.stack((u, -u - 0.3 * v), axis=1)), axis=1)
    b = np.zeros((WINDOWS, SPEEDS))
    b[:, 0] = Y[:, 0] @ true + 300.0 * unknown + 200.0 * rubbing
    friction, spring = _candidate("presliding_friction", rubbing), _candidate("cubic_stiffness", np.zeros(WINDOWS))
    spring.columns[:, 1, 0] = (error - Y[:, 1] @ true) / 300.0
    rows = made_up_rows(Y, b)
    rows.weights = true
    nowhere = Sticking(np.zeros(WINDOWS, dtype=np.bool_), 0.0, 0.0)
    tracing = Tracing(rows, [spring, friction], FOLDS, laws=nowhere)
    found = tracing.run(lambda chosen, k: None)
    assert sorted(found) == [0, 1]
    np.testing.assert_allclose(tracing.solution(found)[:2], true, rtol=0.15)


@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_a_replaced_effect_returns_for_what_the_other_leaves(times: float) -> None:
    rng = np.random.default_rng(3)
    stuck = rng.random(WINDOWS) < 0.2
    friction = np.where(stuck, np.sign(rng.standard_normal(WINDOWS)), 0.0)
    ripple = np.where(stuck, 0.0, rng.standard_normal(WINDOWS))
    b = rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += 50.0 * friction + 5.0 * ripple
    candidates = [_candidate("coulomb_friction", friction), _candidate("cogging", ripple)]
    rows = made_up_rows(rng.standard_normal((WINDOWS, SPEEDS, 3)), b)
    found = Tracing(rows, candidates, FOLDS, laws=Sticking(stuck, 0.0, times)).run(lambda chosen, k: None)
    assert sorted(found) == [0, 1]


# Constants, which rows lose to first order


def _delay(column: Array, bend: float) -> Candidate:
    columns = np.zeros((WINDOWS, SPEEDS, 1))
    columns[:, 0, 0] = column
    parameter = Parameter("sensor_lag", "", "s", 0.0)
    effect = Effect(name="sensor_lag", where="q_1")
    return Candidate(effect, (parameter,), columns, ENTRIES["sensor_lag"].traits, constant=True, bend=bend)


@pytest.mark.parametrize(("bend", "found"), [(0.1, ["sensor_lag", "cogging"]), (10.0, ["sensor_lag"])])
def test_what_a_constant_may_leave_is_no_other_effect(bend: float, found: list[str]) -> None:
    """Of a delay of 0.1 s its square by its bend: a hundredth of a percent of its gain, or all of it."""
    rng = np.random.default_rng(8)
    late, other = rng.standard_normal((2, WINDOWS))
    candidates = [_delay(100.0 * late, bend), _candidate("cogging", other)]
    assert _found(candidates, 10.0 * late + 2.0 * other, seed=8) == found


def test_a_search_goes_on_from_what_was_found_before() -> None:
    """What has nothing left to explain goes; what was missed comes to it."""
    rng = np.random.default_rng(9)
    Y = rng.standard_normal((WINDOWS, SPEEDS, 3))
    right, missed, spurious = rng.standard_normal((3, WINDOWS))
    b = Y @ np.array([1.0, -2.0, 0.5]) + rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += 2.0 * right + 1.5 * missed
    names = ("cogging", "torque_offset", "cubic_stiffness")
    candidates = [_candidate(name, c) for name, c in zip(names, (right, missed, spurious), strict=True)]
    tracing = Tracing(made_up_rows(Y, b), candidates, FOLDS)
    assert sorted(tracing.run(lambda chosen, k: None, start=[2, 0])) == [0, 1]


@pytest.mark.parametrize(("half", "ambiguous"), [(0.6, ("cogging@joint_1",)), (1.0, ())])
def test_laws_that_blocks_do_not_decide_between_are_ambiguous(half: float, ambiguous: tuple[str, ...]) -> None:
    """A force that is one of them in a part of the session, the other in the rest: one gains clearly more in all."""
    rng = np.random.default_rng(10)
    Y = rng.standard_normal((WINDOWS, SPEEDS, 3))
    first, apart, lacking = rng.standard_normal((3, WINDOWS))
    second = (first + 0.7 * apart) / np.hypot(1.0, 0.7)
    b = Y @ np.array([1.0, -2.0, 0.5]) + rng.standard_normal((WINDOWS, SPEEDS))
    b[:, 0] += 10.0 * np.where(np.arange(WINDOWS) < half * WINDOWS, first, second) + 3.0 * lacking
    candidates = [_candidate("torque_offset", first), _candidate("cogging", second)]
    tracing = Tracing(made_up_rows(Y, b), candidates, FOLDS)
    tracing.run(lambda chosen, k: None)
    finding = tracing.finding([0], 0)
    assert tracing.gains([])[1].gain < 0.97 * tracing.gains([])[0].gain
    assert finding.ambiguous == ambiguous
