"""Diagnosis while the smoother estimates: what its equations of motion lack is searched in the samples as they came.

The smoother says that samples do not agree with its equations, and no row shows where. Once ten seconds are there, they
are diagnosed as a capture is, and again as more come, until two searches in a row name the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.episodes import FOUND, Episode, discrepancy, line
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.running import RunningDiagnosis
from sms_online.diagnosis.searcher import RecordedRequest, Searcher
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block
from sms_online.verdict.evidence import Discrepancy

# Samples that are remembered, and the fewest that are searched, s: what the smoother needs for its first estimate.
REMEMBERED, LEAST = 40.0, 10.0
# Between one search and the next, s. If no two in a row agree, it is left to a person.
BETWEEN = (5.0, 15.0)
MOST_SEARCHES = len(BETWEEN) + 1
# A change is somewhere in a span of a second, and samples just behind it may still hold it.
BEHIND_A_CHANGE = 1.0
NOT_ADOPTED = "the smoother's model is not updated while it runs"


class SmoothedDiagnosis(RunningDiagnosis):
    """Watches a session whose parameters come from the smoother alone.

    There is one episode at most: no change is looked for once samples contradict the equations. source: names the
    samples. prior: what the session knows beforehand, see `priors.given_prior`.
    """

    def __init__(self, estimator: Estimator, searcher: Searcher, source: str, prior: bool | dict[str, Any]) -> None:
        super().__init__(estimator, searcher)
        self._source, self._prior = source, prior
        self._record: list[Block] = []
        self._asked = 0  # searches so far
        self._agreed = False  # two in a row have found the same
        self._next = -np.inf  # time of the samples from which on another one is due, s

    @property
    def adopted(self) -> list[Effect]:
        """See `RunningDiagnosis`: what the smoother's events have added."""
        described = self._estimator.system.effects
        return [effect for effect in self._estimator.model.system.effects if effect not in described]

    @property
    def discrepancies(self) -> tuple[Discrepancy, ...]:
        """What the samples lack, where that is known: that they do not agree is among the smoother's weaknesses."""
        return tuple(discrepancy(episode) for episode in self.episodes if episode.verdict in FOUND)

    def received(self, block: Block) -> None:
        """See `Observer`."""
        if block.t.size:
            self._record.append(block)
        while self._record and self._record[0].t[-1] < self._record[-1].t[-1] - REMEMBERED:
            self._record.pop(0)

    def block_through(self) -> None:
        """See `Observer`."""
        answer = self._awaited(self._outcome())
        if answer is not None:
            self._agreed = self._answered(self.episodes[-1], answer)
        if self._asked == MOST_SEARCHES and self._pending is None and not self._agreed:
            self._give_up(self.episodes[-1])
        if self._contradicted and not self._agreed:
            self._search()

    @property
    def _now(self) -> float:
        return float(self._record[-1].t[-1])

    @property
    def _contradicted(self) -> bool:
        """Whether samples contradict the equations of motion, or no span of them could be fitted."""
        smoother = self._estimator.smoother
        assert smoother is not None
        known = smoother.known
        if known.spans:
            return known.contradicted
        # Behind a change that nothing explains, failures are of spans before it.
        return bool(known.failures) and not self._estimator.events

    def _search(self) -> None:
        """Begin the search that is due; none at the session's end, for its answer would come too late."""
        if self._estimator.finished or not self._record:
            return
        events = self._estimator.events
        changed = events[-1].time if events else None
        if not self.episodes:
            self.episodes.append(Episode(self._now, "", changed, refused=NOT_ADOPTED))
            self.on_verdict(self._now, line(self.episodes[-1]))
        first = float(self._record[0].t[0])
        if changed is not None:
            first = max(first, changed + BEHIND_A_CHANGE)
        if self._pending is not None or self._now < max(first + LEAST, self._next) or self._asked == MOST_SEARCHES:
            return
        self._next = self._now + BETWEEN[min(self._asked, len(BETWEEN) - 1)]
        self._asked += 1
        self._begun += 1
        inside = [Block(b.t[b.t >= first], b.channels, b.values[b.t >= first]) for b in self._record]
        samples = tuple(block for block in inside if block.t.size)
        system = self._estimator.model.system
        self._submit(RecordedRequest(system, samples, self._source, self._prior, tuple(events)))

    def _give_up(self, episode: Episode) -> None:
        """What was not found twice is not known; where no search had an answer, that is not known either."""
        if not episode.evidence or episode.verdict == "unexplained":
            return
        episode.verdict, episode.named, episode.named_at, episode.mistakes = "unexplained", (), None, ()
        self.on_verdict(self._now, line(episode))


def running_diagnosis(
    estimator: Estimator, searcher: Searcher, adopt: bool, source: str, prior: bool | dict[str, Any]
) -> RunningDiagnosis:
    """The diagnosis of a session: by rows of the momentum balance, or where there are none by the smoother.

    adopt: add what is named to the model, which the smoother's does not allow for. source, prior: see above.
    """
    if estimator.momentum is None and estimator.smoother is not None:
        return SmoothedDiagnosis(estimator, searcher, source, prior)
    return OnlineDiagnosis(estimator, searcher, adopt)
