"""What an estimator without a session around it says, as results.json holds it."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from typing import Any

from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.pipeline.statistics import Statistics
from sms_online.result import result_of
from sms_online.stream import Array
from sms_online.trackers.interface import Estimate
from sms_online.verdict.judged import JudgedEvaluation
from sms_online.verdict.trust import Trust


def evaluated(estimator: Estimator, estimate: Estimate | None = None) -> JudgedEvaluation:
    """What an estimator knows, evaluated."""
    return JudgedEvaluation(statistics_of(estimator), estimator.estimate() if estimate is None else estimate)


def standard_deviation(estimator: Estimator, estimate: Estimate | None = None) -> Array:
    """1σ (n,) as it is reported."""
    return evaluated(estimator, estimate).std


def judged(estimator: Estimator) -> Trust:
    """May the estimate be trusted?"""
    return evaluated(estimator).trust


def results_document(
    estimator: Estimator,
    throughput: float = 0.0,
    warnings: Sequence[str] = (),
    truth: Mapping[str, float] | None = None,
    bound: Array | None = None,
) -> dict[str, Any]:
    """results.json of it."""
    return result_of(evaluated(estimator), truth, bound, warnings, throughput=throughput).document()


def elsewhere(statistics: Statistics) -> dict[str, Any]:
    """results.json as another process makes it of the statistics."""
    return result_of(JudgedEvaluation(pickle.loads(pickle.dumps(statistics)))).document()
