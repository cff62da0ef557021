"""What the diagnoses of running sessions have in common: episodes, and what the answers of searches make of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.episodes import FOUND, Episode, SearchAnswer, discrepancy, episode_document, line
from sms_online.diagnosis.searcher import AnyRequest, Outcome, Searcher
from sms_online.effects.build import with_effects
from sms_online.grouping import grouped
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.observer import Observer
from sms_online.verdict.evidence import Discrepancy


class RunningDiagnosis(Observer):
    """Watches one session, from before its first sample.

    searcher: may be replaced until then. on_verdict (t, text), on_evidence (t, gain by candidate): receive what is new.
    """

    def __init__(self, estimator: Estimator, searcher: Searcher) -> None:
        self.episodes: list[Episode] = []
        self.on_verdict: Callable[[float, str], None] = lambda t, text: None
        self.on_evidence: Callable[[float, Mapping[str, float]], None] = lambda t, scores: None
        self.searcher = searcher
        self._estimator = estimator
        self._blocks = 0
        self._begun = 0  # searches that were begun or left out
        self._pending: tuple[int, float] | None = None  # number of a search that runs, and time of its last sample, s
        estimator.observers.append(self)

    @property
    def adopted(self) -> Sequence[Effect]:
        """Effects that the session's model holds beside those described, by its own account."""
        return ()

    @property
    def system(self) -> System:
        """The described system with the effects that were named, adopted or not, and those that events have added."""
        system = self._estimator.system
        found = [*(named.effect for episode in self.episodes for named in episode.named), *self.adopted]
        held = {effect.key for effect in system.effects}
        fresh = grouped((effect.key, effect) for effect in found if effect.key not in held)
        return with_effects(system, [first for first, *_ in fresh.values()])

    @property
    def notices(self) -> list[str]:
        """A line for each episode."""
        return [line(episode) for episode in self.episodes]

    @property
    def discrepancies(self) -> tuple[Discrepancy, ...]:
        """The episodes as the judgement of the session takes them."""
        return tuple(discrepancy(episode) for episode in self.episodes)

    def document(self) -> list[dict[str, Any]]:
        """The episodes as results.json holds them."""
        return [episode_document(episode) for episode in self.episodes]

    def finish(self) -> None:
        """After the session's end, which may have decided on a change."""

    @property
    def _now(self) -> float:
        """Time of the newest sample, s."""
        raise NotImplementedError

    def _submit(self, request: AnyRequest) -> None:
        """Have samples up to now searched, unless the searcher leaves that out."""
        if self.searcher.submit(self._begun, request):
            self._pending = self._begun, self._now

    def _outcome(self) -> tuple[int, Outcome | None] | None:
        """What the searcher has at one block more: to be asked once a block, whatever becomes of it."""
        self._blocks += 1
        return self.searcher.outcome(self._blocks)

    def _awaited(self, done: tuple[int, Outcome | None] | None) -> SearchAnswer | None:
        """The answer of the search that is waited for; None where that is not done, or has ended without one."""
        if done is None or self._pending is None or done[0] != self._pending[0]:
            return None
        time, self._pending = self._pending[1], None
        return None if done[1] is None else SearchAnswer(time, self._now, done[1])

    def _answered(self, episode: Episode, answer: SearchAnswer) -> bool:
        """Add the answer of a search to an episode; whether it finds what the one before it has found."""
        outcome = answer.outcome
        before = episode.evidence[-1].outcome if episode.evidence else None
        episode.evidence.append(answer)
        self.on_evidence(answer.known, outcome.scores)
        if outcome.verdict not in FOUND:
            withdrawn = episode.verdict in FOUND
            episode.verdict, episode.named, episode.named_at, episode.mistakes = "noticed", (), None, ()
            if withdrawn:
                self.on_verdict(answer.known, line(episode))
            return False
        again = before is not None and before.found == outcome.found
        if not again:
            episode.named_at = answer.known
        episode.verdict, episode.named, episode.mistakes = outcome.verdict, outcome.named, outcome.mistakes
        self.on_verdict(answer.known, line(episode))
        return again
