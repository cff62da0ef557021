"""The sequential test of residuals: quiet on noise at the stated rate, alarmed by more, at the right row."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2

from sms_adapters.system_file import load_system
from sms_online.description.parse import parse_system
from sms_online.model.layout import build_layout
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.residual_test import NOISE, SequentialTest, _ratio
from sms_online.pipeline.white_rows import WhiteRows
from sms_online.stream import Array
from sms_online.trackers.factor import triangular_factor
from tests.axis import AXIS
from tests.saved import resumed

LAYOUT = build_layout(load_system("paper-planar"))
HOP = 0.04  # s
N = 3  # parameters


def after(errors: Array, known: int = 40, seed: int = 1) -> SequentialTest:
    """The test after windows of rows Y β + errors (W, n_v), with as many windows before that give β."""
    rng = np.random.default_rng(seed)
    n_v = errors.shape[1]
    test = SequentialTest(LAYOUT if n_v > 1 else build_layout(parse_system(AXIS, "axis")), HOP)
    beta = np.arange(1.0, N + 1.0)
    factor = np.zeros((N + 1, N + 1))
    before = rng.standard_normal((known * n_v, N))
    factor = triangular_factor(factor, np.column_stack((before, before @ beta + rng.standard_normal(len(before)))))
    for k, error in enumerate(errors):
        Y = rng.standard_normal((n_v, N))
        raw = np.column_stack((Y, Y @ beta + error))
        test.push(
            WhiteRows(
                raw,
                np.stack((raw, raw)),
                raw,
                np.eye(n_v),
                np.eye(n_v),
                40 * k,
                np.empty((n_v, 0)),
                np.zeros(n_v),
                beta,
                True,
                np.empty((n_v, 0)),
                np.empty((n_v, 0)),
            ),
            factor,
        )
        factor = triangular_factor(factor, raw)
    return test


def noise(windows: int, seed: int, n_v: int = LAYOUT.n_v) -> Array:
    return np.random.default_rng(seed).standard_normal((windows, n_v))


def test_noise_as_large_as_it_may_be_does_not_alarm() -> None:
    """Two minutes of windows, seed 2, errors a tenth above what is predicted."""
    test = after(np.sqrt(NOISE) * noise(3000, 2))
    assert test.alarm is None
    assert max(test.evidence.values()) < 0.6


@pytest.mark.parametrize("freedom", [1, 4])
def test_the_likelihood_ratio_keeps_the_stated_rate(freedom: int) -> None:
    """The expectation of its exponential, behind Lorden's bound, is 1 at the largest noise and less below."""

    def expectation(variance: float) -> float:
        return float(quad(lambda x: chi2.pdf(x, freedom) * np.exp(_ratio(variance * x, freedom)), 0.0, 400.0)[0])

    assert expectation(NOISE) == pytest.approx(1.0, abs=1e-6)
    assert expectation(1.0) < 0.9


@pytest.mark.parametrize(("speed", "row"), [(LAYOUT.theta_m[0], "joint_1"), (0, "base"), (LAYOUT.q[1], "link_2")])
def test_more_than_noise_is_noticed_where_it_is_and_dated(speed: int, row: str) -> None:
    """Four deviations more in one coordinate from window 200 on: within two seconds of windows; seed 4."""
    errors = noise(250, 4)
    errors[200:, speed] += 4.0
    alarm = after(errors).alarm
    assert alarm is not None
    assert alarm.row == row
    assert 40 * 200 < alarm.end <= 40 * 250
    assert 40 * 150 <= alarm.since <= 40 * (200 + HOPS)


def test_a_row_type_detects_what_no_coordinate_shows_alone() -> None:
    """Noise of a link twice as large: its χ² alarms long before the coordinates' own sums reach the limit; seed 5."""
    errors = noise(300, 5)
    errors[100:, LAYOUT.q_f[0]] *= 2.2
    test = after(errors)
    assert test.alarm is not None
    assert test.alarm.row == "link_1"
    assert test.state.sums[:, : LAYOUT.n_v].max() < test.limit


def test_bursts_of_two_windows_do_not_alarm() -> None:
    """Ten deviations in two windows in a row, every seven seconds; seed 6."""
    errors = noise(600, 6)
    for k in range(50, 600, 175):
        errors[k : k + 2] = 10.0
    assert after(errors).alarm is None


def test_what_nothing_is_known_of_says_nothing() -> None:
    """Before a window's length of rows there is no estimate to compare with, however large they are."""
    assert after(1e3 + noise(HOPS, 7), known=0).alarm is None


def test_a_saved_test_goes_on_as_if_it_had_not_been() -> None:
    errors = noise(120, 8)
    errors[90:, 2] += 5.0
    rng = np.random.default_rng(8)
    whole, continued = SequentialTest(LAYOUT, HOP), SequentialTest(LAYOUT, HOP)
    factor = triangular_factor(rng.standard_normal((60, N + 1)))
    for k, error in enumerate(errors):
        raw = np.column_stack((np.zeros((LAYOUT.n_v, N)), error))
        eye = np.eye(LAYOUT.n_v)
        none = np.empty((LAYOUT.n_v, 0))
        rows = WhiteRows(
            raw, np.stack((raw, raw)), raw, eye, eye, k, none, np.zeros(LAYOUT.n_v), none[0], True, none, none
        )
        whole.push(rows, factor)
        if k >= 70:
            continued.push(rows, factor)
        if k == 69:
            resumed(continued, whole)
    assert whole.alarm is not None
    assert continued.alarm == whole.alarm
    assert continued.evidence == whole.evidence
    assert resumed(SequentialTest(LAYOUT, HOP), whole).alarm == whole.alarm
