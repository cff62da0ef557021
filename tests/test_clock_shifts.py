"""Clocks that shift while a session runs, as those of a late host: no event, and the parameters as without."""

from __future__ import annotations

import re

import numpy as np
import pytest

import sms_online as sms
from sms_adapters.system_file import load_system
from sms_online.description.schema import System
from sms_tools.live.simulated import write_testbed
from tests.simulations import planar_capture

SECONDS, SHIFTED = 16.0, 9.0  # s
LATE = 9e-4  # s, twice as much as in demos beside busy processes
STEP = 2e-3  # s, of a clock that begins anew on a late host


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> System:
    """The planar example with a clock for each device."""
    folder = tmp_path_factory.mktemp("rig")
    return load_system(str(write_testbed("paper-planar", load_system("paper-planar"), "B", folder)))


def with_late_markers(late: float) -> sms.Capture:
    """A session in which the markers' samples are late by so much, s, from SHIFTED on."""
    capture = planar_capture(SECONDS)
    values = capture.values.copy()
    for k, channel in enumerate(capture.channels):
        if ".marker_" in channel:
            behind = np.interp(capture.t - late, capture.t, values[:, k])
            values[:, k] = np.where(capture.t < SHIFTED, values[:, k], behind)
    return sms.Capture(capture.t, capture.channels, values)


@pytest.fixture(scope="module")
def shifted() -> sms.Capture:
    return with_late_markers(LATE)


@pytest.mark.long
def test_a_clock_that_shifts_is_no_event(rig: System, shifted: sms.Capture) -> None:
    result = sms.estimate(rig, shifted)
    assert result.events == ()
    assert result.trust.level == "doubt"
    assert result.trust.sentence.startswith("Doubt: markers ")
    known = [p for p in result.parameters.values() if p.determined and p.nominal]
    assert max(abs(p.value - p.nominal) / p.std for p in known if p.nominal) < 5.0


@pytest.mark.long
def test_on_one_clock_the_same_samples_hold_an_event(rig: System, shifted: sms.Capture) -> None:
    (event,) = sms.estimate(rig.model_copy(update={"sources": ()}), shifted).events
    assert event.time == pytest.approx(SHIFTED, abs=0.5)


@pytest.mark.long
def test_a_shift_that_is_noticed_is_sized(rig: System, shifted: sms.Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nothing of it is allowed for.
    monkeypatch.setattr("sms_online.pipeline.events.WANDER", 0.0)
    result = sms.estimate(rig, shifted)
    assert result.events == ()
    size, std, time = said_of_markers(result)
    assert abs(size - 1e6 * LATE) < 4.0 * std < 200.0
    assert time == pytest.approx(SHIFTED, abs=0.5)


@pytest.mark.long
def test_a_step_of_one_clock_is_no_event(rig: System) -> None:
    result = sms.estimate(rig, with_late_markers(STEP))
    assert result.events == ()
    size, std, time = said_of_markers(result)
    assert abs(size - 1e6 * STEP) < 4.0 * std < 200.0
    assert time == pytest.approx(SHIFTED, abs=0.5)
    known = [p for p in result.parameters.values() if p.determined and p.nominal]
    assert max(abs(p.value - p.nominal) / p.std for p in known if p.nominal) < 5.0


def said_of_markers(result: sms.Result) -> tuple[float, float, float]:
    """Size and deviation (µs) of the one shift that is said, and its instant (s)."""
    (said,) = (warning for warning in result.warnings if "its clock shifted" in warning)
    found = re.fullmatch(r"markers: its clock shifted by \+(\d+) ± (\d+) µs against the others' at ([\d.]+) s", said)
    assert found is not None, said
    size, std, time = map(float, found.groups())
    return size, std, time
