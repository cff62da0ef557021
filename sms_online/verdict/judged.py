"""An evaluation with its verdict: what of it is to be trusted, and what to say beside it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from sms_online.evaluation import Evaluation
from sms_online.notices import notices, projection_warning, smoother_warnings
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.snapshot import statistics_of
from sms_online.pipeline.statistics import Statistics
from sms_online.trackers.interface import Estimate
from sms_online.verdict.evidence import Discrepancy
from sms_online.verdict.gather import evidence_of
from sms_online.verdict.judge import judge
from sms_online.verdict.truncated import FIRST_ORDER, truncated
from sms_online.verdict.trust import Trust


class JudgedEvaluation(Evaluation):
    """An `Evaluation` and whether to trust it; `result_of` makes one record of all of it.

    discrepancies: of the running diagnosis. troubles: whatever else speaks against the numbers, see `Evidence`.
    """

    def __init__(
        self,
        statistics: Statistics,
        estimate: Estimate | None = None,
        discrepancies: Sequence[Discrepancy] = (),
        troubles: Sequence[str] = (),
    ) -> None:
        super().__init__(statistics, estimate)
        self._discrepancies, self._troubles = tuple(discrepancies), tuple(troubles)

    @cached_property
    def trust(self) -> Trust:
        """May the estimate be trusted? The answer changes while a session runs."""
        return judge(evidence_of(self, self._discrepancies, self._troubles))

    @cached_property
    def warnings(self) -> list[str]:
        """What the trust rests on or lacks, in full sentences."""
        projection = projection_warning(self.projection) if self.statistics.finished else []
        coarse = [str(each) for each in truncated(self) if abs(each.share) <= FIRST_ORDER]
        return [*self.trust.warnings, *coarse, *projection, *smoother_warnings(self.statistics)]

    @cached_property
    def notices(self) -> list[str]:
        """What happened to the samples, a sentence each."""
        return notices(self.statistics)


def evaluated(estimator: Estimator) -> JudgedEvaluation:
    """What an estimator knows now, evaluated."""
    return JudgedEvaluation(statistics_of(estimator), estimator.estimate())
