"""Samples without noise: what integrators and sums over samples leave is no change, and no reason to doubt."""

from __future__ import annotations

import numpy as np
import pytest

from sms_adapters.system_file import load_system
from sms_online.pipeline.snapshot import statistics_of
from sms_online.verdict.judged import JudgedEvaluation
from sms_sim.simulate import sampled_blocks, simulate
from tests.exactly_known import exactly_known
from tests.sessions_of import session_of

DURATION = 10.0  # s, as in the paper
# Of the sums of rows' terms 2e-9 is left, a few thousand times as much of what some parameters add to them.
LARGEST_ERROR = 1e-4


@pytest.mark.long
@pytest.mark.parametrize("name", ["paper-planar", "paper-planar-exact"])
def test_exact_samples_are_trusted(name: str) -> None:
    system = exactly_known(load_system(name))
    estimator = session_of(system, sampled_blocks(simulate(system, DURATION)))
    evaluation = JudgedEvaluation(statistics_of(estimator), estimator.estimate())
    assert estimator.by_momentum
    assert estimator.events == []
    assert evaluation.determined.all()
    assert evaluation.trust.level == "trust"
    truth = evaluation.base.values(evaluation.model.nominal)
    error = np.abs(evaluation.estimate.pi - truth)
    assert np.all(error < LARGEST_ERROR * np.abs(truth))
    # Numerics last from one window to the next, so that bars of independent errors hold them within some.
    assert np.all(error < 4.0 * evaluation.std)
