"""Torques whose noise their samples do not show: said with its size, where what rows leave does not last."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

import sms_online as sms
from sms_online.description.parse import parse_system
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.persistence import LEAST_WINDOWS, Persistence
from sms_online.row_types import Residual
from sms_online.verdict.torque_noise import noisy_torques
from tests.axis import AXIS, DAMPING, INERTIA
from tests.axis_effects import BARE, COGGING, RATE, Force, axis_block, cogging, nothing

# Noise of the axis's torque, N m and s: that of neighbouring samples differs by a quarter of it.
COLOURED, MEMORY = 0.05, 0.03


def coloured(seed: int, seconds: float = 20.0, force: Force = nothing) -> sms.Capture:
    """The axis, with noise of first order in its torque beside the white one."""
    block, memory = axis_block(force, seconds=seconds, seed=seed), np.exp(-1.0 / (MEMORY * RATE))
    white = np.random.default_rng(100 + seed).standard_normal(block.t.size)
    noise = COLOURED * lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], white)
    return sms.Capture.from_arrays(block.t, {"force_1": block.values[:, 0] + noise, "q_1": block.values[:, 1]})


@cache
def estimated(seed: int) -> sms.Result:
    return sms.estimate(parse_system(AXIS, "axis.toml"), coloured(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3, 4))])
def test_noise_that_samples_do_not_show_is_said(seed: int) -> None:
    result = estimated(seed)
    residual = result.residuals["joint_1"]
    assert residual.whitened is not None
    assert residual.whitened > 3.0
    assert (result.trust.level, result.trust.grave) == ("doubt", False)
    assert "force_1" in result.trust.reasons[0]
    assert "sms-online diagnose" in result.trust.next_step
    assert "state noise: force_1" in result.trust.next_step
    true = {"link_1.inertia": INERTIA, "viscous_friction@joint_1.damping": DAMPING}
    for name, value in true.items():
        found = result.parameters[name]
        assert found.value == pytest.approx(value, abs=4.0 * found.std), name


@pytest.mark.long
def test_a_diagnosis_does_not_call_it_clean() -> None:
    """For such noise hides a small force that lasts."""
    found = sms.diagnose(parse_system(AXIS, "axis.toml"), coloured(1))
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert (found.trust.level, found.trust.grave) == ("doubt", False)
    assert "no known effect explains what is left" in found.trust.reasons[0]


@pytest.mark.slow
def test_an_effect_beside_such_noise_is_named() -> None:
    """What it leaves does not last, and is no force that no effect explains."""
    found = sms.diagnose(parse_system(AXIS, "axis.toml"), coloured(1, force=cogging))
    assert (found.verdict, [each.effect for each in found.effects]) == ("named", ["cogging@joint_1"])
    assert found.effects[0].coefficients["amplitude"].value == pytest.approx(COGGING, rel=0.1)
    assert (found.trust.level, found.trust.grave) == ("doubt", False)
    assert "the parameters are trusted" not in found.trust.sentence
    assert found.trust.next_step.startswith("if these torques are known to be so noisy, state noise: force_1")


def test_once_it_is_stated_rows_leave_noise() -> None:
    stated = estimated(1).trust.next_step.rsplit(" ", 1)[1]
    system = parse_system(f'{AXIS}\n[[sensor]]\nchannels = ["force_1"]\nnoise = {stated}\n', "axis.toml")
    result = sms.estimate(system, coloured(1))
    assert result.trust.level == "trust"
    assert result.residuals["joint_1"].whitened == pytest.approx(1.0, abs=0.3)


def test_a_force_that_the_model_lacks_stays_grave() -> None:
    """Viscous friction, which nobody has described."""
    result = sms.estimate(BARE, [axis_block(nothing)])
    assert result.trust.grave
    assert all("noise that samples show" not in reason for reason in result.trust.reasons)


@pytest.mark.parametrize(
    ("kind", "passes"),
    [("noise", True), ("slow", False), ("sine", False), ("few", False)],
    ids=lambda value: str(value),
)
def test_only_what_does_not_last_passes(kind: str, passes: bool) -> None:
    """Noise of windows that overlap, and forces whose periods are twelve windows or one."""
    rng, windows = np.random.default_rng(3), LEAST_WINDOWS - 1 if kind == "few" else 500
    weight = np.sin(np.pi * np.arange(1, HOPS) / HOPS) ** 3  # of the samples in a window
    weight /= np.linalg.norm(weight)
    white = np.convolve(rng.standard_normal(windows + HOPS - 2), weight, mode="valid")
    t = np.arange(windows)
    slow, sine = np.sin(t / 20.0), np.sin(2.0 * np.pi * t / HOPS)
    force = {"slow": slow, "small": 0.6 * slow, "sine": sine}.get(kind, 0.0 * t)
    persistence = Persistence()
    for left in white + force:
        persistence.push(np.array([[0.0, -left]]))
    assert persistence.passing(np.zeros(1)).tolist() == [passes]


@pytest.mark.parametrize(
    ("row", "residual", "passing", "noisy"),
    [
        ("joint_1", Residual(0.05, 6.0), True, {"joint_1": ("tau_1", 0.06)}),
        ("joint_1", Residual(0.05, 6.0), False, {}),
        ("joint_1", Residual(0.3, 6.0), True, {}),
        ("joint_1", Residual(0.05, 1.2), True, {}),
        ("link_1", Residual(None, 6.0), True, {}),
    ],
)
def test_a_torque_is_noisy_where_nothing_else_is_left(
    row: str, residual: Residual, passing: bool, noisy: dict[str, tuple[str, float]]
) -> None:
    every = {"joint_2": Residual(0.01, 1.0), row: residual}
    found = noisy_torques(every, {"joint_1": ("tau_1", 0.01)} if passing else {})
    assert list(found) == list(noisy)
    for name, (channel, std) in noisy.items():
        assert found[name][0] == channel
        assert found[name][1] == pytest.approx(std)
