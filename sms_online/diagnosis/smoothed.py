"""Diagnosis while the smoother estimates: what its equations of motion lack is searched in the samples as they came.

The smoother says that samples do not agree with its equations, and no row shows where. Once ten seconds are there, they
are diagnosed as a capture is, and again as more come, until two searches in a row name the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sms_online.diagnosis.episodes import Episode, SearchAnswer
from sms_online.diagnosis.online import OnlineDiagnosis
from sms_online.diagnosis.running import RunningDiagnosis
from sms_online.diagnosis.searcher import RecordedRequest, Searcher
from sms_online.pipeline.estimator import Estimator
from sms_online.stream import Block

# Samples that are remembered, and the fewest that are searched, s: what the smoother needs for its first estimate.
REMEMBERED, LEAST = 40.0, 10.0
# Between one search and the next, s. Three that do not agree leave it to a person.
BETWEEN = (5.0, 15.0)
# A change is somewhere in a span of a second, and samples just behind it may still hold it.
BEHIND_A_CHANGE = 1.0
NOT_ADOPTED = "the smoother's model is not updated while it runs"


class SmoothedDiagnosis(RunningDiagnosis):
    """Watches a session whose parameters come from the smoother alone.

    source: names the samples. prior: what the session knows beforehand, see `priors.given_prior`.
    """

    def __init__(self, estimator: Estimator, searcher: Searcher, source: str, prior: bool | dict[str, Any]) -> None:
        super().__init__(estimator, searcher)
        self._source, self._prior = source, prior
        self._record: list[Block] = []
        self._events = len(estimator.events)
        self._begin(-np.inf)

    def _begin(self, since: float) -> None:
        """Look at samples from a time on, s."""
        self._since = since
        self._episode: Episode | None = None
        self._asked = 0  # searches of the episode
        self._next = -np.inf  # time of the samples from which on another one is due, s
        self._pending = None

    def received(self, block: Block) -> None:
        """See `Observer`."""
        if block.t.size:
            self._record.append(block)
        while self._record and self._record[0].t[-1] < self._record[-1].t[-1] - REMEMBERED:
            self._record.pop(0)

    def block_through(self) -> None:
        """See `Observer`."""
        done = self._outcome()
        events = self._estimator.events[self._events :]
        if events:
            self._events += len(events)
            self._begin(events[-1].time + BEHIND_A_CHANGE)
        answer = self._awaited(done)
        if answer is not None:
            self._take_answer(answer)
        self._search()

    @property
    def _now(self) -> float:
        return float(self._record[-1].t[-1])

    def _search(self) -> None:
        """Begin the search that is due."""
        smoother = self._estimator.smoother
        assert smoother is not None
        if not self._record or not smoother.known.spans or not smoother.known.contradicted:
            return
        if self._episode is None:
            began = self._since if np.isfinite(self._since) else None
            self._episode = Episode(self._now, "", began, refused=NOT_ADOPTED)
        first = max(self._since, float(self._record[0].t[0]))
        if self._pending is not None or self._now < max(first + LEAST, self._next):
            return
        self._next = self._now + BETWEEN[self._asked] if self._asked < len(BETWEEN) else np.inf
        self._asked += 1
        self._begun += 1
        inside = [Block(b.t[b.t >= first], b.channels, b.values[b.t >= first]) for b in self._record]
        samples = tuple(block for block in inside if block.t.size)
        self._submit(RecordedRequest(self._estimator.system, samples, self._source, self._prior))

    def _take_answer(self, answer: SearchAnswer) -> None:
        episode = self._episode
        assert episode is not None
        if self._answered(episode, answer):
            self._next = np.inf
        # That samples do not agree is in the verdict already: an episode says what they lack.
        self.episodes = [other for other in self.episodes if other is not episode]
        if episode.verdict == "named":
            self.episodes.append(episode)


def running_diagnosis(
    estimator: Estimator, searcher: Searcher, adopt: bool, source: str, prior: bool | dict[str, Any]
) -> RunningDiagnosis:
    """The diagnosis of a session: by rows of the momentum balance, or where there are none by the smoother.

    adopt: add what is named to the model, which the smoother's does not allow for. source, prior: see above.
    """
    if estimator.momentum is None and estimator.smoother is not None:
        return SmoothedDiagnosis(estimator, searcher, source, prior)
    return OnlineDiagnosis(estimator, searcher, adopt)
