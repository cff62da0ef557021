"""A drift as a hypothesis of the diagnosis: named with its rate, beside effects and steps, which stay what they are."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import sms_online as sms
from sms_online.diagnosis.drifts import may_explain
from sms_online.verdict.reasons import FOLLOW
from sms_tools.cli import main
from tests.axis import AXIS, DAMPING, INERTIA, axis_block
from tests.test_tracing import SPEEDS, WINDOWS, made_up_rows

BEGIN, SHARE, SECONDS = 6.0, 0.001, 24.0  # s, of the inertia that is lost in a second, s
RATE = -SHARE * INERTIA
RLS = '[tracker]\nkind = "rls"\n'


def system(more: str = "") -> sms.System:
    return sms.load_system(tomllib.loads(AXIS + more))


def capture(lost: np.ndarray) -> sms.Capture:
    """The axis along two sines, of whose inertia a share (N,) is lost, with sensors' noise of seed 3."""
    t = np.arange(lost.size) / 200.0
    q = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    rate = 2 * np.cos(2 * t) + 1.5 * np.cos(5 * t)
    torque = np.gradient(INERTIA * (1.0 - lost) * rate, t, edge_order=2) + DAMPING * rate
    noise = np.random.default_rng(3).standard_normal((2, t.size))
    return sms.Capture.from_arrays(t, {"force_1": torque + 0.01 * noise[0], "q_1": q + 1e-4 * noise[1]})


@pytest.fixture(scope="module")
def drifting() -> sms.Capture:
    t = np.arange(round(200 * SECONDS)) / 200.0
    return capture(SHARE * np.maximum(0.0, t - BEGIN))


@pytest.fixture(scope="module")
def found(drifting: sms.Capture) -> sms.Diagnosis:
    return sms.diagnose(system(RLS), drifting)


@pytest.mark.slow
def test_a_drift_is_named_with_rate_and_value(found: sms.Diagnosis) -> None:
    assert found.verdict == "named"
    assert found.effects == ()
    (drift,) = found.drifts
    assert drift.parameter == "link_1.inertia"
    assert drift.since == pytest.approx(BEGIN, abs=2.0)
    assert drift.rate == pytest.approx(RATE, abs=4.0 * drift.std)
    assert drift.std < 0.2 * abs(RATE)
    assert drift.value == pytest.approx(INERTIA + RATE * (SECONDS - BEGIN), abs=4.0 * drift.value_std)
    assert found.summary.startswith("Link_1.inertia drifts since")
    assert "the residual is noise" in found.summary


@pytest.mark.slow
def test_the_system_that_was_found_follows_the_drift(found: sms.Diagnosis, drifting: sms.Capture) -> None:
    assert (found.trust.level, found.trust.grave) == ("doubt", False)
    assert found.trust.grounds[0].then == FOLLOW
    result = sms.estimate(found.system, drifting)
    assert result.trust.level == "trust"
    assert [drift.parameter for drift in result.drifts] == ["link_1.inertia"]


@pytest.mark.slow
def test_a_drift_that_is_followed_already_is_trusted(drifting: sms.Capture) -> None:
    again = sms.diagnose(system(), drifting)
    assert [drift.parameter for drift in again.drifts] == ["link_1.inertia"]
    assert again.trust.level == "trust"


@pytest.fixture(scope="module")
def from_the_start() -> sms.Capture:
    return capture(10.0 * SHARE * np.arange(round(200 * SECONDS)) / 200.0)


@pytest.mark.slow
@pytest.mark.parametrize("more", ["", RLS])
def test_a_drift_from_the_start_is_named(more: str, from_the_start: sms.Capture) -> None:
    found = sms.diagnose(system(more), from_the_start)
    (drift,) = found.drifts
    assert drift.parameter == "link_1.inertia"
    assert drift.rate == pytest.approx(10.0 * RATE, abs=4.0 * drift.std)
    assert found.effects == ()


@pytest.mark.slow
def test_by_default_a_drift_from_the_start_is_followed(from_the_start: sms.Capture) -> None:
    """Rows leave more than noise before it is found; that is no lack of the model."""
    result = sms.estimate(system(), from_the_start)
    inertia, (drift,) = result.parameters["link_1.inertia"], result.drifts
    assert inertia.value == pytest.approx(INERTIA + 10.0 * RATE * SECONDS, abs=4.0 * inertia.std)
    assert drift.since < 2.0
    assert result.trust.level == "trust"


@pytest.mark.slow
def test_by_default_friction_from_the_start_is_weighed_as_by_least_squares() -> None:
    block = axis_block(coulomb=0.05)
    values = dict(zip(block.channels, block.values.T, strict=True))
    data = sms.Capture.from_arrays(block.t, values)
    learned, squares = (sms.estimate(system(more), data) for more in ("", RLS))
    assert learned.drifts == ()
    assert [(p.value, p.std) for p in learned.parameters.values()] == [
        (p.value, p.std) for p in squares.parameters.values()
    ]


@pytest.mark.slow
def test_a_steady_axis_has_no_drift() -> None:
    found = sms.diagnose(system(), capture(np.zeros(2400)))
    assert (found.verdict, found.drifts) == ("clean", ())


@pytest.mark.slow
def test_undeclared_friction_stays_a_missing_effect() -> None:
    block = axis_block(coulomb=0.05)
    values = dict(zip(block.channels, block.values.T, strict=True))
    found = sms.diagnose(system(), sms.Capture.from_arrays(block.t, values))
    assert found.drifts == ()
    assert [effect.name for effect in found.effects] == ["coulomb_friction"]


@pytest.mark.parametrize(("drifts", "lacks", "may"), [(0.0, 0.0, True), (20.0, 0.0, True), (0.0, 5.0, False)])
def test_what_no_drift_explains_needs_no_session(drifts: float, lacks: float, may: bool) -> None:
    """Rows of three parameters, the first of which loses so much from a third of the time on; or another force."""
    rng = np.random.default_rng(4)
    Y, noise = rng.standard_normal((WINDOWS, SPEEDS, 3)), rng.standard_normal((WINDOWS, SPEEDS))
    lost = drifts * np.maximum(0.0, np.linspace(-0.5, 1.0, WINDOWS))
    b = Y @ np.ones(3) - lost[:, None] * Y[..., 0] + lacks * rng.standard_normal(noise.shape) + noise
    assert may_explain(made_up_rows(Y, b)) == may


@pytest.mark.slow
def test_a_step_is_a_jump_and_no_drift() -> None:
    t = np.arange(3200) / 200.0
    found = sms.diagnose(system(), capture(np.where(t < 8.0, 0.0, 0.2))).document()
    assert found["drifts"] == []
    (change,) = found["changes"]
    assert change["time"] == pytest.approx(8.0, abs=0.2)
    assert found["judgement"]["level"] == "doubt"


@pytest.mark.slow
def test_the_command_writes_a_system_file_that_follows(tmp_path: Path, drifting: sms.Capture) -> None:
    (tmp_path / "axis.toml").write_text(AXIS + RLS, encoding="utf-8")
    sms.write_capture(drifting, tmp_path / "run.csv")
    options = ["--system", str(tmp_path / "axis.toml"), "--out", str(tmp_path / "found"), "--rerun", "off"]
    assert main(["diagnose", str(tmp_path / "run.csv"), *options]) == 0
    document = json.loads((tmp_path / "found" / "diagnosis.json").read_text(encoding="utf-8"))
    assert [drift["parameter"] for drift in document["drifts"]] == ["link_1.inertia"]
    assert "link_1.inertia drifts since" in document["drifts"][0]["sentence"]
    assert sms.load_system(tmp_path / "found" / "system.toml").trackers[0].learns
    page = (tmp_path / "found" / "diagnosis.html").read_text(encoding="utf-8")
    assert "drifts since" in page
