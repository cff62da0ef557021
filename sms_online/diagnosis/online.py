"""Diagnosis while a session runs: it notices more than noise, names the effect, and updates the model if wanted.

Samples are remembered for some seconds. Where the sequential test or the detector of changes alarms, they are searched,
again as more come, until two searches in a row name the same. Everything is decided between internal blocks and at
times of the data, so that a session and its repetition decide the same: what a search says may be used at once, or at a
later block, which has to be the same one in the repetition (`Searcher`).
"""

from __future__ import annotations

import numpy as np

from sms_online.description.schema import Effect
from sms_online.diagnosis.episodes import Episode, Onset, SearchAnswer, line
from sms_online.diagnosis.followed import least_samples
from sms_online.diagnosis.record import Segment, joined
from sms_online.diagnosis.running import RunningDiagnosis
from sms_online.diagnosis.searcher import Outcome, Request, Searcher
from sms_online.model.model import Model
from sms_online.pipeline.changes import ModelUpdate
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.events import TRANSIENT, Event
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.momentum_balance import MARGIN
from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Mask

# Times are in units of the windows of the momentum balance, those of 0.4 s at least.
SHORTEST_UNIT = 0.4
# Samples that are remembered, and those before an effect that give the parameters: 16 s and 6 s at the usual width.
REMEMBERED, BEFORE = 40.0, 15.0
# Fewer before an effect determine nothing beside it: it may as well have been there from the start.
LEAST_BEFORE = 5.0
# Episodes whose effects are added to the model at most: what is left of a real rig then is for a person.
MOST_ADOPTED = 8


class OnlineDiagnosis(RunningDiagnosis):
    """Watches the rows of a session's momentum balance.

    adopt: add what is named to the model.
    """

    def __init__(self, estimator: Estimator, searcher: Searcher, adopt: bool) -> None:
        super().__init__(estimator, searcher)
        self._adopt = adopt
        system = estimator.system
        self._unit = round(max(SHORTEST_UNIT, system.windows.momentum) * system.sample_rate)
        self._record: list[GridSamples] = []
        self._valid = 0  # grid index from which on the current model, or what it lacks, has been there
        self._events = len(estimator.events)
        self._drifts = 0 if estimator.momentum is None else estimator.momentum.bank.accepted  # that have been followed
        self._quiet = False  # what is lacking has been said, and not added to the model
        self._onset: Onset | None = None  # of the open episode
        self._rows: Momentum | None = None  # that were there at the last block
        self._agreed = False  # two searches in a row have named the same in the open episode
        self._sure = False  # and nothing else explains it as well, as far as is known
        self._due = 0  # searches of the open episode that were due so far

    @property
    def adopted(self) -> list[Effect]:
        """See `RunningDiagnosis`; a session that was resumed knows of more than its own episodes."""
        momentum = self._estimator.momentum
        if momentum is None:
            return []
        added = (name.rsplit(".", 1)[0].partition("@") for name in momentum.changes.added if "@" in name)
        return [*momentum.changes.adopted, *(Effect(name=name, where=where) for name, _, where in added)]

    def finish(self) -> None:
        """After the session's end, which may have decided on a change."""
        if self._estimator.momentum is not None and self._record:
            self._follow_events()
        if self._adopt and self._onset is not None and not self._sure and self.episodes[-1].verdict == "named":
            self.episodes[-1].refused = "the session ended before a second search could name the same"

    def samples(self, piece: GridSamples) -> None:
        """See `Observer`."""
        self._record.append(piece)
        oldest = int(piece.index[-1]) - round(REMEMBERED * self._unit)
        while self._record[0].index[-1] < oldest:
            self._record.pop(0)

    def block_through(self) -> None:
        """See `Observer`."""
        done = self._outcome()
        if self._estimator.momentum is None or not self._record:
            return
        self._follow_events()
        self._follow_drifts()
        self._conclude()
        answer = self._awaited(done)
        if answer is not None and self._onset is not None:
            self._take_answer(answer)
        self._withdraw()
        self._notice()
        self._search()

    @property
    def _momentum(self) -> Momentum:
        momentum = self._estimator.momentum
        assert momentum is not None  # else nothing is done
        return momentum

    @property
    def _now(self) -> float:
        return self._time(int(self._record[-1].index[-1]))

    def _time(self, index: float) -> float:
        return float(self._estimator.start_time + index / self._estimator.system.sample_rate)

    def _follow_events(self) -> None:
        """A jump of parameters explains what was noticed; what no jump explains goes on being searched."""
        for event in self._estimator.events[self._events :]:
            self._events += 1
            if event.kind in ("unexplained", "undecided"):
                continue
            if self._onset is None:
                evidence = self._momentum.test.evidence
                self.episodes.append(Episode(self._now, max(evidence, key=lambda row: evidence[row]), event.time))
            episode, said = self.episodes[-1], "passed" if event.kind == TRANSIENT else "change"
            episode.verdict, episode.named, episode.event, episode.named_at = said, (), event, self._now
            self._close()
            self.on_verdict(self._now, line(episode))
            index = round((event.time - self._estimator.start_time) * self._estimator.system.sample_rate)
            self._valid, self._quiet = index + self._unit // 2, False

    def _follow_drifts(self) -> None:
        """A drift that is followed explains what was noticed before it was found, or before its rate had changed."""
        before, self._drifts = self._drifts, self._momentum.bank.accepted
        if self._drifts <= before or self._onset is None:
            return
        episode, drifting = self.episodes[-1], self._momentum.bank.drifting
        fresh = tuple(name for name in drifting if not any(name in each.drifting for each in self.episodes))
        episode.verdict, episode.named, episode.named_at = "drift", (), self._now
        episode.drifting = fresh or drifting
        self._close()
        self.on_verdict(self._now, line(episode))

    def _close(self) -> None:
        self._onset, self._pending, self._agreed, self._sure = None, None, False, False

    def _withdraw(self) -> None:
        """Withdraw the open episode where rows that were made again, with better weights, hold no more than noise."""
        momentum, before, self._rows = self._momentum, self._rows, self._momentum
        if self._onset is None or before is momentum or self.episodes[-1].verdict != "noticed":
            return
        if momentum.changes.detector.alarm is None and momentum.test.alarm is None:
            episode = self.episodes.pop()
            self._close()
            self.on_verdict(self._now, f"rows made again with better weights: no more than noise in {episode.row}")

    def _notice(self) -> None:
        """Open an episode where rows alarm; in rows that were made without patience, the open one may begin anew."""
        patient = self._momentum.state.patient
        if self._quiet or self._sure or (self._onset is not None and self._onset.patient == patient):
            return
        detector, test = self._momentum.changes.detector, self._momentum.test
        width = self._momentum.changes.window_samples
        if detector.alarm is not None:
            last, first = detector.onset - MARGIN, detector.alarm
            row = max(test.evidence, key=lambda name: test.evidence[name])
        elif test.alarm is not None:
            last, first, row = test.alarm.since - width, test.alarm.end - width, test.alarm.row
        else:
            return
        seen = detector.before(last) if last >= 0 else None
        if seen is None or last - self._valid < LEAST_BEFORE * self._unit:
            onset = Onset(None, self._valid, self._momentum.changes.beforehand, patient)
        else:
            onset = Onset(last, first, seen.known, patient)
        before, self._onset = self._onset, onset
        noticed = self._now
        if before is not None:
            if (before.last, before.first) == (onset.last, onset.first):
                return
            noticed, self._pending, self._agreed = self.episodes.pop().noticed, None, False
        began = None if onset.last is None else self._time(0.5 * (last + first))
        self._due = 0
        self.episodes.append(Episode(noticed, row, began))
        self.on_verdict(self._now, line(self.episodes[-1]))

    def _search(self) -> None:
        """Begin the search that is due."""
        onset = self._onset
        if onset is None or self._sure:
            return
        newest = int(self._record[-1].index[-1])
        first = max(onset.first, int(self._record[0].index[0]))
        due = int(np.count_nonzero((newest - first) / self._unit >= np.array(onset.due)))
        if self._pending is not None:
            return  # what falls due meanwhile is searched right after it, in all that has come by then
        if due > self._due:
            self._due = due
            self._begun += 1
            request = self._request(onset)
            if request is not None:
                self._submit(request)
        elif self._due == len(onset.due):
            self._give_up()

    def _give_up(self) -> None:
        """All that is remembered was searched: what was not named twice is not known."""
        if self._agreed:
            self._settle()
            return
        episode = self.episodes[-1]
        passed = bool(episode.evidence) and episode.evidence[-1].outcome.verdict == "clean"
        episode.verdict, episode.named, episode.named_at = "passed" if passed else "unexplained", (), None
        self._quiet = True
        self._close()
        self.on_verdict(self._now, line(episode))

    def _request(self, onset: Onset) -> Request | None:
        """The record, cut where the effect began."""
        estimator = self._estimator
        before: list[Segment] = []
        if onset.last is not None:
            earliest = max(self._valid, onset.last - round(BEFORE * self._unit))
            before = self._segments(earliest, onset.last)
        after = self._segments(onset.first, None)
        momentum = self._momentum
        beta = momentum.changes.parameters(onset.known) if before else estimator.estimate().pi
        assert momentum.sensor_noise is not None
        if not after:
            return None
        return Request(
            model=estimator.model,
            base=estimator.base,
            sensing=estimator.sensing,
            noise=momentum.sensor_noise,
            segments=(*before, *after),
            late=len(before),
            beta=beta,
            whitened=momentum.started,
            prior=None if momentum.prior is None else momentum.changes.prior(momentum.prior),
        )

    def _segments(self, first: int, last: int | None) -> list[Segment]:
        """Remembered samples from one grid index to another, cut at gaps; those too short for a window left out."""
        out = []
        for each in joined(self._record).values():
            inside: Mask = (each.index >= first) & (True if last is None else each.index <= last)
            if int(inside.sum()) > least_samples(self._estimator.system):
                out.append(Segment(each.index[inside], each.values[inside]))
        return out

    def _take_answer(self, answer: SearchAnswer) -> None:
        """Take the answer of a search."""
        if answer.outcome.ended and self._onset is not None:
            # So much is lacking that only all that can be remembered is worth another search.
            self._due = max(self._due, len(self._onset.due) - 1)
        self._agreed = self._answered(self.episodes[-1], answer)
        if self.episodes[-1].verdict == "named":
            self._conclude()

    def _conclude(self) -> None:
        """Take what two searches agree on.

        Rows that may show a drift yet are linear about a point that the effect has moved: of laws that explain as much,
        another one may be the best there.
        """
        if self._agreed and not self._sure and self._onset is not None:
            momentum = self._momentum
            ambiguous = any(named.ambiguous for named in self.episodes[-1].named)
            # Rows that were made again since show better when it began.
            made_again = self._onset.patient != momentum.state.patient
            if not ambiguous or not (momentum.fit.plain.patient or made_again):
                self._settle()
        if self._sure:
            self._close_settled()

    def _settle(self) -> None:
        """Name for good what two searches agree on, and adopt it if wanted."""
        self._sure, episode = True, self.episodes[-1]
        if self._adopt:
            self._adopt_named(episode, episode.evidence[-1].outcome)
            self.on_verdict(self._now, line(episode))

    def _close_settled(self) -> None:
        """Close an episode that is named for good; not while rows are held back for an event or a drift behind it."""
        episode, detector = self.episodes[-1], self._momentum.changes.detector
        if detector.alarm is not None and episode.noticed >= self._time(detector.onset):
            return
        adopted = sum(each.adopted is not None for each in self.episodes)
        self._quiet = episode.adopted is None or adopted == MOST_ADOPTED
        self._close()

    def _adopt_named(self, episode: Episode, outcome: Outcome) -> None:
        """Go on with what was named."""
        onset, estimator = self._onset, self._estimator
        assert onset is not None
        episode.refused = refusal(estimator.model)
        if episode.refused is not None:
            return
        first, known = onset.first, onset.known
        if not outcome.began or onset.last is None:
            first, known = self._valid, self._momentum.changes.beforehand
        last = self._record[-1].segment
        newest = joined(self._record)[last]
        late = newest.index >= first
        samples = GridSamples(newest.index[late], newest.values[late], last)
        time = self._time(int(samples.index[0])) if episode.began is None or not outcome.began else episode.began
        sizes = {name: size for named in outcome.named for name, size in named.sizes.items()}
        event = Event(
            time=time,
            kind="effect",
            parameters=tuple(sizes),
            units=tuple(unit for _, _, unit in sizes.values()),
            sizes=tuple(value for value, _, _ in sizes.values()),
            stds=tuple(std for _, std, _ in sizes.values()),
            dropped_windows=0,
        )
        weights = np.concatenate((outcome.beta, *(named.values for named in outcome.named)))
        effects, since = [named.effect for named in outcome.named], int(samples.index[0])
        estimator.adopt(ModelUpdate(effects, event, known, weights, since), samples)
        self._events = len(estimator.events)
        self._valid = since
        episode.adopted = self._now


def refusal(model: Model) -> str | None:
    """Why a model cannot be updated while a session runs, None where it can."""
    if model.n_states:
        return "an effect of the model has internal states already, and a change would have them begin anew"
    return None
