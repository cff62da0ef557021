"""Changes of parameters within a capture that is diagnosed, and what only looks like one."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.diagnosis.capture_changes import diagnosed_part
from sms_online.diagnosis.diagnose import diagnose
from sms_online.diagnosis.document import trust_of
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import Event
from sms_online.stream import Block
from tests.axis_effects import DAMPING, RATE, SYSTEM, Force, axis_block, cogging, nothing


@pytest.mark.parametrize("force", [nothing, cogging])
def test_the_part_before_a_jump_is_diagnosed(force: Force) -> None:
    """A jump of damping is found beside an effect that the description lacks, and is none of its effects."""
    t, before = np.arange(14.0 * RATE) / RATE, axis_block(force, 0.0, 14.0)
    behind = axis_block(lambda q, rate: force(q, rate) + DAMPING * rate, 0.0, 14.0)
    block = Block(t, before.channels, np.where((t < 8.0)[:, None], before.values, behind.values))
    found = diagnose(SYSTEM, [block], "capture", lambda estimator: None)
    (change,) = found.changes
    assert change.before
    assert change.event.time == pytest.approx(8.0, abs=0.1)
    assert change.event.kind == "friction"
    assert change.event.sizes == pytest.approx([DAMPING], rel=0.02)
    assert [finding.candidate.key for finding in found.findings] == (["cogging@joint_1"] if force is cogging else [])
    assert found.verdict == ("named" if force is cogging else "clean")
    trust = trust_of(found)
    assert trust.level == "doubt"
    assert trust.sentence.startswith("Doubt: at 8.0 s")


def test_the_part_behind_an_early_jump_is_diagnosed() -> None:
    run = [axis_block(nothing, 0.0, 8.0)]
    part, change = diagnosed_part(run, Event(2.0, "friction", ("damping",), ("",), (0.1,), (0.01,), 0), 0.25)
    assert not change.before
    assert part[0].t[0] == pytest.approx(2.25, abs=1.5 / RATE)


@pytest.mark.slow
def test_an_effect_that_looked_like_a_jump_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Constant parameters explain the capture with it, whatever sessions have taken for a jump."""
    jump = Event(3.0, "inertia", ("link_1.inertia",), ("kg m²",), (0.1,), (0.01,), 0)
    monkeypatch.setattr(Estimator, "events", property(lambda self: [jump]))
    found = diagnose(SYSTEM, [axis_block(cogging)], "capture", lambda estimator: None)
    assert found.verdict == "named"
    assert [finding.candidate.key for finding in found.findings] == ["cogging@joint_1"]
