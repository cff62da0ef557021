"""Changes of parameters within a capture that is diagnosed, and what only looks like one."""

from __future__ import annotations

import pytest

from sms_online.diagnosis.diagnose import diagnose
from sms_online.errors import InputError
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from tests.axis_effects import DAMPING, SYSTEM, axis_block, cogging


@pytest.mark.slow
def test_a_capture_with_a_jump_of_a_parameter_is_refused() -> None:
    block = axis_block(lambda q, rate: DAMPING * rate, 8.0, 14.0)
    with pytest.raises(InputError, match=r"capture, 8\.\d+ s: an event \(\w+\) within the capture; expected a part"):
        diagnose(SYSTEM, [block], "capture", lambda estimator: None)


@pytest.mark.slow
def test_an_effect_that_looked_like_a_jump_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Constant parameters explain the capture with it, whatever sessions have taken for a jump."""
    jump = Event(3.0, "inertia", ("link_1.inertia",), ("kg m²",), (0.1,), (0.01,), 0)
    monkeypatch.setattr(Estimator, "events", property(lambda self: [jump]))
    found = diagnose(SYSTEM, [axis_block(cogging)], "capture", lambda estimator: None)
    assert found.verdict == "named"
    assert [finding.candidate.key for finding in found.findings] == ["cogging@joint_1"]
