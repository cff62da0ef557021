"""What a model with some effects leaves of a session: a function of the samples and these effects alone."""

from __future__ import annotations

import numpy as np
import pytest

from sms_online.description.schema import Effect
from sms_online.diagnosis.attempt import Attempt, Case
from sms_online.diagnosis.record import SampleRecord
from sms_online.pipeline.estimator import Estimator
from tests.slow_encoder import bench, session

EFFECTS = [Effect(name=name, where="joint_1") for name in ("coulomb_friction", "cubic_stiffness", "torque_offset")]


def attempt() -> Attempt:
    """The bench with a link encoder behind 20 Hz and Coulomb friction, undeclared: rows hold more than noise."""
    system, block = bench(), session(20.0, coulomb=0.01)
    estimator, record = Estimator(system, block.channels, "test"), SampleRecord(system.sample_rate)
    estimator.observers.append(record)
    estimator.push(block)
    estimator.finish()
    assert estimator.momentum is not None
    assert estimator.momentum.sensor_noise is not None
    case = Case("test", estimator, estimator.momentum.sensor_noise, record.segments(), [], lambda estimator: None)
    return Attempt(case, system, candidates=EFFECTS)


@pytest.mark.slow
def test_what_effects_leave_does_not_depend_on_questions_before() -> None:
    bench = attempt()
    assert bench.tracing.freed
    sets = [[], [0], [1], [0, 1]]
    first = {tuple(chosen): bench.state(chosen) for chosen in sets}
    for chosen in (*reversed(sets), *sets[1:]):
        again, before = bench.state(chosen), first[tuple(chosen)]
        np.testing.assert_array_equal(again.solution, before.solution)
        assert again.holdout == before.holdout
        assert again.test == before.test


@pytest.mark.slow
def test_a_search_finds_the_same_whatever_was_asked_before() -> None:
    one, other = attempt(), attempt()
    for chosen in ([2], [0], [1, 2]):
        other.state(chosen)
    found = [each.tracing.run(lambda chosen, k: None) for each in (one, other)]
    assert found[0] == found[1]
    np.testing.assert_array_equal(one.solution(found[0]), other.solution(found[1]))
